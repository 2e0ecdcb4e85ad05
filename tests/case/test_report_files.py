"""The report as JSON, whose schema is published, and as PDF."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg

from sightline.case.report import pdf
from sightline.case.report.content import Report
from sightline.case.report.document import ReportDocument, report_document, schema_text
from sightline.case.report.exposures import NOTE, KeptExposure
from sightline.case.report.page import render
from sightline.planning.results import Verdict

SCHEMA = Path(__file__).parents[2] / "docs" / "report.schema.json"


def test_the_published_schema_is_that_of_the_code() -> None:
    assert SCHEMA.read_text() == schema_text(), "python -m sightline.case.report.document > docs/report.schema.json"


def test_what_is_written_is_what_the_plan_states(report: Report) -> None:
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


def test_exposures_are_in_page_document_and_pdf(report: Report) -> None:
    """And so is what is not known of them."""
    many = replace(report, exposures=[KeptExposure(f"{k:012d}.dcm", f"use {k}", frames=k) for k in range(1, 60)])
    page = render(many)
    document = json.loads(report_document(many).model_dump_json())
    said = [text.get_text() for sheet in pdf.draw(many) for text in sheet.texts]
    for k in (1, 59):
        assert f"{k:012d}.dcm" in page
        assert f"use {k}" in page
        assert {"image": f"{k:012d}.dcm", "used": f"use {k}", "at": None, "frames": k} in document["exposures"]
        assert {f"{k:012d}.dcm", f"use {k}"} <= set(said)
    assert NOTE in " ".join(page.split())
    assert "neither is the dose" in " ".join(said)
    assert "neither is the dose" in schema_text()


def stands_against(report: Report) -> Report:
    """The same with a check that failed, in long words."""
    first, *others = report.plan.verdict.checks
    sentence = "a sentence as long as the longest that stands against a plan, and then some, " * 4
    failing = replace(first, passed=False, sentence=sentence)
    return replace(report, plan=replace(report.plan, verdict=Verdict((failing, *others))))


@pytest.mark.parametrize("change", [lambda report: report, stands_against])
def test_no_word_of_the_pdf_runs_off_its_page(report: Report, change) -> None:
    said = []
    for page in pdf.draw(change(report)):
        renderer = FigureCanvasAgg(page).get_renderer()
        for text in page.texts:
            box = text.get_window_extent(renderer).transformed(page.transFigure.inverted())
            assert 0.05 < box.x0 <= box.x1 < 0.95, text.get_text()
            assert 0.02 < box.y0 <= box.y1 < 0.98, text.get_text()
            said.append(text.get_text())
    verdict = change(report).plan.verdict
    assert ("GO" if verdict.go else "NO-GO") in said
    assert {check.name for check in verdict.checks} <= set(said)
    assert said.count("FAIL") == sum(not check.passed for check in verdict.checks)


def test_the_same_report_gives_the_same_pdf(report: Report) -> None:
    first, second = (pdf.render_pdf(report) for _ in range(2))
    assert first.startswith(b"%PDF-")
    assert first == second
    for name in (b"CreationDate", b"/Author"):
        assert name not in first
