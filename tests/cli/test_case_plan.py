"""`sightline plan --case` and `check-shot`: images, plan and inserted wire in the journal of a case."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any
from zipfile import ZipFile

import numpy as np
import pytest
from pydicom import dcmread
from tests.cli.picked import VIEWS, WIRE_MM, marks_of, picks_file, wire

import sightline as sl
from sightline.app.session.session import export_files, report_files
from sightline.case.journal import Case, Kind
from sightline.common.checks import Check
from sightline.twin import hip_scene


def kinds(folder: Path) -> list[str]:
    with Case.open(folder, read_only=True) as case:
        return [entry.kind.value for entry in case.entries()]


def test_a_plan_is_recorded_in_a_case_and_comes_out_the_same(run, beads_csv: Path, setup, tmp_path: Path) -> None:
    picks = picks_file(tmp_path, wires={"wire": wire(setup, WIRE_MM)}, pick_sd_px=0.1)
    plan = ["plan", beads_csv, beads_csv, "--picks", picks, "--procedure", "free-wire", "--case", tmp_path / "case"]
    first, second = run(*plan, "--json"), run(*plan, "--side", "right")
    assert (first.code, second.code) == (0, 0), second.err
    assert first.document["case"]["images"] == {"pa": 1, "lateral": 1}
    assert first.document["case"]["entry"] == 6
    assert "the plan is entry 7" in second.out  # on the views that the case holds already
    assert kinds(tmp_path / "case") == ["acquired", *2 * ["labelled", "calibrated"], "planned", "planned"]
    outcomes = run("case", "replay", tmp_path / "case", "--json").document["entries"]
    assert {one["outcome"] for one in outcomes} == {"same to the bit"}
    old = Check("plan age", False, 4000.0, 3600.0, "s", "Take new images.")
    (page,) = report_files(tmp_path / "case", (old,)).values()  # as the app does, with what it shows beside the plan
    assert b"NO-GO" in page and b"Take new images." in page
    assert [file.read_bytes() for file in (tmp_path / "case" / "report").glob("*.html")] == [page]
    assert run("case", "check", tmp_path / "case").code == 0


@pytest.fixture(scope="module")
def planned(run: Callable[..., Any], pair, setup, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A case of two acquired images and a third without beads, planned on its newest pair."""
    folder = tmp_path_factory.mktemp("planned")
    (folder / "in").mkdir()
    for name in VIEWS:
        image = dcmread(pair[name])
        image.PatientName, image.PatientID = "DOE^JANE", "ID-4711-0815"
        image.save_as(folder / "in" / f"{name}.dcm")
    np.save(folder / "in" / "z.npy", np.full((64, 64), 900, np.uint16))
    assert run("acquire", "folder", folder / "in", "--case", folder / "case").code == 0
    hip = hip_scene(setup, np.random.default_rng(8))
    wires = {"guide-wire": wire(setup, hip.wire_mm)}
    picks = picks_file(folder, wires=wires, landmarks=marks_of(setup, hip), pick_sd_px=0.1)
    ran = run("plan", "--case", folder / "case", "--picks", picks, "--side", "right")
    assert "INCOMPLETE: 6 checks could" in ran.out, ran.err  # the bone is not drawn
    assert "image of entry 3 skipped" in ran.err
    return folder / "case"


def test_what_is_handed_on_is_the_same_plan_and_names_nobody(run, planned: Path, tmp_path: Path) -> None:
    (planned / "picks.json").write_bytes((planned.parent / "picks-0.json").read_bytes())  # as the app keeps them
    export, written_in = export_files(planned, ())
    assert written_in == ()
    ((name, data),) = export.items()
    assert (planned / "export" / name).read_bytes() == data
    (tmp_path / name).write_bytes(data)
    with ZipFile(tmp_path / name) as packed:
        packed.extractall(tmp_path)
    (folder,) = (each for each in tmp_path.iterdir() if each.is_dir())
    files = {file.name: file.read_bytes() for file in folder.iterdir()}
    plan_files = {"plan.json", "picks.json", "frame.json", "pa-plate.png", "lateral-plate.png"}
    assert files.keys() == {"report.html", "report.json", "pa.dcm", "lateral.dcm", *plan_files}
    assert not [name for name, data in files.items() if b"DOE^JANE" in data or b"4711-0815" in data]
    assert b"DOE^JANE" in b"".join(file.read_bytes() for file in (planned / "originals").iterdir())
    plan = sl.load(folder / "plan.json", sl.Plan)
    assert plan.trajectory.end_mm.tolist() == json.loads(files["report.json"])["trajectory"]["end_mm"]
    for view in VIEWS:
        handed, taken = (sl.read_image(place / f"{view}.dcm").pixels for place in (folder, planned.parent / "in"))
        assert (handed == taken).all()
    assert run("export", "plan", folder / "plan.json", "--to", "csv,slicer,dicom", "--out", tmp_path / "out").code == 0
    assert run("case", "check", planned).code == 0


def test_the_newest_images_of_a_case_are_planned_on(run, planned: Path) -> None:
    view = ["detected", "labelled", "calibrated"]
    assert kinds(planned)[:10] == [*3 * ["acquired"], *view, *view, "planned"]
    with Case.open(planned, read_only=True) as case:
        entry = case.latest(Kind.PLANNED)
        assert entry is not None
        assert entry.content["side"] == "right"
    outcomes = run("case", "replay", planned, "--json").document["entries"]
    assert {one["outcome"] for one in outcomes[:10]} == {"same to the bit"}


def test_a_check_shot_without_the_wire_is_refused_and_recorded(run, planned: Path, pair) -> None:
    ran = run("check-shot", pair["pa"], pair["lateral"], "--case", planned)
    assert ran.code == 3
    with Case.open(planned, read_only=True) as case:
        assert "refused" in case.entries(Kind.VERIFIED)[-1].content


def test_landmarks_that_cannot_be_read_are_refused(run, planned: Path, tmp_path: Path) -> None:
    mark = {"name": "head-centre", "check-pa": [1, 2]}
    ran = run("check-shot", "--case", planned, "--picks", picks_file(tmp_path, landmarks=[mark]))
    assert ran.code == 2
    assert "landmarks[0] needs its pixels in" in ran.err
