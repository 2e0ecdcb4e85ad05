"""The report: whole, self-contained, and true to the plan that it shows; and as JSON, whose schema is published."""

import json
import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

import sightline as sl
from sightline.case.report.content import NOTE, KeptExposure, Refused
from sightline.case.report.document import ReportDocument, report_document, schema_text
from sightline.case.report.drilled import Drilled
from sightline.case.report.page import render
from sightline.case.report.tables import tables
from sightline.case.views import view_document
from sightline.common.checks import Check
from sightline.planning import Verdict
from sightline.robot.link.record import DrillingRecord

SCHEMA = Path(__file__).parents[2] / "docs" / "report.schema.json"
VOID = {"meta", "link", "img", "br"}


class Page(HTMLParser):
    """Elements by tag, with their attributes and text; unbalanced tags are errors."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.found: list[tuple[str, dict[str, str | None]]] = []
        self.text = ""
        self.feed(html)
        assert not self.open

    def handle_starttag(self, tag, attrs) -> None:
        self.found.append((tag, dict(attrs)))
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs) -> None:
        self.found.append((tag, dict(attrs)))

    def handle_endtag(self, tag) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data) -> None:
        if not self.open or self.open[-1] not in ("style", "script"):
            self.text += data

    def all(self, tag: str) -> list[dict[str, str | None]]:
        return [attributes for name, attributes in self.found if name == tag]


@pytest.fixture(scope="module")
def html(report) -> str:
    return render(report)


@pytest.fixture(scope="module")
def page(html) -> Page:
    return Page(html)


def test_the_page_is_whole_and_asks_nothing_of_a_network(html, page) -> None:
    references = [v for _, a in page.found for k, v in a.items() if k in ("src", "href", "xlink:href")]
    assert references
    assert all(v.startswith(("#", "data:image/jpeg;base64,")) for v in references)
    assert not re.search(r"url\(|@import|fetch\(|XMLHttpRequest", html)
    figures = [a for a in page.all("svg") if a.get("role") == "img"]
    # two plans, four close-ups, the budget, beads and triangles of both views, two views of space
    assert len(figures) == 2 + 4 + 1 + 2 + 2 + 2
    assert all(len(a["aria-label"]) > 20 for a in figures)
    # the pixels are embedded once
    assert [a["id"] for a in page.all("image")] == ["radiograph-pa", "radiograph-lateral"]
    assert {a["href"] for a in page.all("use")} == {"#radiograph-pa", "#radiograph-lateral"}


def test_what_comes_from_files_is_escaped(html, page) -> None:
    assert len(page.all("script")) == 1
    assert "<script>alert" not in html
    assert "<script>alert('x')</script>.dcm" in page.text
    assert "too <long>" in page.text


def test_figures_verdict_and_notes_are_those_of_the_plan(report, page) -> None:
    path = report.plan.trajectory
    assert report.plan.verdict.go
    assert "NO-GO" not in page.text
    for words in (
        f"{path.entry_error_95_mm:.2f} mm",
        f"{path.end_error_95_mm:.2f} mm",
        f"{np.rad2deg(path.direction_error_95_rad):.2f}°",
        f"{path.length_mm:.1f} mm",
        f"{path.entry_mm[0]:.2f}",
        f"{report.compared[0].errors_mm[1]:.3f}",
        "✓ GO",
        "The error of registering a robot is not included",
        "states no tolerances",
        "not a medical device",
        "In CFCS",
    ):
        assert words in page.text
    text = " ".join(page.text.split())  # what two images cannot show stands beside the bound
    bound = text.index("95 % bound")
    assert bound < text.index(report.plan.unnoticed) < text.index("Two images cannot reveal")
    assert bound < text.index("Two images cannot reveal") < bound + 800
    for words in ("a scale error", "a shifted plate", "along its line of sight", "in the plane of both beams"):
        assert words in text


def test_a_plan_made_in_python_has_the_same_page(worked, tmp_path) -> None:
    page = Page(sl.report(worked.plan, tmp_path / "plan.html").read_text())
    for words in (
        f"✓ {worked.plan.verdict.state.upper()}",
        f"{worked.plan.trajectory.end_error_95_mm:.2f} mm",
        "Images not named here",
        "head-centre",
    ):
        assert words in " ".join(page.text.split())
    assert [a["id"] for a in page.all("image")] == ["radiograph-pa", "radiograph-lateral"]
    assert len([a for a in page.all("g") if a.get("class") == "beads"]) == 2
    matrix = sl.view_from_matrix(np.array([[5000.0, 0, 512, 3e5], [0, 5000, 512, 3e5], [0, 0, 1, 600]]), name="pa")
    for given, why in (
        (replace(worked.plan, views=(matrix, worked.views[1])), "none of view pa are known"),
        (worked.views[0], "not of a BeadView"),
    ):
        with pytest.raises(sl.SightlineError, match=why):
            sl.report(given, tmp_path / "refused.html")
    assert not (tmp_path / "refused.html").exists()


def test_no_go_gives_the_reasons_and_the_view(report) -> None:
    bad = Check("bead count", False, 3.0, 24.0, "beads", "Too few beads; move the frame.")
    image = replace(report.images[1], view=replace(report.images[1].view, checks=(bad,)))
    verdict = Verdict((bad.of_view("lateral"), *report.plan.verdict.checks))
    text = Page(
        render(replace(report, images=(report.images[0], image), plan=replace(report.plan, verdict=verdict)))
    ).text
    assert "✗ NO-GO" in text
    assert "bead count (lateral view): Too few beads; move the frame." in text
    assert f"1 of {len(verdict.checks)} checks" in text


def test_a_record_has_every_check_with_its_direction_the_side_what_was_confirmed_and_landmarks_by_name(report) -> None:
    confirmed = Check("side confirmed", True, None, None, "", "A person confirmed that this is the right side.")
    old = Check("plan age", False, 4000.0, 3600.0, "s", "Take new images.", missing=True)
    plan = replace(report.plan, side="right", landmark_names=("head-centre", ""))
    text = " ".join(Page(render(replace(report, plan=plan, confirmed=(confirmed, old)))).text.split())
    count = len(plan.verdict.checks) + 2
    for words in (
        f"INCOMPLETE 1 of {count} checks could not be made",
        f"Checks: {count - 1} of {count} passed",
        "Side right",
        f"Confirmed by a person {confirmed.sentence}",
        "4000 s",
        "at most 3600 s",
        "at least 24 beads",
        "at most 1 mm",
        "head-centre",
        "landmark 2",
    ):
        assert words in text


def test_a_method_that_refused_says_why(report) -> None:
    refused = Refused("localized", "by hand", "outside the triangles")
    text = Page(render(replace(report, compared=[*report.compared, refused]))).text
    assert "refused: outside the triangles" in text


def test_an_unknown_error_is_called_unknown(report) -> None:
    points = replace(
        report.plan.trajectory.points, joint_covariance_mm2=None, budget_mm2=None, gap_sigma=None, method="nearest"
    )
    plan = replace(report.plan, trajectory=replace(report.plan.trajectory, points=points))
    page = Page(render(replace(report, plan=plan, compared=())))
    assert page.text.count("unknown") >= 3
    assert "Where the error comes from" not in page.text
    assert "95 % ellipsoids" not in page.text


def test_the_residual_has_one_meaning(report) -> None:
    """Per axis, in JSON, report and of the view itself: the rms of the lengths is 1.4 times as large."""
    page = Page(render(report))
    for image in report.images:
        rms = image.view.residuals.rms_mm
        used = image.view.residuals.residual_mm[image.view.residuals.used]
        assert rms == pytest.approx(np.sqrt(np.mean((used**2).sum(axis=1)) / 2))
        assert view_document(image)["residual_rms_mm"] == rms
        assert f"residual {rms:.3f} mm rms per axis" in page.text


def test_where_a_gap_failed_no_error_stands_beside_the_coordinates(report) -> None:
    """Of the point itself in the table of points; of entry, tip and direction in tiles, budget and figures."""
    points = report.plan.seen
    sigma = np.ma.masked_array(np.ones(len(points.xyz_mm)))
    sigma[1] = 7.0
    seen = replace(points, gap_sigma=sigma, gap_tested=np.ones(len(points.xyz_mm), dtype=bool))
    trajectory = replace(report.plan.trajectory, points=seen.first(2))
    failed_gap = replace(report, plan=replace(report.plan, trajectory=trajectory, seen=seen), compared=())
    table = [[sd is None for _, sd in row["xyz"]] for row in tables(failed_gap)["points"]]
    assert table[:2] == [[False] * 3, [True] * 3]
    tiles = tables(failed_gap)["tiles"]
    assert [tile["value"] for tile in tiles[:3]] == ["unknown"] * 3
    assert {tile["note"] for tile in tiles[:3]} == {"the lines of sight miss each other"}
    page = Page(render(failed_gap))
    assert "Where the error comes from" not in page.text
    assert "95 % ellipsoids" not in page.text
    assert report_document(failed_gap).trajectory.error_95 is None


def test_observations_without_images_make_a_report_without_them(report) -> None:
    images = tuple(replace(i, seen=replace(i.seen, image=None, beads=None)) for i in report.images)
    page = Page(render(replace(report, images=images)))
    assert not page.all("image")
    assert "Each bead that was told apart" not in page.text
    assert "The set-up in space" in page.text


def test_stated_tolerances_leave_no_note_of_defaults(report) -> None:
    frame = replace(report.frame, tolerances=report.frame.effective_tolerances)
    assert "states no tolerances" not in Page(render(replace(report, frame=frame))).text.split("Checks")[0]


def test_the_same_report_is_the_same_page(report, html) -> None:
    assert render(report) == html


def test_the_published_schema_is_that_of_the_code() -> None:
    assert SCHEMA.read_text() == schema_text(), "python -m sightline.case.report.document > docs/report.schema.json"


def test_what_is_written_is_what_the_plan_states(report) -> None:
    written = report_document(report, "C-7F3K-9QTM-2XWD").model_dump_json()
    read = ReportDocument.model_validate_json(written)
    assert read.case == "C-7F3K-9QTM-2XWD"
    assert read.go is report.plan.verdict.go
    assert list(read.trajectory.entry_mm) == report.plan.trajectory.entry_mm.tolist()
    assert read.trajectory.error_95 is not None
    assert read.trajectory.error_95.end_mm == report.plan.trajectory.end_error_95_mm
    assert [check.name for check in read.checks] == [check.name for check in report.plan.verdict.checks]
    assert [len(view.beads) for view in read.views] == [len(image.seen.observations) for image in report.images]
    assert len(read.landmarks) == 2
    # What the schema does not name is there, too.
    assert json.loads(written)["trajectory"]["budget_rms"] == report.plan.trajectory.document()["budget_rms"]


def test_exposures_are_in_page_and_document(report) -> None:
    """And so is what is not known of them."""
    many = replace(report, exposures=[KeptExposure(f"{k:012d}.dcm", f"use {k}", frames=k) for k in range(1, 60)])
    page = render(many)
    document = json.loads(report_document(many).model_dump_json())
    for k in (1, 59):
        assert f"{k:012d}.dcm" in page
        assert f"use {k}" in page
        assert {"image": f"{k:012d}.dcm", "used": f"use {k}", "at": None, "frames": k} in document["exposures"]
    assert NOTE in " ".join(page.split())
    assert "neither is the dose" in schema_text()


def test_a_drilled_wire_has_the_verdict_s_place(report) -> None:
    """GO of its plan is no longer what a reader asks for."""
    drilled = DrillingRecord(np.array([30.0]), np.array([1.0]), ())
    for check, why in ((None, "no check shot was measured"), ("no wire is seen", "refused: no wire is seen")):
        text = Page(render(replace(report, drilled=Drilled(None, drilled, check)))).text
        assert "✓ GO" not in text
        assert "○ NOT VERIFIED" in text
        assert why in text
