"""A point that a person picks in an image, with its covariance."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from sightline.errors import UnusableInputError

# Standard deviation of a careful click, per axis: the default of every pick [physics.md, Picks].
DEFAULT_PICK_SD_PX = 0.5
_FREE_PX = 1e3  # s.d. across a snapped pick's curve, where it measures nothing


@dataclass(frozen=True, eq=False)
class Pick:
    """One picked point, IDCS px.

    `uv_px` (2,), NaN where the view does not show the point; `covariance_px2` (2, 2); `across_px` (2,): zero for a free
    pick. A pick snapped to an image-matching curve is a one-dimensional measurement along the curve: then `across_px`
    is the unit vector across the curve, in which the pick measures nothing.
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


class PickArrays(NamedTuple):
    """Picks of N points in V views, as in `Pick`: (V, N, 2), (V, N, 2, 2) and (V, N, 2).

    `uv_px` is NaN where a view does not show a point.
    """

    uv_px: np.ndarray
    covariance_px2: np.ndarray
    across_px: np.ndarray

    @property
    def seen(self) -> np.ndarray:
        """(V, N) bool: the view shows the point."""
        return np.isfinite(self.uv_px[..., 0])

    @property
    def snapped(self) -> np.ndarray:
        """(V, N) bool: the pick is snapped to a curve."""
        return np.any(self.across_px != 0.0, axis=-1)

    def in_views(self, count: int) -> "PickArrays":
        """Return the picks with further views that do not show the points, up to `count` views."""
        more = count - len(self.uv_px), self.uv_px.shape[1]
        filled = np.full((*more, 2), np.nan), np.tile(np.eye(2), (*more, 1, 1)), np.zeros((*more, 2))
        return PickArrays(*(np.concatenate(pair) for pair in zip(self, filled, strict=True)))

    def unbound(self) -> np.ndarray:
        """Return the covariances (V, N, 2, 2), px², of free picks that measure nothing across their curves."""
        across = self.across_px
        return self.covariance_px2 + _FREE_PX**2 * across[..., :, None] * across[..., None, :]

    def regular(self) -> "PickArrays":
        """Return the picks with a variance above zero across their curves, which keeps matrices regular; it is not
        used."""
        size = np.trace(self.covariance_px2, axis1=-2, axis2=-1)[..., None, None]
        across = self.across_px
        return self._replace(covariance_px2=self.covariance_px2 + size * across[..., :, None] * across[..., None, :])


def stack(picks: Sequence[Sequence[Pick]]) -> PickArrays:
    """Return the picks of N points, each with a pick in every view, as arguments of `reconstruct`."""
    by_view = list(zip(*picks, strict=True))
    return PickArrays(
        np.array([[p.uv_px for p in view] for view in by_view]),
        np.array([[p.covariance_px2 for p in view] for view in by_view]),
        np.array([[p.across_px for p in view] for view in by_view]),
    )
