"""Hole of a nail from two views: error, coverage, refusals, advice and time.

Points are those of nail_edges.py, on views calibrated from their beads. The sizes of the nail differ from the
stated ones by machining tolerances. Images are the twin's, and those whose rays gVirtualXray casts (gvxr_nails.py;
optional: `pip install gvxr`). Finished nails are kept in out/bench: the same command goes on with a stopped run.
"""

import time
from dataclasses import replace
from importlib.util import find_spec
from itertools import product

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

import sightline as sl
from benchmarks.holes.gvxr_nails import cast, image, window_px
from benchmarks.holes.nail_edges import Sight, ends_of_outlines, seen
from benchmarks.holes.scores import Trial, scored
from benchmarks.parallel import in_parallel
from benchmarks.rows import Row
from benchmarks.solid.scenes import BEAD_PX, c_arms
from sightline.calibration import CalibratedView
from sightline.calibration.solids.calibrate_together import calibrate_together
from sightline.errors import RefusedError, SetUpError
from sightline.frame import Frame
from sightline.from_images.interlocking import find_hole, find_nail
from sightline.imaging import Radiograph
from sightline.planning import Hole, Nail, fit_hole, perfect_circle
from sightline.studies.scenes import measure
from sightline.twin import SetUp, ViewTruth, draw_setup
from sightline.twin.anatomy.nailed_femur import DistalNail, draw_nail, nail_scene
from sightline.twin.objects.things import frame_scene
from sightline.twin.xray.distributions import beam_at
from sightline.twin.xray.render import expose

NAILS = 1000
POINTS = "interlocking, nails as points, "
MAX_MM, MAX_DEG, COVERAGE = 0.3, 0.7, 0.02  # of 95 % of the nails; of the stated 95 % regions
HALF_ANGLE_DEG = 16.0  # of the views of a block, to either side of the hole: both see through it
OTHERS = (("block30", 0.3), ("block60", 0.0), ("gamma", 0.0))
RENDERED = 10  # nails of the twin's images for each of
CHAINS = (("block30", "flat-panel"), ("stereo", "9in-1k"), ("stereo", "9in-pal"), ("stereo", "17cm-1k"))
CAST = 50  # nails of another projector for each of
# Streams of seeds of these nails: on the first the method was tuned, on the second it is judged and never tuned.
TUNED, JUDGED = 12, 13
PROJECTED = "interlocking, rays cast by gVirtualXray"
MOVED_MM = (0.5, 2.0)  # how far a nail moves between the images, along the beam of the second
WRONG_MM, WRONG_DEG = 0.5, 5.2  # beyond these a drill of 4 mm touches a hole of 5 mm
MAX_TURN_DEG = 2.0
CLICK_PX, STROKE_MM = 2.0, 18.0  # s.d. of a click per axis; half the length of a stroke


def run(quick: bool) -> list[Row]:
    """Return the rows of this benchmark."""
    rows = points(NAILS // 10 if quick else NAILS) + rendered(1 if quick else RENDERED)
    if find_spec("gvxrPython3") is None:
        return [*rows, Row(PROJECTED, "images", "not installed", "", "pip install gvxr")]
    return rows + projected(
        in_parallel(project_nail, product(CHAINS, range(1 if quick else CAST)), "interlocking-cast")
    )


def rendered(number: int) -> list[Row]:
    """Return the rows of a number of rendered nails for each image chain."""
    trials = in_parallel(_rendered, product(CHAINS, range(number)), "interlocking-rendered")
    rows: list[Row] = []
    for k, (frame, chain) in enumerate(CHAINS):
        own = trials[k * number : (k + 1) * number]
        rows += _rows(f"interlocking, rendered, {chain}, {frame}, strokes and clicks 2 px off", own)
    return rows


def projected(trials: "list[Pair | str]") -> list[Row]:
    """Return the rows of nails of another projector, the same number for each image chain."""
    number = len(trials) // len(CHAINS)
    drawn = [one for one in trials if not isinstance(one, str)]
    if not drawn:
        return [Row(PROJECTED, "images", f"no set-up: {trials[0]}")]
    rows = _rows(f"{PROJECTED}, strokes and clicks 2 px off", [plain for plain, _ in drawn], required=True)
    for k, (frame, chain) in enumerate(CHAINS):
        own = [one[0] for one in trials[k * number : (k + 1) * number] if not isinstance(one, str)]
        rows += _rows(f"{PROJECTED}, {chain}, {frame}", own)
    hidden = [outcome for _, outcome in drawn]
    found = [one for one in hidden if isinstance(one, Trial)]
    wrong = sum(one.off_mm > WRONG_MM or one.off_deg > WRONG_DEG for one in found)
    name = f"with 30 % of the rims hidden: found / refused / off by more than {WRONG_MM} mm or {WRONG_DEG}°"
    value = f"{len(found)} / {len(hidden) - len(found)} / {wrong}"
    return [*rows, Row(PROJECTED, name, value, "none wrong", "", wrong == 0)]


def points(number: int) -> list[Row]:
    """Return the rows of a number of nails as points, with block30; fewer with the other frames."""
    rows: list[Row] = []
    for frame, hidden, count in (("block30", 0.0, number), *((one, share, number // 4) for one, share in OTHERS)):
        name = POINTS + frame + (f", {hidden:.0%} of each rim hidden" if hidden else "")
        trials = in_parallel(_trial, product((frame,), (hidden,), range(count)), "interlocking-points")
        rows += _rows(name, trials, required=count == number)
    return rows + moved(number // 4)


def moved(number: int) -> list[Row]:
    """Return the rows of nails as points that move between the images along a beam, which no image shows."""
    trials = in_parallel(_moved, range(number), "interlocking-moved")
    wrong = [one.off_mm > WRONG_MM for one in trials if isinstance(one, Trial)]
    off = np.quantile([one.off_mm for one in trials if isinstance(one, Trial)] or [np.nan], (0.5, 0.95))
    group = f"{POINTS}block30, moved by {MOVED_MM[0]} to {MOVED_MM[1]} mm along the second beam"
    return [
        Row(group, "no check fails", f"{len(wrong)} of {number}"),
        Row(group, f"of these, axis off by more than {WRONG_MM} mm", f"{sum(wrong)} of {len(wrong)}"),
        Row(group, "error of the axis, median / 95 %", f"{off[0]:.2f} / {off[1]:.2f} mm"),
    ]


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
    start = time.process_time()
    try:
        hole = fit_hole(views, edges, known_nail(nail))
    except RefusedError as refused:
        return str(refused)
    outcome = _outcome(hole, nail, time.process_time() - start)
    return outcome if isinstance(outcome, str) else replace(outcome, turned_deg=_turned_deg(hole, nail, setup, views))


def _moved(seed: int) -> Trial | str:
    """Return the errors of one nail that moved along the second beam after the first image, from where it is at the
    second; or why it was refused."""
    rng = np.random.default_rng([seed, 31])
    setup, views, nail = views_and_nail(rng, "block30")
    (first, at), (second, then) = (
        (name, Sight(view.focal_point_mm, view.project)) for name, view in setup.views.items()
    )
    beam = nail.hole_mm - then.focal_mm
    moved = replace(nail, hole_mm=nail.hole_mm + rng.uniform(*MOVED_MM) * beam / np.linalg.norm(beam))
    edges = seen(rng, nail, {first: at}) + seen(rng, moved, {second: then})
    try:
        return _outcome(fit_hole(views, edges, known_nail(nail)), moved, 0.0)
    except RefusedError as refused:
        return str(refused)


def _rendered(case: tuple[tuple[str, str], int]) -> Trial | str:
    """Return the errors of one rendered nail, found from strokes and clicks, or why it was refused."""
    (frame, chain), seed = case
    rng = np.random.default_rng([seed, 7])
    setup, views, nail = views_and_nail(rng, frame, chain)
    scene = frame_scene(setup.true_frame) + nail_scene(nail)
    truths = list(setup.views.values())
    images = [expose(truth, scene).read_out(rng) for truth in truths]
    strokes, clicks = _drawn(nail, truths)
    strokes = strokes + CLICK_PX * rng.standard_normal(strokes.shape)
    return _found(views, images, strokes, clicks + CLICK_PX * rng.standard_normal(clicks.shape), nail)


Pair = tuple[Trial | str, Trial | str]


def project_nail(case: tuple[tuple[str, str], int], stream: int = JUDGED) -> Pair | str:
    """Return the outcomes of one nail whose rays gVirtualXray casts, its rims whole and hidden in part; or why there is
    no such set-up."""
    (frame, chain), seed = case
    rng = np.random.default_rng([seed, stream])
    try:
        setup, views, nail = views_and_nail(rng, frame, chain)
    except SetUpError as refused:
        return str(refused)
    truths = list(setup.views.values())
    strokes, clicks = _drawn(nail, truths)
    windows = [window_px(truth, own) for truth, own in zip(truths, strokes, strict=True)]
    rays = [cast(truth, nail, setup.true_frame, px) for truth, px in zip(truths, windows, strict=True)]
    strokes = strokes + CLICK_PX * rng.standard_normal(strokes.shape)
    clicks = clicks + CLICK_PX * rng.standard_normal(clicks.shape)
    whole, hidden = (
        [image(*one, rng, material=nail.material, hidden=hides) for one in zip(truths, rays, windows, strict=True)]
        for hides in (False, True)
    )
    return (
        _found(views, whole, strokes, clicks, nail),
        _found(views, hidden, strokes, clicks, nail),
    )


def _drawn(nail: DistalNail, truths: list[ViewTruth]) -> tuple[np.ndarray, np.ndarray]:
    """Return strokes (2, 2, 2, 2) and clicks (2, 2) without error."""
    sights = [Sight(truth.focal_point_mm, truth.project) for truth in truths]
    strokes = np.array([ends_of_outlines(nail, sight, STROKE_MM) for sight in sights])
    return strokes, np.array([truth.project(nail.hole_mm[None])[0] for truth in truths])


def _found(
    views: list[CalibratedView], images: list[Radiograph], strokes: np.ndarray, clicks: np.ndarray, nail: DistalNail
) -> Trial | str:
    """Return the outcome of a hole in images; its time is the processor's from the last click on."""
    try:
        found = find_nail(views, images, strokes, known_nail(nail))
        start = time.process_time()
        hole = find_hole(found, clicks)
    except RefusedError as refused:
        return str(refused)
    return _outcome(hole, nail, time.process_time() - start)


def _turned_deg(hole: Hole, nail: DistalNail, setup: SetUp, views: list[CalibratedView]) -> float:
    """Return how far the beam through the hole is from its axis, °, after the advised turn from the first view.

    The arm turns about the hip's place, by its own axis of the orbit.
    """
    turn = perfect_circle(hole, views)
    sources = [truth.focal_point_mm for truth in setup.views.values()]
    beams = [(nail.hole_mm - source) / np.linalg.norm(nail.hole_mm - source) for source in sources]
    axis = np.cross(*beams)
    orbit = Rotation.from_rotvec(turn.orbit_rad * axis / np.linalg.norm(axis))
    aside = np.cross(orbit.apply(beams[0]), axis)
    tilt = Rotation.from_rotvec(turn.tilt_rad * aside / np.linalg.norm(aside))
    source = setup.hip_mm + (tilt * orbit).apply(sources[0] - setup.hip_mm)
    beam = nail.hole_mm - source
    return float(np.rad2deg(np.arccos(min(abs(beam @ nail.holes[0, 1]) / np.linalg.norm(beam), 1.0))))


def _outcome(hole: Hole, nail: DistalNail, time_s: float) -> Trial | str:
    """Return the errors of a hole, or which of its checks failed."""
    return scored(hole, nail, time_s) if hole.passed else "; ".join(one.name for one in hole.checks if not one.passed)


def _turned_row(group: str, off_deg: list[float]) -> list[Row]:
    if not off_deg:
        return []
    most, name = float(np.quantile(off_deg, 0.95)), "beam off the hole's axis after the advised turn, 95 %"
    return [Row(group, name, f"{most:.2f}°", f"<= {MAX_TURN_DEG}°", "", most <= MAX_TURN_DEG)]


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
        Row(group, "time after the last click, median", f"{np.median([1e3 * t.time_s for t in kept]):.0f} ms"),
        *_turned_row(group, [t.turned_deg for t in kept if required and np.isfinite(t.turned_deg)]),
    ]
