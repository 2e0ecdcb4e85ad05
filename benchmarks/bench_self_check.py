"""Errors of a frame before and after a self-check, by the number of images.

block60 as printed, balls 0.2 mm off, in 8 to 15 images on a flat panel, turned by up to 45° between them; beads at 0.1
px and one distance known to 0.02 mm.
"""

from dataclasses import replace
from functools import partial

import numpy as np
from tests.calibration.solid_scenes import C_ARM, built, turned_images

from benchmarks.harness import Rows, columns, rms, trials
from benchmarks.scenes.blocks import BEAD_PX, block
from sightline.calibration.solids.self_check import KnownDistance, self_check_solid
from sightline.common.geometry.rigid import rigid_fit

BLOCKS, BLOCK_IMAGES, PRINTED_MM, DISTANCE_MM = 50, (8, 15), 0.2, 0.02
MAX_BALL_MM = 0.02
FIRST_SEED = 40_000  # different from the other benchmarks'


def run(quick: bool) -> Rows:
    """Return the rows of this benchmark."""
    rows, number = Rows("self-check, printed block"), BLOCKS // 5 if quick else BLOCKS
    seeds = range(FIRST_SEED, FIRST_SEED + number)
    each = [columns(trials(partial(_block, count), seeds)) for count in BLOCK_IMAGES]
    images, limit = " / ".join(map(str, BLOCK_IMAGES)), 3 * np.sqrt(2 / (42 * number))  # three s.d. of such a mean
    name = f"balls 0.2 mm off, after {images} images and one distance of 0.02 mm, rms of {number} blocks"
    rows.number(name, [rms(blocks["error"]) for blocks in each], ".4f", "mm", most=MAX_BALL_MM)
    squares = [blocks["square"].mean() for blocks in each]
    rows.number("mean chi-square over its degrees of freedom", squares, ".2f", least=1 - limit, most=1 + limit)
    failed = " / ".join(str(blocks["failed"].sum()) for blocks in each)
    rows.add("blocks with a failed check", f"{failed} of {number}")
    return rows


def _block(images: int, seed: int) -> dict[str, float]:
    """Return the rms error of a block's balls after its self-check, and its chi-square over the 42 free numbers."""
    rng = np.random.default_rng(seed)
    frame = replace(block(PRINTED_MM), name="printed")
    true = built(rng, frame)
    given = turned_images(rng, frame, true, images, BEAD_PX)
    length = float(np.linalg.norm(true[3] - true[0])) + DISTANCE_MM * rng.standard_normal()
    checked = self_check_solid(given, frame, KnownDistance("b1", "b4", length, DISTANCE_MM), [C_ARM] * images)
    estimate, covariance = np.array([f.xyz_mm for f in checked.frame.fiducials]), checked.frame.covariance_mm2
    assert covariance is not None
    error = (rigid_fit(true, estimate).apply(true) - estimate).ravel()
    square = float(error @ np.linalg.pinv(covariance, rcond=1e-6, hermitian=True) @ error)
    failed = not all(check.passed for check in checked.checks)
    return {"error": rms(error), "square": square / (error.size - 6), "failed": failed}
