"""Sub-pixel beads: a blurred ball or disc on a quadratic background, fitted coarsely to judge it, then finely."""

import numpy as np

from sightline.detection import coarse as _coarse
from sightline.detection import fine as _fine
from sightline.detection.noise import NoiseModel
from sightline.detection.profile import profile_table
from sightline.detection.sharpen import design


def fit_coarsely(
    log_image: np.ndarray, usable: np.ndarray, spots: np.ndarray, others: np.ndarray, noise: NoiseModel
) -> np.ndarray:
    """Least-squares fit of every spot, all pixels alike: rows of `columns`, to tell beads from what is none.

    `log_image` (H, W) float32; `usable` (H, W) bool; `spots` (M, 4) of u, v, radius, response;
    `others` (K, 4) likewise: discs that a window leaves out where they are not the spot itself, nor much weaker.
    """
    tables = profile_table(ball=True), profile_table(ball=False)
    return _coarse.fit_all(log_image, usable, spots, others, noise.offset, noise.slope, *tables)


def fit_finely(
    log_image: np.ndarray, usable: np.ndarray, coarse: np.ndarray, others: np.ndarray, noise: NoiseModel
) -> np.ndarray:
    """From each row of `coarse` a fit weighted for correlated noise: the same columns, covariance included.

    Beads of `coarse` that reach into each other's windows are fitted together; `others` as for `fit_coarsely`.
    """
    sharp = design(log_image, usable, noise)
    numbers = np.array([noise.offset, noise.slope, sharp.gain])
    tables = profile_table(ball=True), profile_table(ball=False)
    return _fine.fit_all(
        log_image,
        usable,
        coarse,
        others,
        numbers,
        sharp.taps.astype(np.float32),
        sharp.blur2_px2,
        sharp.correlation.astype(np.float32),
        *tables,
    )
