"""`sightline detect` on an image of the twin, whose beads are known."""

from pathlib import Path

import cv2
import numpy as np

from sightline.imaging import read_image


def test_the_beads_found_are_the_beads_of_the_scene(run, pair, setup, tmp_path: Path) -> None:
    files = ("--csv", tmp_path / "beads.csv", "--picture", tmp_path / "beads.png")
    assert "radius px" in run("detect", pair["pa"]).out
    ran = run("detect", pair["pa"], "--json", *files)
    assert ran.code == 0, ran.err
    found = np.array([bead["uv_px"] for bead in ran.document["beads"]])
    truth = setup.views["pa"]
    xyz_mm = np.array([f.xyz_mm for f in setup.true_frame.view("pa").fiducials])
    uv_px = truth.project(xyz_mm)
    nearest = np.linalg.norm(uv_px[:, None] - found[None], axis=2).min(axis=1)[truth.in_field(uv_px)]
    assert np.mean(nearest < 1.0) > 0.8  # those over the femur or another bead may be missed
    assert ran.document["image_shape"] == list(read_image(pair["pa"]).shape)
    assert all(candidate["reason"] for candidate in ran.document["rejected"])

    header, *rows = (tmp_path / "beads.csv").read_text().splitlines()
    assert header.startswith("u_px,v_px,radius_px,suu_px2")
    np.testing.assert_array_equal([[float(x) for x in row.split(",")[:2]] for row in rows], found)
    picture = cv2.imread(str(tmp_path / "beads.png"))
    assert picture.shape == (*(2 * side for side in read_image(pair["pa"]).shape), 3)
    assert (picture == (80, 220, 80)).all(axis=2).any()
