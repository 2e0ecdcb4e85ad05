"""Hole of a nail from two views: error, coverage, refusals and time.

Points are those of scenes_hole.py, on views calibrated from their beads. The sizes of the nail differ from the stated
ones by machining tolerances. `python -m benchmarks.bench_interlocking COUNT`
prints the rows of so many nails as points.
"""

import sys
import time
from dataclasses import replace
from itertools import product

import numpy as np
from scipy.stats import chi2

import sightline as sl
from benchmarks.parallel import in_parallel
from benchmarks.rows import Row
from benchmarks.scenes_hole import Sight, Trial, ends_of_outlines, scored, seen
from benchmarks.scenes_solid import BEAD_PX, c_arms
from sightline.calibration import CalibratedView
from sightline.calibration.together import calibrate_together
from sightline.errors import RefusedError
from sightline.frame import Frame
from sightline.interlocking import find_hole, find_nail
from sightline.planning import Hole, Nail, fit_hole
from sightline.studies.scenes import measure
from sightline.twin import SetUp, draw_setup
from sightline.twin.arm import beam_at
from sightline.twin.nails import DistalNail, draw_nail, nail_scene
from sightline.twin.render import expose
from sightline.twin.things import frame_scene

NAILS = 1000
POINTS = "interlocking, nails as points, "
MAX_MM, MAX_DEG, COVERAGE = 0.3, 0.7, 0.02  # of 95 % of the nails; of the stated 95 % regions
HALF_ANGLE_DEG = 16.0  # of the views of a block, to either side of the hole: both see through it
OTHERS = (("block30", 0.3), ("block60", 0.0), ("gamma", 0.0))
RENDERED = 10  # nails for each of
CHAINS = (("block30", "flat-panel"), ("stereo", "9in-1k"), ("stereo", "9in-pal"), ("stereo", "17cm-1k"))
CLICK_PX, STROKE_MM = 2.0, 18.0  # s.d. of a click per axis; half the length of a stroke


def run(quick: bool) -> list[Row]:
    """Return the rows of this benchmark."""
    return points(NAILS // 10 if quick else NAILS) + rendered(1 if quick else RENDERED)


def rendered(number: int) -> list[Row]:
    """Return the rows of a number of rendered nails for each image chain."""
    trials = in_parallel(_rendered, product(CHAINS, range(number)))
    rows: list[Row] = []
    for k, (frame, chain) in enumerate(CHAINS):
        own = trials[k * number : (k + 1) * number]
        rows += _rows(f"interlocking, rendered, {chain}, {frame}, strokes and clicks 2 px off", own)
    return rows


def points(number: int) -> list[Row]:
    """Return the rows of a number of nails as points, with block30; fewer with the other frames."""
    rows: list[Row] = []
    for frame, hidden, count in (("block30", 0.0, number), *((one, share, number // 4) for one, share in OTHERS)):
        name = POINTS + frame + (f", {hidden:.0%} of each rim hidden" if hidden else "")
        trials = in_parallel(_trial, product((frame,), (hidden,), range(count)))
        rows += _rows(name, trials, required=count == number)
    return rows


def views_and_nail(
    rng: np.random.Generator, frame: str, chain: str | None = None
) -> tuple[SetUp, list[CalibratedView], DistalNail]:
    """Draw a set-up, its calibrated views, and a nail at the middle of what both show.

    A block is seen from 16° to either side of the hole, as the plates of a stereo frame are; those of a Γ frame fix its
    views 90° apart.
    """
    known = Frame.load(frame)
    half = np.radians(HALF_ANGLE_DEG)
    beams = None if known.solid is None else {"pa": beam_at(-half), "lateral": beam_at(half)}
    setup = draw_setup(rng, known, chain=chain, views=beams)
    observations = measure(rng, setup, BEAD_PX)
    views: list[CalibratedView]
    if known.solid is None:
        views = [sl.calibrate(one, known) for one in observations.values()]
    else:
        views = list(calibrate_together(list(observations.values()), known, c_arms(setup)))
    towards = beam_at(np.radians(45.0) if frame == "gamma" else 0.0)
    nail = draw_nail(rng, setup.hip_mm + rng.uniform(-10.0, 10.0, 3), towards)
    off_mm = 2 * Nail().sd_mm * rng.standard_normal(2)
    made = replace(nail, diameter_mm=nail.diameter_mm + off_mm[0], hole_diameter_mm=nail.hole_diameter_mm + off_mm[1])
    return setup, views, made


def known_nail(nail: DistalNail) -> Nail:
    """Return what the software is told of a nail: its nominal sizes."""
    return Nail(round(nail.diameter_mm), round(nail.hole_diameter_mm), nail.bore_mm, nail.material)


def _trial(case: tuple[str, float, int]) -> Trial | str:
    """Return the errors of one nail as points, or why it was refused."""
    frame, hidden, seed = case
    rng = np.random.default_rng([seed, len(frame)])
    setup, views, nail = views_and_nail(rng, frame)
    sights = {name: Sight(view.focal_point_mm, view.project) for name, view in setup.views.items()}
    edges = seen(rng, nail, sights, hidden=hidden, lens=setup.frame.solid is not None)
    start = time.perf_counter()
    try:
        hole = fit_hole(views, edges, known_nail(nail))
    except RefusedError as refused:
        return str(refused)
    return _outcome(hole, nail, time.perf_counter() - start)


def _rendered(case: tuple[tuple[str, str], int]) -> Trial | str:
    """Return the errors of one rendered nail, found from strokes and clicks, or why it was refused."""
    (frame, chain), seed = case
    rng = np.random.default_rng([seed, 7])
    setup, views, nail = views_and_nail(rng, frame, chain)
    scene = frame_scene(setup.true_frame) + nail_scene(nail)
    truths = list(setup.views.values())
    images = [expose(truth, scene).read_out(rng) for truth in truths]
    sights = [Sight(truth.focal_point_mm, truth.project) for truth in truths]
    strokes = np.array([ends_of_outlines(nail, sight, STROKE_MM) for sight in sights])
    clicks = np.array([truth.project(nail.hole_mm[None])[0] for truth in truths])
    try:
        found = find_nail(views, images, strokes + CLICK_PX * rng.standard_normal(strokes.shape), known_nail(nail))
        start = time.perf_counter()
        hole = find_hole(found, clicks + CLICK_PX * rng.standard_normal(clicks.shape))
    except RefusedError as refused:
        return str(refused)
    return _outcome(hole, nail, time.perf_counter() - start)


def _outcome(hole: Hole, nail: DistalNail, time_s: float) -> Trial | str:
    """Return the errors of a hole, or which of its checks failed."""
    return scored(hole, nail, time_s) if hole.passed else "; ".join(one.name for one in hole.checks if not one.passed)


def _rows(group: str, trials: list[Trial | str], *, required: bool = False) -> list[Row]:
    kept = [trial for trial in trials if isinstance(trial, Trial)]
    refused = Row(group, "refused", f"{len(trials) - len(kept)} of {len(trials)}")
    if not kept:
        return [refused]
    mm, deg = (float(np.quantile([getattr(t, key) for t in kept], 0.95)) for key in ("off_mm", "off_deg"))
    covered = float(np.mean([t.square <= chi2.ppf(0.95, 4) for t in kept]))
    met = (mm <= MAX_MM and deg <= MAX_DEG, abs(covered - 0.95) <= COVERAGE) if required else (None, None)
    return [
        Row(
            group,
            "error of the axis, 95 %",
            f"{mm:.3f} mm, {deg:.2f}° of {len(kept)}",
            f"<= {MAX_MM} mm, {MAX_DEG}°" if required else "",
            "Esfandiari 2016: below 0.5 mm, 2°",
            met[0],
        ),
        Row(
            group,
            "95 % regions of axis and direction cover",
            f"{100 * covered:.1f} %",
            f"95 ± {100 * COVERAGE:.0f} %" if required else "",
            "",
            met[1],
        ),
        refused,
        Row(group, "time after the last click, median", f"{1e3 * np.median([t.time_s for t in kept]):.0f} ms"),
    ]


if __name__ == "__main__":
    for row in points(int(sys.argv[1])):
        print(row.group, row.name, row.value, row.required, row.met, sep=" | ")
