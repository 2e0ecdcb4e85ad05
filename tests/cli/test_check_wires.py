"""`sightline check-shot` of several wires in one case: each by its own plan, and the relations between them."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.cli.picked import VIEWS, marks_of, picks_file, screws_file, wire

from sightline.case.journal import Case, Kind
from sightline.common.geometry.lines import unit
from sightline.imaging import write_dicom
from sightline.twin import HipScene, hip_scene, render
from sightline.twin.objects.things import guide_wire

KEYS = ("inferior", "anterior", "posterior")
ASIDE_MM = 8.0  # between neighbours, in each image
OFF_MM = {"inferior": 0.0, "anterior": 0.7}  # how far beside their plans two of them are drilled


@pytest.fixture(scope="module")
def hip(setup) -> HipScene:
    return hip_scene(setup, np.random.default_rng(8))


@pytest.fixture(scope="module")
def wires_mm(hip: HipScene) -> np.ndarray:
    """Three parallel wires that both images show apart."""
    front = np.array([0.0, 0.0, 1.0])
    up = np.cross(unit(hip.wire_mm[1] - hip.wire_mm[0]), front)
    return hip.wire_mm + np.array([k * ASIDE_MM * (up + front) for k in (0, 1, -1)])[:, None]


@pytest.fixture(scope="module")
def case(run, beads_csv: Path, setup, hip: HipScene, wires_mm: np.ndarray, tmp_path_factory) -> Path:
    """A case with the plan of three wires."""
    folder = tmp_path_factory.mktemp("wires")
    wires = {key: wire(setup, ends_mm) for key, ends_mm in zip(KEYS, wires_mm, strict=True)}
    picks = picks_file(folder, wires=wires, landmarks=marks_of(setup, hip), pick_sd_px=0.2)
    procedure = screws_file(folder, without="inverted triangle")
    given = ("--side", "right", "--picks", picks, "--procedure", procedure, "--case", folder / "case")
    ran = run("plan", beads_csv, beads_csv, *given)
    assert ran.code == 0, ran.out + ran.err
    return folder / "case"


@pytest.mark.slow
def test_two_wires_in_one_case_are_measured_each_against_its_plan(
    run, case: Path, setup, hip: HipScene, wires_mm: np.ndarray, tmp_path: Path
) -> None:
    """The other wire's line, or its plan, lies 8 mm off."""
    rng, scene = np.random.default_rng(5), hip.scene
    aside = np.array([0.0, 0.0, 1.0])
    for key, off in OFF_MM.items():
        scene += guide_wire(wires_mm[KEYS.index(key)] + off * aside, 2.8)
    files = [write_dicom(render(setup, view, scene, rng), tmp_path / f"{view}.dcm") for view in VIEWS]
    marks = marks_of(setup, hip, "check-")
    shot = ["check-shot", "--case", case, "--picks", picks_file(tmp_path, landmarks=marks, pick_sd_px=0.1)]
    unnamed = run(*shot, *files)
    assert unnamed.code == 2 and "--wire; the plan's are inferior, anterior, posterior" in unnamed.err

    without = run(*shot[:3], *files, "--wire", "inferior")
    assert without.code == 3 and without.out.startswith("NOT CONFIRMED: ")
    assert without.out.splitlines()[1].startswith("FAIL ")
    assert without.out.index("FAIL bone landmarks") < without.out.index("Wire against the plan")
    other = picks_file(tmp_path, landmarks=[{**marks[0], "name": "patella"}])
    unknown = run(*shot[:3], "--picks", other, "--wire", "inferior")
    assert unknown.code == 2
    assert "no landmark 'patella'; it has head-centre, lesser-trochanter, greater-trochanter" in unknown.err
    first = run(*shot, "--wire", "inferior", "--json")  # of the newest images
    assert first.code == 0, first.out + first.err
    second = run(*shot, "--wire", "anterior", "--json")
    for ran, off in ((first, OFF_MM["inferior"]), (second, OFF_MM["anterior"])):
        deviation, error = ran.document["deviation"], ran.document["error_95"]
        assert abs(deviation["entry_mm"] - off) < error["entry_mm"] + 0.1
        assert abs(deviation["tip_mm"] - off) < error["tip_mm"] + 0.1
    # The third wire is not in: its place is empty, and its neighbours are not taken for it.
    third = run(*shot, "--wire", "posterior")
    assert third.code == 3 and ("may be the other" in third.err or "no wire is seen" in third.err), third.err
    with Case.open(case, read_only=True) as kept:
        shots = kept.entries(Kind.VERIFIED)
        rest = [f"mine:{key}" for key in (KEYS[0], *KEYS)]
        assert [kept.entry(one.rests_on[0]).content["kind"] for one in shots] == rest
        assert len({one.rests_on[1:] for one in shots}) == 1  # the same views, recorded once
    assert run("case", "report", case, "--out", tmp_path / "report").code == 0
    page = (tmp_path / "report" / "report.html").read_text()
    assert "parallel, as measured" in page and page.count(": entry 0.") == 2 and "<td>not measured</td>" in page
    said = run(*shot, "--wire", "anterior").out
    assert "parallel, as measured: " in said and "the posterior wire is not measured yet" in said


@pytest.mark.slow
def test_a_wire_is_planned_beside_one_that_the_images_show(
    run, setup, hip: HipScene, wires_mm: np.ndarray, tmp_path: Path
) -> None:
    """The relation is to the wire as it lies, not as it was clicked."""
    rng = np.random.default_rng(6)
    scene = hip.scene + guide_wire(wires_mm[0], 2.8)
    files = [write_dicom(render(setup, view, scene, rng), tmp_path / f"{view}.dcm") for view in VIEWS]
    clicked = wires_mm.copy()
    clicked[0, 1] += [0.0, 0.0, 2.5]  # the tip of the wire in the bone: 1.5° from where it lies
    wires = {key: wire(setup, ends) for key, ends in zip(KEYS, clicked, strict=True)}
    procedure = screws_file(tmp_path, without="inverted triangle")

    def beside(*in_bone: str) -> Any:
        picks = picks_file(tmp_path, wires=wires, in_bone=in_bone)
        return run("plan", *files, "--procedure", procedure, "--side", "right", "--picks", picks, "--json")

    ran = beside("inferior")
    assert ran.code in (0, 3), ran.err
    parallel = next(check for check in ran.document["relations"] if check["name"] == "parallel")
    assert parallel["passed"] and parallel["figure"] < 1.0, parallel
    assert list(ran.document["wires"]) == ["anterior", "posterior"]
    assert "all wires" not in {check["name"] for check in ran.document["checks"] if not check["passed"]}
    missing = beside("anterior")  # it is not in
    assert missing.code == 3 and "placed wire 'anterior', view 'pa'" in missing.document["error"]["message"]
    unknown = beside("medial")
    assert unknown.code == 2 and "has no wire 'medial'" in unknown.document["error"]["message"]
