"""The inverse of a smooth plane map, by Newton's method."""

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Protocol

import numpy as np

from sightline.errors import OutsideRegionError

if TYPE_CHECKING:
    from scipy.spatial import KDTree

ITERATIONS = 10  # four are enough wherever a view is calibrated [calc]
# Steps below this end the iteration: the next would be its square times the map's curvature (1e-3 per px), 1e-9 px
# [calc].
CONVERGED_PX = 1e-3
# How far outside the controls' bounding box a pixel may lie, in sizes of that box [ours]: further out a polynomial is
# meaningless.
MAX_OUTSIDE = 0.5


class SmoothPlaneMap(Protocol):
    """A plane map with a derivative everywhere."""

    def linearised(self, uv_px: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the plane coordinates (N, 2), mm, of pixels (N, 2), and their derivative (N, 2, 2), mm/px."""
        ...


@dataclass(frozen=True, eq=False)
class Inverse:
    """The inverse map, from plane to pixels; each point starts at its nearest control.

    `controls_mm` (M, 2): the controls `controls_px` (M, 2) mapped by `plane_map`; `back` (M, 2, 2): inverse Jacobian
    there, px/mm.
    """

    plane_map: SmoothPlaneMap
    controls_px: np.ndarray
    controls_mm: np.ndarray
    back: np.ndarray

    @staticmethod
    def of(plane_map: SmoothPlaneMap, controls_px: np.ndarray) -> "Inverse":
        """Return the inverse of a map that is valid near its controls (M, 2)."""
        xy, jacobian = plane_map.linearised(controls_px)
        return Inverse(plane_map, controls_px, xy, np.linalg.pinv(jacobian))

    def __call__(self, xy_mm: np.ndarray) -> np.ndarray:
        """Return the pixels (N, 2) that the map takes to points (N, 2), mm.

        Raises OutsideRegionError where there is none near the controls.
        """
        target = np.asarray(xy_mm, dtype=np.float64)
        uv, mapped = self.find(target)
        if not mapped.all():
            where = ", ".join(f"({x:.1f}, {y:.1f})" for x, y in target[~mapped][:3])
            raise OutsideRegionError(
                f"{(~mapped).sum()} points lie outside the region the beads calibrate (plane coordinates {where} mm); "
                "choose points inside the beads' convex hull, or move the frame"
            )
        return uv

    def find(self, xy_mm: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the pixels (M, 2) of the points (N, 2) that have one near the controls, and which do, (N,) bool."""
        (low_mm, high_mm), (low, high) = (
            (at.min(axis=0), at.max(axis=0)) for at in (self.controls_mm, self.controls_px)
        )
        size = float((high - low).max())
        # Twice the limit for pixels: no usable map stretches by more than that outside its controls.
        at = np.flatnonzero(_within(xy_mm, low_mm, high_mm, 2 * MAX_OUTSIDE * float((high_mm - low_mm).max())))
        near = self._tree.query(xy_mm[at])[1]
        here = self.controls_px[near] + np.einsum("nij,nj->ni", self.back[near], xy_mm[at] - self.controls_mm[near])
        uv, length, converged = np.zeros((len(xy_mm), 2)), np.full(len(at), np.inf), np.zeros(len(xy_mm), dtype=bool)
        for _ in range(ITERATIONS):
            if not len(at):
                break
            xy, jacobian = self.plane_map.linearised(here)
            (a, b), (c, d) = np.moveaxis(jacobian, 0, -1)
            x, y = (xy_mm[at] - xy).T
            determinant = a * d - b * c
            regular = np.abs(determinant) >= 1e-9 * (a * a + b * b + c * c + d * d)  # elsewhere the map folds
            step = np.stack([d * x - b * y, a * y - c * x], axis=1) / np.where(regular, determinant, 1.0)[:, None]
            before, length = length, np.hypot(*step.T)
            here = here + step * np.minimum(1.0, 0.25 * size / np.maximum(length, 1e-300))[:, None]
            # Converging steps shrink faster, and no point returns from far outside.
            converges = regular & (length < 0.5 * before) & _within(here, low, high, 1.25 * MAX_OUTSIDE * size)
            ended = converges & (length < CONVERGED_PX)
            uv[at], converged[at] = here, ended & _within(here, low, high, MAX_OUTSIDE * size)
            on = converges & ~ended
            at, here, length = at[on], here[on], length[on]
        return uv[converged], converged

    @cached_property
    def _tree(self) -> "KDTree":
        """The controls, mm."""
        from scipy.spatial import KDTree  # here: lines of sight need no inverse, and it takes 6 MB

        return KDTree(self.controls_mm)


def _within(points: np.ndarray, low: np.ndarray, high: np.ndarray, margin: float) -> np.ndarray:
    """Return (N,) bool: whether points (N, 2) lie in a box widened by `margin`."""
    inside = (points >= low - margin) & (points <= high + margin)
    return inside[:, 0] & inside[:, 1]
