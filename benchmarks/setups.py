"""Random set-ups of the Γ frame, shared by the benchmarks of accuracy and honesty. Committed before anything was tuned.

Poses, distortions and frame errors are those of `sightline.twin.draw_setup`, with its defaults. Targets are uniform
in a cube about the hip, drawn again unless both images show them and, where `surrounded` is asked, unless the visible
beads of each plate surround them (the paper's map knows nothing outside).
"""

import os
from collections.abc import Callable, Iterable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from multiprocessing import get_context
from typing import Any
from unittest.mock import patch

import numpy as np
from scipy.spatial import Delaunay

from sightline.detection import Observations
from sightline.frame import Frame, Tolerances
from sightline.studies.bound import Seen
from sightline.twin import SetUp, bead_images, draw_setup

VIEWS = ("pa", "lateral")
WIRE_MM = 34.0  # half a 95 mm wire at 45° (physics.md, Frame)
FAR_MM = 55.0  # beyond the beads' hulls, which reach 44 mm at the hip
EXACT = Tolerances(0.0, 0.0, 0.0, 0.0, 0.0)
BEADS_20UM = Tolerances(0.02, 0.0, 0.0, 0.0, 0.0)
WHOLE = Tolerances()  # bead, plate and arm (physics.md, Frame)
MARGIN_PX = 15.0  # a target is shown if it lies this far inside the field


@dataclass(frozen=True, eq=False)
class Scene:
    """A set-up, what is measured of its beads, and T targets: `target_mm` (T, 3), true pixels `target_px` (2, T, 2)."""

    setup: SetUp
    observations: dict[str, Observations]
    target_mm: np.ndarray
    target_px: np.ndarray

    @property
    def frame(self) -> Frame:
        """What the software is told of the frame."""
        return self.setup.frame

    def seen(self, pick_px2: np.ndarray, across_px: np.ndarray | None = None) -> dict[str, Seen]:
        """What the bound is told: picks (2, 2, 2) of one target."""
        across = np.zeros((2, 2)) if across_px is None else across_px
        return {
            name: Seen(self.observations[name].ids, self.observations[name].covariance_px2, pick_px2[k], across[k])
            for k, name in enumerate(VIEWS)
        }


def draw_scene(
    seed: int,
    tolerances: Tolerances,
    bead_px: float,
    *,
    targets: int,
    reach_mm: float = WIRE_MM,
    surrounded: bool = True,
    uneven: float = 0.0,
) -> Scene:
    """One scene. `uneven`: the beads' own standard deviations are `bead_px` times exp(uneven * N(0, 1))."""
    rng = np.random.default_rng(seed)
    frame = replace(Frame.load("gamma"), tolerances=tolerances)
    setup = draw_setup(rng, frame)
    observations = {}
    for name in VIEWS:
        ids, exact = bead_images(setup, name, rng, sd_px=0.0)
        sd = bead_px * np.exp(uneven * rng.standard_normal(len(ids)))
        measured = exact + sd[:, None] * rng.standard_normal(exact.shape)
        observations[name] = Observations(name, ids, measured, sd[:, None, None] ** 2 * np.eye(2))
    hulls = {n: _plate_hulls(setup, n, observations[n]) if surrounded else [] for n in VIEWS}
    xyz = np.array([_draw_target(rng, setup, reach_mm, hulls) for _ in range(targets)])
    return Scene(setup, observations, xyz, np.array([setup.views[name].project(xyz) for name in VIEWS]))


def _plate_hulls(setup: SetUp, name: str, seen: Observations) -> list[Delaunay]:
    view = setup.frame.view(name)
    return [Delaunay(seen.uv_px[np.isin(seen.ids, plate.ids)]) for plate in (view.xrii, view.source)]


def _draw_target(
    rng: np.random.Generator, setup: SetUp, reach_mm: float, hulls: dict[str, list[Delaunay]]
) -> np.ndarray:
    while True:
        xyz = rng.uniform(-reach_mm, reach_mm, 3)
        uv = {name: setup.views[name].project(xyz[None]) for name in VIEWS}
        shown = all(setup.views[name].in_field(uv[name], MARGIN_PX)[0] for name in VIEWS)
        if shown and all(hull.find_simplex(uv[name])[0] >= 0 for name in VIEWS for hull in hulls[name]):
            return xyz


def in_parallel(function: Callable[[Any], Any], arguments: Iterable[Any]) -> list[Any]:
    """`function` of each argument on all cores, one thread each, in order."""
    one_thread = dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "NUMBA_NUM_THREADS"), "1")
    pool = ProcessPoolExecutor(os.cpu_count(), mp_context=get_context("spawn"))
    with patch.dict(os.environ, one_thread), pool:
        return list(pool.map(function, arguments, chunksize=4))
