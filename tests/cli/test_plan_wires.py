"""`sightline plan` of several wires: relations of a file, plan.json of all wires, their exports and their case."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.cli.picked import LANDMARKS_MM, picks_file, place, screws_file, wire

from sightline.case.interop.plan_file import PlanFile, sealed
from sightline.case.journal import Case, Kind
from sightline.cli.base import Output
from sightline.cli.watch import _planned
from sightline.errors import RobotRefusedError, UnusableInputError
from sightline.frame import Frame

KEYS = ("inferior", "anterior", "posterior")
# The inferior wire, one above it in front, one above it behind; a right hip.
INFERIOR_MM = np.array([[31.3, 28.9, -9.7], [-30.1, -27.7, -5.3]])
WIRES_MM = INFERIOR_MM + np.array([[0.0, 0.0, 0.0], [6.1, -6.4, 7.3], [5.2, -5.9, -8.8]])[:, None]


@pytest.fixture(scope="module")
def arguments(setup, beads_csv: Path, tmp_path_factory: pytest.TempPathFactory) -> Callable[..., list[Any]]:
    """`arguments(WIRES_MM)`: of `plan`, with a file of the exact picks of wires by name."""
    folder = tmp_path_factory.mktemp("picks")

    def given(wires_mm: np.ndarray, keys: tuple[str, ...] = KEYS) -> list[Any]:
        wires = {key: wire(setup, ends_mm) for key, ends_mm in zip(keys, wires_mm, strict=True)}
        landmarks = [place(setup, xyz_mm) for xyz_mm in LANDMARKS_MM]
        picks = picks_file(folder, wires=wires, landmarks=landmarks, pick_sd_px=0.2)
        return ["plan", beads_csv, beads_csv, "--side", "right", "--picks", picks]

    return given


@pytest.fixture(scope="module")
def planned(run, arguments, tmp_path_factory: pytest.TempPathFactory) -> tuple[Any, Path]:
    """What was printed, and the folder of plan and case."""
    folder = tmp_path_factory.mktemp("planned")
    files = ["--out", folder / "plan", "--case", folder / "case"]
    return run(*arguments(WIRES_MM), "--procedure", screws_file(folder), *files), folder


def test_all_wires_are_planned_and_reported(planned) -> None:
    ran, out = planned[0], planned[1] / "plan"
    assert ran.code == 0, ran.out
    for words in (
        "GO: every check passed",
        "posterior wire, end",
        "parallel: Between the",
        "of the wire anterior is",
        "Drill the inferior wire, then the ant",
    ):
        assert words in ran.out
    files = {file.name for file in out.glob("[!.]*")}
    assert files == {"plan.json", "picks.json", *(f"report-{key}.html" for key in KEYS)}
    page = (out / "report-anterior.html").read_text()
    assert "All wires: GO" in page and "anterior wire (this report)" in page and "inverted triangle" in page


def test_plan_json_holds_all_wires_and_is_exported(run, planned, tmp_path: Path) -> None:
    out = planned[1] / "plan"
    plans = PlanFile.read_all(out)
    assert list(plans) == list(KEYS)
    for key, wire_mm in zip(KEYS, WIRES_MM, strict=True):
        assert plans[key].go and plans[key].document.kind == f"mine:{key}"
        assert np.linalg.norm(plans[key].points_mm - wire_mm, axis=1).max() < 1.5
        plans[key].refuse_for_robot()
    assert len({one.identifier("case") for one in plans.values()}) == 3
    with pytest.raises(UnusableInputError, match="name one of its wires with --wire; they are inferior, anterior"):
        PlanFile.read(out)

    exported = run("export", "plan", out, "--to", "csv,igtl,itk,slicer", "--out", tmp_path / "export", "--json")
    assert exported.code == 0, exported.out
    assert set(exported.document["statements"]) == set(KEYS)
    rows = [(tmp_path / "export" / "csv" / key / "trajectory.csv").read_text().splitlines()[1] for key in KEYS]
    assert len(set(rows)) == 3
    assert (tmp_path / "export" / "igtl" / "posterior" / "target.igtl").exists()


def test_a_live_image_shows_the_wire_that_is_named(planned) -> None:
    drawn = _planned(planned[1] / "plan", "anterior", Frame.load("gamma"), Output(json=False, quiet=True))
    assert np.linalg.norm(drawn.points_mm - WIRES_MM[1], axis=1).max() < 1.5


def test_a_case_keeps_each_wire_and_computes_it_again(run, planned) -> None:
    case = planned[1] / "case"
    with Case.open(case, read_only=True) as kept:
        entries = kept.entries(Kind.PLANNED)
        assert [entry.content["kind"] for entry in entries] == [f"mine:{key}" for key in KEYS]
        assert {"parallel", "spacing", "inverted triangle"} <= {one["name"] for one in entries[0].content["checks"]}
    assert run("case", "report", case, "--out", planned[1] / "report").code == 0
    said = json.loads((planned[1] / "report" / "report.json").read_text())["wires"]
    assert said["each"] == dict.fromkeys(KEYS, "go") and said["verdict"] == "go" and len(said["relations"]) == 3
    outcomes = run("case", "replay", case, "--json").document["entries"]
    assert {one["outcome"] for one in outcomes} == {"same to the bit"}


def test_edited_wires_are_noticed(planned, tmp_path: Path) -> None:
    file = tmp_path / "plan.json"
    given = json.loads((planned[1] / "plan" / "plan.json").read_text())
    assert given["verdict"] == "go" and given["procedure"]["name"] == "cannulated hip screws"
    given["wires"]["anterior"]["trajectory"]["end_mm"][0] += 1.0
    file.write_text(json.dumps(given))
    with pytest.raises(UnusableInputError, match="digest does not match"):
        PlanFile.read(file, "inferior")
    given["wires"] = [1]
    del given["digest"]
    file.write_text(json.dumps(given))
    with pytest.raises(UnusableInputError, match="they are none"):
        PlanFile.read_all(file)


def test_a_relation_of_the_file_decides(run, arguments, tmp_path: Path) -> None:
    """Each relation by its own limit: tests/planning/test_wires.py."""
    ran = run(*arguments(WIRES_MM), "--procedure", screws_file(tmp_path, "spacing", low=14.0), "--json")
    assert ran.code == 3
    assert ran.document["verdict"] == "no-go" and ran.failing == {"spacing"}
    assert not any(wire["go"] for wire in ran.document["wires"].values())


def test_a_wire_that_is_left_out_is_asked_for_and_the_others_are_not_sent(run, arguments, tmp_path) -> None:
    out = tmp_path / "plan"
    given = (*arguments(WIRES_MM[:2], KEYS[:2]), "--procedure", screws_file(tmp_path))
    ran = run(*given, "--out", out, "--json")
    assert ran.code == 3
    assert ran.document["verdict"] == "incomplete"
    assert any("pick entry and end of the posterior wire" in sentence for sentence in ran.document["missing"])
    alone = PlanFile.read(out, "inferior")
    assert alone.go  # by itself
    with pytest.raises(RobotRefusedError, match="the plan of all wires is INCOMPLETE: none of them"):
        alone.refuse_for_robot()
    drive = run("robot", "drive", out, "--wire", "inferior", "--yes")
    assert drive.code == 3 and "the plan of all wires is INCOMPLETE" in drive.err


def test_a_wire_without_its_relations_is_not_sent_and_not_exported(run, arguments, tmp_path: Path) -> None:
    out, of_one = tmp_path / "plan", f"{screws_file(tmp_path)}:inferior"
    planned = run(*arguments(WIRES_MM[:1], KEYS[:1]), "--procedure", of_one, "--out", out)
    assert planned.code == 0, planned.err  # GO for this wire
    for given in (
        ("robot", "drive", out, "--yes"),
        ("export", "plan", out, "--to", "igtl", "--out", tmp_path / "igtl"),
    ):
        ran = run(*given)
        said = ran.said
        assert ran.code == 3
        assert "the inverted triangle and parallel and spacing relations to the others were not checked" in said
        assert "plan all wires together" in said
    assert not (tmp_path / "igtl").exists()
    assert run("export", "plan", out, "--to", "csv", "--out", tmp_path / "csv").code == 0  # for a person's eyes


@pytest.mark.parametrize("of_one", [True, False])
def test_a_program_that_drops_relations_gets_no_wire_to_a_robot(planned, tmp_path: Path, of_one: bool) -> None:
    """It says GO of all wires, or takes one out of its file, and does not say that their relations were checked."""
    given = json.loads((planned[1] / "plan" / "plan.json").read_text())
    wires = given.pop("wires")
    for unchecked, words in (([], ""), (["parallel"], "the parallel relations"), (None, "does not state whether")):
        for one in wires.values():
            one["unchecked_relations"] = unchecked
        document = given | (wires["posterior"] if of_one else {"wires": wires})
        (tmp_path / "plan.json").write_text(json.dumps(sealed(document)))
        read = PlanFile.read(tmp_path, None if of_one else "posterior")
        if not words:
            read.refuse_for_robot()
            continue
        with pytest.raises(RobotRefusedError, match=words):
            read.refuse_for_robot()
