"""`sightline plan` on three images: a third image of a block shows a movement of the patient that no pair shows."""

from pathlib import Path

import numpy as np
import pytest
from tests.cli.picked import picks_file
from tests.three import POINTS_MM, draw_three, three_files
from tests.worked import Worked

from sightline.case.journal import Case, Kind
from sightline.twin import SetUp
from sightline.twin.xray.setup import BEAMS

pytestmark = pytest.mark.slow  # tests/planning/test_third_image.py proves the plan
OF_BLOCK = ("--frame", "block60", "--procedure", "free-wire")


@pytest.fixture(scope="module")
def three() -> SetUp:
    return draw_three(np.random.default_rng(31), "flat-panel-0.3")[0]


@pytest.fixture(scope="module")
def files(three: SetUp, worked: Worked) -> dict[str, Path]:
    return three_files(worked.folder, three)


def picks(folder: Path, three: SetUp) -> tuple[str, Path]:
    """Entry, end and three landmarks, with 0.5 px of noise."""
    rng = np.random.default_rng(33)
    places: list[dict[str, list[float]]] = [{} for _ in POINTS_MM]
    for name in BEAMS:
        uv = three.views[name].project(three.hip_mm + POINTS_MM) + rng.normal(0.0, 0.5, (5, 2))
        for n, place in enumerate(places):
            # The third image does not show the entry, and the PA image not the last landmark.
            if (name, n) not in (("oblique", 0), ("pa", 4)):
                place[name] = uv[n].tolist()
    wires = {"wire": {"entry": places[0], "end": places[1]}}
    return "--picks", picks_file(folder, wires=wires, landmarks=places[2:])


def test_a_third_image_is_planned_on_recorded_replayed_and_reported(run, files, three, tmp_path: Path) -> None:
    marks, case = picks(tmp_path, three), tmp_path / "case"
    first = run("plan", *files.values(), *OF_BLOCK, *marks, "--case", case, "--json")
    assert first.code == 0, first.err or first.failing
    off = np.subtract([first.document["trajectory"][key] for key in ("entry_mm", "end_mm")], three.hip_mm)
    assert np.linalg.norm(off - POINTS_MM[:2], axis=1).max() < 0.4  # twice its 95 % error
    assert list(first.document["case"]["images"]) == list(BEAMS)
    residuals = [mark["residual_px"] for mark in first.document["landmarks"]]
    assert residuals[2]["pa"] is None and np.abs([one["oblique"] for one in residuals]).max() < 2.0
    # The case names the views of a block: the same plan from its newest images.
    again = run("plan", "--case", case, *OF_BLOCK, *marks, "--json")
    assert again.document["trajectory"] == first.document["trajectory"], again.err
    outcomes = run("case", "replay", case, "--json").document["entries"]
    assert {one["outcome"] for one in outcomes} == {"same to the bit"}
    with Case.open(case, read_only=True) as kept:
        entry = kept.latest(Kind.PLANNED)
        assert entry is not None and len(entry.rests_on) == 3
        assert entry.content["asked"]["entry_uv_px"][2] == [None, None]
    assert run("case", "report", case, "--out", tmp_path / "report").code == 0
    page = (tmp_path / "report" / "report.html").read_text()
    assert "Oblique image with the planned wire and its picks, and the landmarks" in page
    assert "Oblique image around the tip" in page and "Oblique image around the entry" not in page
    assert f"landmark 2: {np.linalg.norm(residuals[1]['oblique']):.2f} px from its projection" in page
    assert "take a third, oblique image" not in page


def test_one_view_given_twice_is_refused(run, files, three, tmp_path: Path) -> None:
    twice = run("plan", files["pa"], files["lateral"], files["lateral"], *OF_BLOCK, *picks(tmp_path, three))
    assert twice.code == 3 and "one view is given twice" in twice.err
