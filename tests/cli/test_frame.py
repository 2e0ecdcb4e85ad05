import json

import numpy as np
import pytest
from typer.testing import CliRunner

from sightline.cli import commands
from sightline.frame import Frame, Tolerances


def run(*arguments: str, code: int = 0) -> str:
    result = CliRunner().invoke(commands, ["frame", *arguments])
    assert result.exit_code == code, result.output
    return result.output if code == 2 else result.stdout


def test_new_writes_the_built_in_frame_with_datums_of_its_own(tmp_path):
    path = tmp_path / "mine.json"
    document = json.loads(run("new", str(path), "--json"))
    frame, like = Frame.load(path), Frame.load("gamma")
    assert frame.name == "mine"
    for name, view in frame.views.items():
        np.testing.assert_allclose(view.xrii.xyz_mm, like.view(name).xrii.xyz_mm)
        np.testing.assert_allclose(view.source.xyz_mm, like.view(name).source.xyz_mm)
        assert (view.xrii.is_datum != like.view(name).xrii.is_datum).any()
    assert document["name"] == "mine"
    assert all(check["passed"] for check in document["checks"])


def test_new_takes_figures(tmp_path):
    given = ("--like", "biplane", "--rows", "6", "--pitch-mm", "25", "--datums", "7", "--xrii-mm", "160")
    run("new", str(tmp_path / "b.json"), *given, "--quiet")
    view = Frame.load(tmp_path / "b.json").view("pa")
    assert (len(view.xrii.ids), view.xrii.is_datum.sum()) == (36, 7)
    assert view.xrii.xyz_mm[:, 2].max() == 160
    assert view.source.xyz_mm[:, 2].max() == -150
    assert view.xrii.xyz_mm[1, 0] - view.xrii.xyz_mm[0, 0] == 25


@pytest.mark.slow
def test_a_frame_that_fails_a_check_is_refused_and_not_written(tmp_path):
    told = run("new", str(tmp_path / "f.json"), "--pitch-mm", "20", code=3)
    assert "wire-reach" in told and "was not written" in told
    document = json.loads(run("new", str(tmp_path / "f.json"), "--pitch-mm", "20", "--json", code=3))
    assert document["file"] is None
    assert [check["name"] for check in document["checks"] if not check["passed"]] == ["wire-reach"]
    assert not list(tmp_path.iterdir())


def test_new_takes_measured_balls(tmp_path):
    rows = ["view,plate,id,x_mm,y_mm,z_mm,diameter_mm,datum,sd_mm"]
    for name, view in Frame.load("gamma").views.items():
        for role in ("xrii", "source"):
            for f in getattr(view, role).fiducials:
                x, y, z = f.xyz_mm
                rows.append(f"{name},{role},{f.id},{x},{y},{z},{f.diameter_mm},{f.datum},0.01")
    (tmp_path / "balls.csv").write_text("\n".join(rows))
    document = json.loads(run("new", str(tmp_path / "m.json"), "--csv", str(tmp_path / "balls.csv"), "--json"))
    assert document["tolerances"] is None
    assert document["tolerances_from"] == "the covariance in the frame file"
    assert "the covariance in the frame file" in run("show", str(tmp_path / "m.json"))


def test_new_states_tolerances_and_copies_a_file_with_them(tmp_path):
    block, copy, plates = (str(tmp_path / name) for name in ("block.json", "copy.json", "plates.json"))
    assert "from the frame file: bead 0.1 mm\n" in run("new", block, "--like", "block60", "--bead-sd", "0.1")
    run("new", copy, "--like", block, "--bead-sd", "0.08", "--quiet")
    assert (Frame.load(copy).solid, Frame.load(copy).tolerances.bead_mm) == (Frame.load("block60").solid, 0.08)
    told = run("new", plates, "--plate-sd", "0.1,0.7", "--arm-sd", "0.15,1")
    assert "its datum balls are not those of gamma" in told
    assert Frame.load(plates).tolerances == Tolerances(0.02, 0.1, 0.7e-3, 0.15, 1e-3)
    for options, words in (
        (("--like", block, "--plate-sd", "0.1,1"), "a block has no plates"),
        (("--like", block, "--rows", "7"), "is copied"),
        (("--plate-sd", "0,1,7"), "MM,MRAD"),
        (("--bead-sd", "0"), "--bead-sd"),
    ):
        assert words in run("new", str(tmp_path / "f.json"), *options, code=2)


def test_show_says_where_tolerances_come_from_and_draws_the_plates(tmp_path):
    assert "the defaults: the frame file states none" in run("show", "gamma", "--picture", str(tmp_path / "plates.png"))
    assert (tmp_path / "plates.png").read_bytes().startswith(b"\x89PNG")
    document = json.loads(run("show", "stereo", "--json"))
    assert document["tolerances"]["plate_mm"] == 0.05
    assert [plate["beads"] for plate in document["plates"]] == [49, 64, 49, 64]
    assert all(plate["reach_mm"] > 10 for plate in document["plates"])


def test_check_passes_a_good_frame_and_refuses_what_is_none(tmp_path):
    assert run("check", "gamma") == "14 checks passed; --all lists them\n"
    assert "\npass plate-beads: 49 beads, at least 16 beads, pa, XRII plate: " in run("check", "gamma", "--all")
    (tmp_path / "f.json").write_text('{"units": "cm"}')
    assert "f.json: " in run("check", str(tmp_path / "f.json"), code=2)


def test_show_says_where_a_block_may_stand(tmp_path):
    solid = json.loads(run("show", "block60", "--json", "--picture", str(tmp_path / "faces.png")))["solid"]
    assert (solid["beads"], solid["diameters_mm"]) == (16, {"3.0": 11, "5.0": 5})
    assert [round(one["offset_mm"]) for one in solid["stands"]] == [25, 47]
    assert (tmp_path / "faces.png").read_bytes().startswith(b"\x89PNG")
    told = run("show", "cube120")
    assert "does not fit" in told and "arm" not in told
    assert json.loads(run("check", "block60", "--json"))["solid"] == solid


def test_new_takes_a_block_and_a_cube_of_xmalab(tmp_path):
    run("new", str(tmp_path / "mine.json"), "--like", "block30", "--quiet")
    mine = Frame.load(tmp_path / "mine.json")
    assert (mine.name, mine.solid) == ("mine", Frame.load("block30").solid)
    rows = ["x,y,z", *(f"{x / 10},{y / 10},{z / 10}" for x, y, z in mine.solid.xyz_mm.tolist())]
    (tmp_path / "cube.csv").write_text("\n".join(rows))
    options = ("--csv", str(tmp_path / "cube.csv"), "--units", "cm", "--diameter-mm", "2")
    run("new", str(tmp_path / "lego.json"), *options, "--quiet")
    lego = Frame.load(tmp_path / "lego.json")
    np.testing.assert_allclose(lego.solid.xyz_mm, mine.solid.xyz_mm)
    assert {f.diameter_mm for f in lego.solid.fiducials} == {2.0}
