"""`sightline render`: the image that Python makes, from each kind of view; and what is refused."""

import gzip
from pathlib import Path

import nibabel
import numpy as np
from tests.imaging.test_rendered import SHAPE, ball, camera

import sightline as sl


def test_the_command_renders_what_python_does(run, tmp_path: Path):
    scan, matrix = ball(np.eye(3)), camera(np.eye(3))
    image = nibabel.Nifti1Image(scan.hu, np.diag([-1, -1, 1, 1]) @ np.diag([*scan.voxel_mm, 1.0]))
    image.affine[:3, 3] = np.array([-1, -1, 1]) * scan.origin_mm
    image.header.set_xyzt_units("mm")
    (tmp_path / "ct.nii.gz").write_bytes(gzip.compress(image.to_bytes()))
    np.savetxt(tmp_path / "matrix.csv", matrix, delimiter=",")
    sl.save(sl.view_from_matrix(matrix, name="ap"), tmp_path / "saved.json")
    pixels = sl.render(scan, sl.view_from_matrix(matrix), shape=SHAPE).pixels
    for view, out in [("matrix.csv", "drr.png"), ("saved.json", "drr.dcm")]:
        given = ("--view", tmp_path / view, "--size", f"{SHAPE[1]}x{SHAPE[0]}", "--out", tmp_path / out)
        ran = run("render", tmp_path / "ct.nii.gz", *given)
        assert ran.code == 0, ran.err
        assert np.abs(sl.read_image(tmp_path / out).pixels.astype(int) - pixels).max() <= 1
    for change, why in [
        (("--view", f"pa:{tmp_path / 'saved.json'}"), "holds ap; choose one"),
        (("--size", "520"), "is not WIDTHxHEIGHT"),
        (("--cortex", 3), "leave out --cortex"),
        (("--out", tmp_path / "drr.jpg"), "neither .dcm nor .png"),
    ]:
        ran = run("render", tmp_path / "ct.nii.gz", *given, *change)
        assert ran.code == 2
        assert why in ran.said
    assert not (tmp_path / "drr.jpg").exists()
