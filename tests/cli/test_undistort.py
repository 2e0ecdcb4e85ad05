"""`sightline undistort` puts the beads where the frame has them."""

import json
from pathlib import Path

import numpy as np
import pytest

from sightline.detection import detect
from sightline.imaging import read_image


@pytest.mark.slow  # tests/calibration/test_undistort.py proves the map
def test_on_the_plate_the_xrii_beads_stand_where_the_frame_has_them(run, pair, frame, tmp_path: Path) -> None:
    ran = run("undistort", pair["pa"], "--out", tmp_path / "plate", "--json")
    assert ran.code in (0, 3), ran.out
    document = json.loads((tmp_path / "plate" / "map.json").read_text())
    beads = detect(read_image(tmp_path / "plate" / "plate.png"))
    found_mm = np.array(document["origin_mm"]) + document["spacing_mm"] * beads.uv_px
    plate = frame.view("pa").xrii
    inner = np.abs(plate.plane.to_plane(plate.xyz_mm)).max(axis=1) < 60  # off the border of the picture
    wanted_mm = plate.plane.to_plane(plate.xyz_mm)[inner]
    apart = np.linalg.norm(found_mm[None] - wanted_mm[:, None], axis=2).min(axis=1)
    assert np.median(apart) < 0.15  # frame errors of 0.05 mm per bead and 0.05 mm per plate are in the scene

    with np.load(tmp_path / "plate" / "map.npz") as arrays:
        assert list(arrays["uv_px"].shape[:2]) == document["shape"]
        assert arrays["inside_hull"].shape == arrays["uv_px"].shape[:2]
