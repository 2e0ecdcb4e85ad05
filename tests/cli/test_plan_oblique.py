"""`sightline plan --oblique`: a third image of a block shows a movement of the patient that no pair shows."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.three import POINTS_MM, draw_three, three_images

from sightline.case.journal import Case, Kind
from sightline.imaging import write_dicom
from sightline.twin import SetUp
from sightline.twin.xray.setup import BEAMS

PAIR = ("pa", "lateral")
OF_BLOCK = ("--frame", "block60", "--procedure", "free-wire")


@pytest.fixture(scope="module")
def three() -> SetUp:
    return draw_three(np.random.default_rng(31), "flat-panel-0.3")[0]


@pytest.fixture(scope="module")
def files(three: SetUp, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder, images = tmp_path_factory.mktemp("three"), three_images(three, np.random.default_rng(32))
    return {name: write_dicom(image, folder / f"{name}.dcm") for name, image in images.items()}


def picks(
    three: SetUp, shift_mm: np.ndarray | None = None, views=tuple(BEAMS), of_oblique: str = "oblique"
) -> list[str]:
    """Entry, end and three landmarks as options, with 0.5 px of noise; the bone shifts after the first image."""
    rng = np.random.default_rng(33)
    texts = [""] * len(POINTS_MM)
    for k, name in enumerate(BEAMS):
        xyz = three.hip_mm + POINTS_MM + (0.0 if shift_mm is None or k == 0 else shift_mm)
        uv = three.views[of_oblique if name == "oblique" else name].project(xyz) + rng.normal(0.0, 0.5, (5, 2))
        for n in range(len(texts)) if name in views else ():
            # The third image does not show the entry, and the PA image not the last landmark.
            if (name, n) != ("oblique", 0) and ((name, n) != ("pa", 4) or "oblique" not in views):
                texts[n] += f" {name}:{uv[n, 0]:.3f},{uv[n, 1]:.3f}"
    return ["--entry", texts[0], "--end", texts[1], *(word for text in texts[2:] for word in ("--landmark", text))]


def plan(run, files: dict[str, Path], *more: object) -> Any:
    return run("plan", files["pa"], files["lateral"], *OF_BLOCK, *more, "--json")


def failing(ran: Any) -> set[str]:
    return {check["name"] for check in ran.document["checks"] if not check["passed"]}


def test_a_third_image_is_planned_on_recorded_and_replayed(run, files, three, tmp_path: Path) -> None:
    marks = picks(three)
    first = plan(run, files, "--oblique", files["oblique"], *marks, "--case", tmp_path / "case")
    assert first.code == 0, first.err or failing(first)
    off = np.subtract([first.document["trajectory"][key] for key in ("entry_mm", "end_mm")], three.hip_mm)
    assert np.linalg.norm(off - POINTS_MM[:2], axis=1).max() < 0.4  # twice its 95 % error
    assert list(first.document["case"]["images"]) == list(BEAMS)
    residuals = [mark["residual_px"] for mark in first.document["landmarks"]]
    assert residuals[2]["pa"] is None and np.abs([one["oblique"] for one in residuals]).max() < 2.0
    # The case names the views of a block: the same plan from its newest images.
    again = run("plan", "--case", tmp_path / "case", *OF_BLOCK, *marks, "--json")
    assert again.document["trajectory"] == first.document["trajectory"], again.err
    outcomes = run("case", "replay", tmp_path / "case", "--json").document["entries"]
    assert {one["outcome"] for one in outcomes} == {"same to the bit"}
    with Case.open(tmp_path / "case", read_only=True) as case:
        entry = case.latest(Kind.PLANNED)
        assert entry is not None and len(entry.rests_on) == 3
        assert entry.content["asked"]["entry_uv_px"][2] == [None, None]


@pytest.mark.slow  # three images are drawn into a page and a PDF
def test_the_report_shows_the_third_image_with_the_landmarks(run, files, three, tmp_path: Path) -> None:
    ran = plan(run, files, "--oblique", files["oblique"], *picks(three), "--case", tmp_path / "case")
    residual = ran.document["landmarks"][1]["residual_px"]["oblique"]
    assert run("case", "report", tmp_path / "case", "--out", tmp_path / "report").code == 0
    page = (tmp_path / "report" / "report.html").read_text()
    assert "Oblique image with the planned wire and its picks, and the landmarks" in page
    assert "Oblique image around the tip" in page and "Oblique image around the entry" not in page
    assert f"landmark 2: {np.linalg.norm(residual):.2f} px from its projection" in page
    assert "take a third, oblique image" not in page
    document = json.loads((tmp_path / "report" / "report.json").read_text())
    assert [view["view"] for view in document["views"]] == list(BEAMS)


def test_a_shift_in_the_plane_of_both_beams_is_a_wrong_go_of_two_images_and_a_no_go_of_three(run, files, three) -> None:
    across = np.cross(*(three.views[name].detector.normal for name in PAIR))
    along = three.views["lateral"].detector.normal - three.views["pa"].detector.normal
    in_plane = along - across * (along @ across) / (across @ across)
    shift = 2.0 * in_plane / np.linalg.norm(in_plane)
    pair = [*OF_BLOCK, *picks(three, shift, PAIR)]
    two = run("plan", files["pa"], files["lateral"], *pair)
    assert two.code == 0, two.out
    assert "No two images show a movement of the bone in the plane of both beams" in " ".join(two.out.split())
    three = plan(run, files, "--oblique", files["oblique"], *picks(three, shift))
    assert three.code == 3
    movement = next(check for check in three.document["checks"] if check["name"] == "movement")
    assert not movement["passed"]
    assert movement["sentence"].startswith("The bone seems to have moved between the 3 images")


def test_picks_of_another_image_are_a_no_go_and_another_image_is_refused(run, files, three) -> None:
    of_lateral = plan(run, files, "--oblique", files["oblique"], *picks(three, of_oblique="lateral"))
    assert of_lateral.code == 3 and "gap" in failing(of_lateral)
    twice = plan(run, files, "--oblique", files["lateral"], *picks(three))
    assert twice.code == 3 and "one view is given twice" in twice.out + twice.err


POINT = "pa:512,512 lateral:512,512"


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("CSV", "CSV", "--oblique", "CSV"), "whose plates are for the views pa and lateral only"),
        (("CSV", "CSV", "--landmark", f"{POINT} oblique:1,2"), "points are picked in an oblique image"),
        (("--oblique", "CSV"), "give the PA and the lateral image with it"),
        (("CSV", "CSV", "--landmark", "oblique:1,2"), "is not a point"),
        (("CSV", "CSV", "--landmark", "depth:300 oblique:1,2"), "is not a point"),
    ],
)
def test_a_third_image_that_cannot_be_used_is_refused(run, beads_csv: Path, arguments, words: str) -> None:
    given = [beads_csv if word == "CSV" else word for word in arguments]
    ran = run("plan", *given, "--entry", POINT, "--end", POINT)
    assert ran.code == 2
    assert words in " ".join(ran.err.split())
