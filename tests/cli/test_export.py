"""`sightline export` on the twin's images: what it writes is read back; what it may not write is not written."""

import json
from pathlib import Path

import numpy as np
import pytest
from pydicom import dcmread
from tests.cli.picked import picks_file, typed

from sightline.calibration.exchange.formats import FORMATS, check_format, read_projections, read_view, write_view
from sightline.calibration.exchange.pinhole import Pinhole
from sightline.case.interop.plan_file import sealed
from sightline.imaging import read_image

TARGETS_MM = np.array([[11.3, -7.9, 4.1], [-20.7, 15.2, -9.9]])


@pytest.fixture(scope="module")
def planned(run, pair, setup, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out, folder = tmp_path_factory.mktemp("planned"), tmp_path_factory.mktemp("picks")
    picks = picks_file(folder, pick_sd_px=0.1)
    given = (*typed(setup), "--picks", picks, "--procedure", "free-wire", "--side", "left", "--out", out)
    ran = run("plan", *pair.values(), *given)
    assert ran.code in (0, 3), ran.err
    return out


@pytest.fixture(scope="module")
def exported(run, pair, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict]:
    out = tmp_path_factory.mktemp("views")
    ran = run("export", "views", pair["pa"], pair["lateral"], "--to", ",".join(FORMATS), "--out", out, "--json")
    assert ran.code in (0, 3), ran.out
    return out, ran.document


def test_every_format_gives_one_view(exported: tuple[Path, dict], setup) -> None:
    """All files agree; and rays from their focal point run as from the true one, nearly."""
    folder, document = exported
    for stated in document["views"]:
        name = stated["view"]
        files = [p for p in folder.glob(f"{name}.*.*") if p.suffix != ".mha"]
        assert len(files) == len(FORMATS) + 2  # OpenCV's three
        seen = [read_view(p).view().project(TARGETS_MM) for p in files]
        assert max(np.abs(one - seen[0]).max() for one in seen) < 1e-6
        assert read_image(folder / f"{name}.png").shape == tuple(stated["shape"])
        truth = setup.views[name].focal_point_mm
        focal = read_view(files[0]).focal_point_mm
        ray = (TARGETS_MM - focal) / np.linalg.norm(TARGETS_MM - focal, axis=1, keepdims=True)
        true = (TARGETS_MM - truth) / np.linalg.norm(TARGETS_MM - truth, axis=1, keepdims=True)
        assert np.abs(ray - true).max() < 0.03  # 20 mm of focal point at 620 mm, mostly along the beam


def test_rtk_gets_both_views_as_one_stack_too(exported: tuple[Path, dict]) -> None:
    folder, _ = exported
    for name, (view, image) in zip(("pa", "lateral"), read_projections(folder / "views.rtk.xml"), strict=True):
        alone = read_view(folder / f"{name}.opencv.json")
        assert np.abs(view.view().project(TARGETS_MM) - alone.view().project(TARGETS_MM)).max() < 1e-6
        height, width = alone.stated_shape()
        assert np.array_equal(image[:height, :width], read_image(folder / f"{name}.png").pixels)


def test_a_bead_is_found_where_the_exported_matrix_has_it(exported: tuple[Path, dict], frame) -> None:
    """The image's own detection against the matrix: beads of the source plate, which the undistortion does not fit."""
    from sightline.detection import detect

    folder, _ = exported
    found = detect(read_image(folder / "pa.png")).uv_px
    plate = frame.view("pa").source
    seen = read_view(folder / "pa.xreg.h5").view().project(plate.xyz_mm)
    size = read_image(folder / "pa.png").shape
    inner = ((seen > 40) & (seen < np.array(size[::-1]) - 40)).all(axis=1)
    apart = np.linalg.norm(found[None] - seen[inner, None], axis=2).min(axis=1)
    assert inner.sum() > 20
    assert np.median(apart) < 0.5


def test_undistorted_images_in_three_formats(run, pair, tmp_path: Path) -> None:
    ran = run("export", "undistorted", pair["lateral"], "--to", "png,npy,dicom", "--out", tmp_path, "--json")
    assert ran.code in (0, 3), ran.out
    png, npy, dicom = (read_image(tmp_path / f"lateral.{end}").pixels for end in ("png", "npy", "dcm"))
    assert np.array_equal(png, npy) and np.array_equal(png, dicom)
    assert read_view(tmp_path / "lateral.opencv.json").shape == png.shape


def test_a_plan_in_every_format(run, planned: Path, pair, tmp_path: Path) -> None:
    document = json.loads((planned / "plan.json").read_text())
    kinds = ["slicer", "mrb", "itk", "dicom", "csv"] + (["igtl"] if document["go"] else [])
    ran = run(
        "export", "plan", planned, "--to", ",".join(kinds), "--side", "left", "--case", "c-1", "--out", tmp_path,
        "--original", f"pa:{pair['pa']}", "--json",
    )  # fmt: skip
    assert ran.code == 0, ran.out
    assert {Path(file).parent.name for file in ran.document["files"]} == set(kinds)
    assert all(Path(file).is_file() for file in ran.document["files"])
    assert dcmread(tmp_path / "dicom" / "pa-original-state.dcm").PatientID == "c-1"
    verdict = "GO" if document["go"] else "NO-GO"
    assert ran.document["statement"].startswith(verdict)


def test_a_no_go_plan_is_no_robots_and_then_nothing_else_is_written_either(run, planned: Path, tmp_path: Path) -> None:
    plan = resealed(planned, tmp_path, go=False, verdict="no-go")
    ran = run("export", "plan", plan, "--to", "csv,igtl", "--out", tmp_path / "out")
    assert ran.code == 3
    assert "NO-GO" in ran.err
    assert not (tmp_path / "out").exists()


def resealed(planned: Path, folder: Path, **changed: object) -> Path:
    document = json.loads((planned / "plan.json").read_text()) | changed
    (folder / "plan.json").write_text(json.dumps(sealed(document)))
    return folder / "plan.json"


INCOMPLETE = {"go": False, "verdict": "incomplete"}


@pytest.mark.parametrize(
    ("changed", "arguments"),
    [
        ({"kind": "hip-screw", "side": None, **INCOMPLETE}, ("--side", "left")),
        ({"kind": "hip-screw", "side": "left", **INCOMPLETE}, ()),
        ({"kind": "my-hip", "side": "left", "checks": [{"name": "side", "passed": True}]}, ()),
    ],
)
def test_the_wire_of_a_hip_procedure_tells_its_side(run, planned: Path, tmp_path: Path, changed, arguments) -> None:
    """The entry lies caudal of the tip: +Y in a right hip. A plan that states the wrong side is refused as well."""
    ran = run("export", "plan", resealed(planned, tmp_path, **changed), "--out", tmp_path / "out", *arguments)
    assert ran.code == 2
    assert "left, but the wire is that of a right hip" in ran.said
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--to", "word"], "not a format of a plan"),
        (["--to", "slicer", "--side", "right"], "the plan is of the left side"),
        (["--original", "pa.dcm"], "VIEW:FILE"),
        (["--to", "csv", "--original", "pa:x.dcm"], "for --to dicom only"),
        (["--case", "Jane Doe"], "not a case number"),
    ],
)
def test_unusable_arguments(run, planned: Path, tmp_path: Path, arguments: list[str], words: str) -> None:
    ran = run("export", "plan", planned, *arguments, "--out", tmp_path / "out")
    assert ran.code == 2 and words in ran.err
    assert not (tmp_path / "out").exists()


def test_a_side_that_nothing_confirms_is_said(run, planned: Path, tmp_path: Path) -> None:
    plan = resealed(planned, tmp_path, side=None)
    ran = run("export", "plan", plan, "--to", "csv", "--side", "left", "--out", tmp_path / "out")
    assert ran.code == 0, ran.err
    assert "does not state its side" in ran.err and "--side left alone" in ran.err


def test_beads_alone_give_the_geometry_without_an_image(run, beads_csv: Path, tmp_path: Path) -> None:
    ran = run("export", "views", beads_csv, beads_csv, "--to", "deepdrr", "--out", tmp_path, "--json")
    assert ran.code in (0, 3), ran.out
    assert sorted(p.name for p in tmp_path.glob("[!.]*")) == ["lateral.deepdrr.json", "pa.deepdrr.json"]


@pytest.mark.parametrize("program", ["xmalab", "autoscoper"])
def test_the_name_of_a_program_is_that_of_its_format(program: str) -> None:
    pinhole = Pinhole.of_matrix(
        np.array([[4000.0, 0, 500, 3e5], [0, 4000, 500, 3e5], [0, 0, 1, 600]]), "pa", (900, 1000)
    )
    assert write_view(pinhole, program) == write_view(pinhole, "mayacam2")
    assert check_format(program) == "mayacam2"
