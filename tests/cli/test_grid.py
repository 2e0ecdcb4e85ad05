"""`sightline grid`: a sheet of a drawn image, its map as a file that is read again, its picture."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

import sightline as sl
from sightline.calibration.maps.grid import GridMap
from sightline.imaging import Radiograph, write_dicom

PX = 30.0  # pitch of the drawn sheet
SIDE = 400


def sheet(scale: float = 1.0, seed: int = 1) -> Radiograph:
    """Blurred dark discs on a square lattice that a pincushion of 2 % bends; `scale` of one direction."""
    v, u = np.mgrid[:SIDE, :SIDE] - (SIDE - 1) / 2
    bent = 1 - 5e-7 * (u**2 + v**2)
    x, y = u * bent + 0.1 * v * bent, (v * bent - 0.1 * u * bent) * scale
    off = np.hypot((x / PX - np.rint(x / PX)) * PX, (y / PX - np.rint(y / PX)) * PX)
    noise = np.random.default_rng(seed).normal(0, 12, u.shape)
    pixels = cv2.GaussianBlur(3000 - 1500.0 * (off < 6), (0, 0), 1.2) + noise
    return Radiograph(pixels.astype(np.uint16), 4095.0)


@pytest.fixture(scope="module")
def image(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_dicom(sheet(), tmp_path_factory.mktemp("grid") / "sheet.dcm")


def test_a_map_is_written_and_read_again(run, image: Path, tmp_path: Path) -> None:
    out, picture = tmp_path / "map.json", tmp_path / "residuals.png"
    told = run("grid", image, "--pitch", 5, "--out", out, "--picture", picture, "--json")
    assert told.code == 0, told.err
    document = told.document
    assert document["pattern"] == "square" and document["kind"] == "ball" and document["points"] > 130
    assert document["spacing_mm"] == pytest.approx(5 / PX, rel=0.02)
    assert document["sd_rms_px"] < document["leave_one_out_rms_px"] < 0.1
    assert picture.read_bytes().startswith(b"\x89PNG")
    grid = sl.load(out, GridMap)
    written = json.loads(out.read_text())
    assert {key: written[key] for key in grid.document()} == grid.document()
    assert grid.left_out == document["left_out"]
    out.write_text(json.dumps(written | {"pitch_mm": 6.0}))
    with pytest.raises(sl.errors.UnusableInputError, match="changed after"):
        sl.load(out)


def test_it_says_what_the_map_means(run, image: Path, tmp_path: Path) -> None:
    told = run("grid", image, "--pitch", 5, "--out", tmp_path / "map.json")
    assert told.code == 0
    assert "on a square lattice of 5 mm" in told.out and "knows no depth" in told.out
    assert "an undistorted pixel is 0.16" in told.out and "by --pitch alone" in told.out


def test_a_stretched_sheet_is_refused_and_nothing_is_written(run, tmp_path: Path) -> None:
    image = write_dicom(sheet(scale=1.12), tmp_path / "sheet.dcm")
    told = run("grid", image, "--pitch", 5, "--out", tmp_path / "map.json")
    assert told.code == 3 and "stretched" in told.said
    assert not (tmp_path / "map.json").exists()


def test_runs_are_undistorted_by_the_map(run, image: Path, tmp_path: Path) -> None:
    """The sheet's own image becomes regular; the same call again writes nothing."""
    assert run("grid", image, "--pitch", 5, "--out", tmp_path / "map.json").code == 0
    call = ("undistort", "--map", tmp_path / "map.json", image, "--out", tmp_path / "out", "--json")
    told = run(*call)
    assert told.code == 0, told.err
    assert (told.document["frames"], told.document["already"]) == ([1], 0)
    again = run("grid", told.document["files"][0], "--pitch", 5, "--out", tmp_path / "again.json", "--json").document
    assert again["largest_distortion_px"] < 0.3 < sl.load(tmp_path / "map.json").document()["largest_distortion_px"]
    assert again["spacing_mm"] == pytest.approx(told.document["spacing_mm"], rel=1e-3)
    assert run(*call).document["already"] == 1


@pytest.mark.parametrize("more", [("--frame", "gamma"), ("--spacing", 0.2)])
def test_a_map_and_beads_exclude_each_other(run, image: Path, tmp_path: Path, more: tuple[object, ...]) -> None:
    told = run("undistort", "--map", tmp_path / "map.json", image, "--out", tmp_path / "out", *more)
    assert told.code == 2 and "needs no beads" in told.said


def test_several_images_need_a_map(run, image: Path, tmp_path: Path) -> None:
    told = run("undistort", image, image, "--out", tmp_path / "out")
    assert told.code == 2 and "one image with beads" in told.said


def test_a_file_that_is_read_is_not_written_over(run, image: Path, tmp_path: Path) -> None:
    before = image.read_bytes()
    told = run("grid", image, "--pitch", 5, "--out", tmp_path / "map.json", "--picture", image)
    assert told.code == 2 and "to read and to write" in told.said
    points = tmp_path / "points.csv"
    points.write_text("frame,point,view,u_px,v_px\n")
    told = run("reconstruct", points, "--views", tmp_path / "views.json", "--out", tmp_path / "." / "points.csv")
    assert told.code == 2 and "to read and to write" in told.said
    assert image.read_bytes() == before
