"""A run of tracked points as CSV of XMALab's columns to points in space with covariances, and its processor time.

Twenty markers that move together by a few mm, in two views calibrated on the demo's kind of set-up, 0.3 px of noise.
"""

import time
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from benchmarks.harness import Rows
from sightline.calibration.exchange.point_table import read_points
from sightline.frame import Frame
from sightline.planning.points.many import ManySolver
from sightline.studies.scenes import calibrated_views, draw_scene

MARKERS, FRAMES, SD_PX, FIRST_SEED = 20, 50_000, 0.3, 4
MAX_S = 60.0


def run(quick: bool) -> Rows:
    """Return the rows of this benchmark."""
    rows = Rows("reconstruct")
    frames = FRAMES // 50 if quick else FRAMES
    rng = np.random.default_rng(FIRST_SEED)
    scene = draw_scene(rng, Frame.load("gamma"), 0.1, targets=1)
    views = calibrated_views(scene.setup, scene.observations)
    sway = np.sin(np.arange(frames)[:, None] / [50.0, 70.0, 30.0]) * [8.0, 6.0, 5.0]
    xyz = (rng.uniform(-30.0, 30.0, (MARKERS, 3)) + sway[:, None]).reshape(-1, 3)
    uv = np.array([np.concatenate([view.project(part) for part in np.array_split(xyz, 128)]) for view in views])
    uv += rng.normal(0.0, SD_PX, uv.shape)
    header = ",".join(f"m{k}_cam{c}_{axis}" for k in range(MARKERS) for c in (1, 2) for axis in "XY")
    with TemporaryDirectory() as folder:
        path = Path(folder) / "points.csv"
        cells = uv.reshape(2, frames, MARKERS, 2).transpose(1, 2, 0, 3).reshape(frames, -1)
        np.savetxt(path, cells, "%.3f", ",", header=header, comments="")
        started, used = time.perf_counter(), time.process_time()
        table = read_points(path, [view.name for view in views])
        found = ManySolver(views).solve(table.uv_px, np.full(table.sd_px.shape, SD_PX))
        used, wall = time.process_time() - used, time.perf_counter() - started
    assert not found.reason.any()  # all points lie within both images
    rows.number(f"{len(xyz):,} points read and reconstructed, processor time", used, ".0f", "s", most=MAX_S)
    rows.add("the same, elapsed", f"{wall:.0f} s")
    return rows
