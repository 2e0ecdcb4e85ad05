"""A point that a person picks in an image, with its covariance."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sightline.errors import UnusableInputError

# Standard deviation of a careful click, per axis: the default of every pick (physics.md, Picks) [ours].
DEFAULT_PICK_SD_PX = 0.5


@dataclass(frozen=True, eq=False)
class Pick:
    """One picked point, IDCS px.

    `uv_px` (2,); `covariance_px2` (2, 2); `across_px` (2,): zero for a free pick. A pick snapped to an image-matching
    curve is a one-dimensional measurement along the curve: then `across_px` is the unit vector across the curve, in
    which the pick measures nothing.
    """

    uv_px: np.ndarray
    covariance_px2: np.ndarray
    across_px: np.ndarray

    @staticmethod
    def free(uv_px: Sequence[float] | np.ndarray, sd_px: float = DEFAULT_PICK_SD_PX) -> "Pick":
        """Return a pick with the same error in all directions. Raises UnusableInputError."""
        if not (np.isfinite(sd_px) and sd_px > 0.0):
            raise UnusableInputError(
                f"a pick's standard deviation is {sd_px} px; give a positive one (0.5 for a careful click)"
            )
        return Pick(np.array(uv_px, dtype=np.float64), sd_px**2 * np.eye(2), np.zeros(2))


def stack(picks: Sequence[tuple[Pick, Pick]]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the picks of N points in two views as arguments of `reconstruct`: uv_px, uv_covariance_px2, across_px."""
    by_view = list(zip(*picks, strict=True))
    return (
        np.array([[p.uv_px for p in view] for view in by_view]),
        np.array([[p.covariance_px2 for p in view] for view in by_view]),
        np.array([[p.across_px for p in view] for view in by_view]),
    )
