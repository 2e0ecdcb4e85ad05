"""Errors of a frame before and after a self-check, by the number of images.

Each trial draws a frame with the default tolerances and simulates images of it, half PA and half lateral, each with its
own C-arm pose and distortion; beads at 0.1 px. In one more pair, targets located to 0.1 px are reconstructed with the
frame's file and with the result of the self-check. The last column of a motion is its rms before any image; motions
that no image shows keep it.

Blocks: block60 as printed, balls 0.2 mm off, in 8 to 15 images on a flat panel, turned by up to 45° between them; beads
at 0.1 px and one distance known to 0.02 mm.
"""

from dataclasses import replace
from functools import partial

import numpy as np
from tests.calibration.solid_scenes import C_ARM, built, turned_images

import sightline as sl
from benchmarks.parallel import in_parallel
from benchmarks.rows import Row
from sightline.calibration.plates.self_check import MOTIONS, Errors, in_plate, plate_pairs, self_check
from sightline.calibration.solids.self_check import KnownDistance, self_check_solid
from sightline.common.geometry.rigid import rigid_fit
from sightline.detection import Observations
from sightline.errors import SightlineError
from sightline.frame import Frame, Tolerances
from sightline.studies.scenes import VIEWS
from sightline.twin import SetUp, bead_images, draw_setup
from sightline.twin.xray.setup import with_errors

TRIALS = 40
IMAGES = (4, 8, 16, 32)
BLOCKS, BLOCK_IMAGES, PRINTED_MM, DISTANCE_MM = 50, (8, 15), 0.2, 0.02
BEAD_PX = PICK_PX = 0.1
TARGETS, REACH_MM = 4, 25.0
FIRST_SEED = 40_000  # different from the other benchmarks'

Figures = dict[str, float]


def run(quick: bool) -> list[Row]:
    """Return the rows of this benchmark."""
    number = TRIALS // 10 if quick else TRIALS
    trials = in_parallel(trial, range(FIRST_SEED, FIRST_SEED + number))
    rows = []
    for count in IMAGES:
        done = [one[count] for one in trials if count in one]
        group = f"self-check, {count} images"
        if len(done) < len(trials):
            rows.append(Row(group, "refused", f"{len(trials) - len(done)} of {len(trials)}"))
        if not done:
            continue

        def rms(name: str, done: list[Figures] = done) -> float:
            return float(np.sqrt(np.mean([one[name] for one in done])))

        for name, unit, scale in (
            ("plate shift along itself", "mm", 1), ("plate shift along the beam", "mm", 1),
            ("plate tilt", "mrad", 1e3), ("plate twist", "mrad", 1e3),
            ("ball in its plate", "mm", 1), ("ball across its plate", "mm", 1), ("target", "mm", 1),
        ):  # fmt: skip
            value, before = (f"{scale * rms(key):.4f} {unit}" for key in (name, f"{name}, before"))
            rows.append(Row(group, name, value, "", f"before {before}"))
        square = float(np.mean([one["chi-square"] for one in done]))
        rows.append(Row(group, "mean chi-square / 678", f"{square:.3f}", "0.95-1.05", "", bool(0.95 <= square <= 1.05)))
    return rows + [row for count in BLOCK_IMAGES for row in _blocks(count, BLOCKS // 5 if quick else BLOCKS)]


def _blocks(images: int, number: int) -> list[Row]:
    """Return the rows of printed blocks."""
    done = in_parallel(partial(block, images), range(FIRST_SEED, FIRST_SEED + number))
    rms = float(np.sqrt(np.mean([one["error"] ** 2 for one in done])))
    square = float(np.mean([one["chi-square"] for one in done]))
    group, failed = f"self-check, printed block, {images} images", sum(one["failed"] for one in done)
    limit = 3 * np.sqrt(2 / (42 * number))  # three s.d. of a mean of so many blocks
    ball = f"before {PRINTED_MM} mm drawn"
    return [
        Row(group, f"ball, rms of {number} blocks", f"{rms:.4f} mm", "<= 0.02 mm", ball, bool(rms <= 0.02)),
        Row(group, "mean chi-square / 42", f"{square:.3f}", f"1 ± {limit:.2f}", "", bool(abs(square - 1) <= limit)),
        Row(group, "blocks with a failed check", f"{failed:.0f} of {number}"),
    ]


def block(images: int, seed: int) -> Figures:
    """Return the rms error of a block's balls after its self-check, and its chi-square over the 42 free numbers."""
    rng = np.random.default_rng(seed)
    sd = Tolerances(PRINTED_MM, 0.0, 0.0, 0.0, 0.0)
    frame = replace(Frame.load("block60"), name="printed", tolerances=sd)
    true = built(rng, frame)
    given = turned_images(rng, frame, true, images, BEAD_PX)
    length = float(np.linalg.norm(true[3] - true[0])) + DISTANCE_MM * rng.standard_normal()
    found = self_check_solid(given, frame, KnownDistance("b1", "b4", length, DISTANCE_MM), [C_ARM] * images)
    estimate, covariance = np.array([f.xyz_mm for f in found.frame.fiducials]), found.frame.covariance_mm2
    assert covariance is not None
    error = (rigid_fit(true, estimate).apply(true) - estimate).ravel()
    square = float(error @ np.linalg.pinv(covariance, rcond=1e-6, hermitian=True) @ error)
    failed = float(not all(check.passed for check in found.checks))
    return {"error": float(np.sqrt(np.mean(error**2))), "chi-square": square / (error.size - 6), "failed": failed}


def trial(seed: int) -> dict[int, Figures]:
    """Return the mean squares of one trial, by number of images."""
    rng = np.random.default_rng([seed, 6])
    frame = Frame.load("gamma")
    true = with_errors(frame, rng)
    errors = _places(true) - _places(frame)
    seen = [image(rng, draw_setup(rng, true, frame_errors=False), VIEWS[k % 2]) for k in range(max(IMAGES))]
    pair = draw_setup(rng, true, frame_errors=False)
    beads = [image(rng, pair, view) for view in VIEWS]
    targets = rng.uniform(-REACH_MM, REACH_MM, (TARGETS, 3))
    picks = np.array([pair.views[view].project(targets) for view in VIEWS])
    picks += PICK_PX * rng.standard_normal(picks.shape)
    out = {}
    for count in IMAGES:
        try:
            found = self_check(seen[:count], frame)
        except SightlineError:
            continue
        assert found.frame.covariance_mm2 is not None
        left = errors - found.moved_mm
        figures = _motions(frame, left) | {f"{k}, before": v for k, v in _motions(frame, errors).items()}
        figures["chi-square"] = (
            float(left.ravel() @ np.linalg.solve(found.frame.covariance_mm2, left.ravel())) / left.size
        )
        figures["target"] = _target(found.frame, beads, picks, targets)
        figures["target, before"] = _target(frame, beads, picks, targets)
        out[count] = figures
    return out


def image(rng: np.random.Generator, setup: SetUp, view: str) -> Observations:
    """Return the beads of one view."""
    ids, uv = bead_images(setup, view, rng, BEAD_PX)
    return Observations(view, ids, uv, np.broadcast_to(BEAD_PX**2 * np.eye(2), (len(ids), 2, 2)))


def _places(frame: Frame) -> np.ndarray:
    return np.array([f.xyz_mm for f in frame.fiducials])


def _motions(frame: Frame, errors_mm: np.ndarray) -> Figures:
    """Return mean squares of errors (M, 3): of a view's plates against each other, of balls against their plate."""
    nothing = np.zeros((errors_mm.size, errors_mm.size))
    told = Errors(errors_mm, nothing, nothing, np.ones(len(errors_mm), dtype=bool))
    moved = np.mean([pair.moved**2 for pair in plate_pairs(frame, told)], axis=0)
    assert len(moved) == len(MOTIONS)
    balls = in_plate(frame, told).moved_mm
    normals = [view.xrii.plane.normal for view in frame.views.values() for _ in view.fiducials]
    across = np.einsum("na,na->n", balls, np.array(normals))
    return {
        "plate shift along itself": float(moved[:2].mean()),
        "plate shift along the beam": float(moved[2]),
        "plate tilt": float(moved[3:5].mean()),
        "plate twist": float(moved[5]),
        "ball in its plate": float(((balls**2).sum(axis=1) - across**2).mean() / 2),
        "ball across its plate": float((across**2).mean()),
    }


def _target(frame: Frame, beads: list[Observations], picks: np.ndarray, targets: np.ndarray) -> float:
    views = [sl.calibrate(one, frame) for one in beads]
    noise = np.broadcast_to(PICK_PX**2 * np.eye(2), (*picks.shape, 2))
    gap = sl.reconstruct(views, picks, noise).xyz_mm - targets
    return float((gap**2).sum(axis=1).mean())
