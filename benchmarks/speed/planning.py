"""Processor time for a dragged point: its curve in the other view, and the whole plan; one thread.

The views are calibrated by `smooth` from the beads of one random set-up. The app must draw the curve within 50 ms of
the pointer event, including the browser's share. No peer does this. The previous values come from the same views on the
same machine, when the visible part of a curve was found by bisection.
"""

import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np

import sightline as sl
from benchmarks.rows import Row
from sightline.frame import Frame
from sightline.planning import corridor, kind, matching_curve, plan
from sightline.studies.scenes import WHOLE, draw_scene

CURVE_MS, PLAN_MS, CORRIDOR_MS = 5.0, 15.0, 3.0
BEFORE = {"curve": "48 ms", "plan": "113 ms"}  # on two busy cores, beside 4.0 and 17 ms now
RUNS = 300
BEAD_PX = 0.1
LINE_MM = np.array([[31.0, 24.0, -9.0], [-22.0, -26.0, 11.0]])
LANDMARKS_MM = np.array([[-21.3, -17.9, 4.4], [12.2, 30.1, -16.8]])


def run(quick: bool) -> list[Row]:
    """Return the rows of this benchmark."""
    told = replace(Frame.load("gamma"), tolerances=WHOLE)
    scene = draw_scene(np.random.default_rng(3), told, BEAD_PX, targets=4)
    views = [sl.calibrate(one, told) for one in scene.observations.values()]
    uv = np.array([view.project(LINE_MM) for view in views])
    landmarks = np.array([view.project(LANDMARKS_MM) for view in views])
    rng = np.random.default_rng(4)

    def dragged() -> np.ndarray:
        return uv + rng.uniform(-15.0, 15.0, 2) * np.array([1.0, 0.0])[:, None, None]

    def planned() -> object:
        at = dragged()
        return plan(views, at[:, 0], at[:, 1], snapped=True, landmarks_uv_px=landmarks, kind=kind("free-wire"))

    made = plan(views, uv[:, 0], uv[:, 1], kind=kind("free-wire"))
    runs = RUNS // 10 if quick else RUNS
    cases = (
        (
            "curve of a dragged point",
            lambda: matching_curve(views[0], dragged()[0, 0], views[1]).half_width_px,
            CURVE_MS,
            "curve",
        ),
        ("plan of two snapped points and two landmarks", planned, PLAN_MS, "plan"),
        ("corridor of the wire in a view", lambda: corridor(views[0], made.trajectory), CORRIDOR_MS, ""),
    )
    return [_row(name, _times(call, runs), limit, BEFORE.get(key, "")) for name, call, limit, key in cases]


def _row(name: str, ms: np.ndarray, limit: float, before: str) -> Row:
    middle, most = np.median(ms), np.quantile(ms, 0.95)
    return Row(
        "planning",
        f"{name}: least; median; 95 %",
        f"{ms.min():.1f}; {middle:.1f}; {most:.1f} ms",
        f"median <= {limit:g} ms",
        f"before {before}" if before else "",
        bool(middle <= limit),
    )


def _times(call: Callable[[], object], runs: int) -> np.ndarray:
    """Return the processor time of this thread, ms, of each run, after two warm-up runs."""
    out = []
    for _ in range(runs + 2):
        started = time.thread_time()
        call()
        out.append(1e3 * (time.thread_time() - started))
    return np.array(out[2:])
