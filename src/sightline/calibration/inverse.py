"""The inverse of a smooth plane map, by Newton's method."""

from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np
from scipy.spatial import KDTree

from sightline.errors import OutsideRegionError

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
    """The inverse map, from plane to pixels; each point starts at its nearest control, found by `tree`.

    `controls_mm` (M, 2): the controls `controls_px` (M, 2) mapped by `plane_map`; `back` (M, 2, 2): inverse Jacobian
    there, px/mm.
    """

    plane_map: SmoothPlaneMap
    controls_px: np.ndarray
    controls_mm: np.ndarray
    back: np.ndarray
    tree: KDTree

    @staticmethod
    def of(plane_map: SmoothPlaneMap, controls_px: np.ndarray) -> "Inverse":
        """Return the inverse of a map that is valid near its controls (M, 2)."""
        xy, jacobian = plane_map.linearised(controls_px)
        return Inverse(plane_map, controls_px, xy, np.linalg.pinv(jacobian), KDTree(xy))

    def __call__(self, xy_mm: np.ndarray) -> np.ndarray:
        """Return the pixels (N, 2) that the map takes to points (N, 2), mm.

        Raises OutsideRegionError where there is none near the controls.
        """
        target = np.asarray(xy_mm, dtype=np.float64)
        uv, found = self.find(target)
        if not found.all():
            where = ", ".join(f"({x:.1f}, {y:.1f})" for x, y in target[~found][:3])
            raise OutsideRegionError(
                f"{(~found).sum()} points lie outside the region the beads calibrate (plane coordinates {where} mm); "
                "choose points inside the beads' convex hull, or move the frame"
            )
        return uv

    def find(self, xy_mm: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the pixels (M, 2) of the points (N, 2) that have one near the controls, and which do, (N,) bool."""
        (low_mm, high_mm), (low, high) = self._boxes
        size = float((high - low).max())
        # Twice the limit for pixels: no usable map stretches by more than that outside its controls.
        at = np.flatnonzero(_within(xy_mm, low_mm, high_mm, 2 * MAX_OUTSIDE * float((high_mm - low_mm).max())))
        target = xy_mm[at]
        near = self.tree.query(target)[1]
        here = self.controls_px[near] + _times(self.back[near], target - self.controls_mm[near])
        uv, before = np.zeros((len(xy_mm), 2)), np.full(len(at), np.inf)
        found = np.zeros(len(uv), dtype=bool)
        for _ in range(ITERATIONS):
            if not len(at):
                break
            xy, jacobian = self.plane_map.linearised(here)
            step = _solve(jacobian, target - xy)
            length = np.sqrt(np.einsum("ni,ni->n", step, step))
            converges = length < 0.5 * before  # converging Newton steps shrink fast; drop the others
            if not converges.all():
                at, target, here, step, length = (one[converges] for one in (at, target, here, step, length))
            here = here + step * np.minimum(1.0, 0.25 * size / np.maximum(length, 1e-300))[:, None]
            uv[at], found[at] = here, length < CONVERGED_PX
            goes_on = ~found[at] & _within(here, low, high, 1.25 * MAX_OUTSIDE * size)  # others do not return
            at, target, here, before = at[goes_on], target[goes_on], here[goes_on], length[goes_on]
        found &= _within(uv, low, high, MAX_OUTSIDE * size)
        return uv[found], found

    @cached_property
    def _boxes(self) -> list[tuple[np.ndarray, np.ndarray]]:
        """Lowest and highest coordinates (2,) of the controls, mm, and those of their pixels."""
        return [(one.min(axis=0), one.max(axis=0)) for one in (self.controls_mm, self.controls_px)]


def _within(points: np.ndarray, low: np.ndarray, high: np.ndarray, margin: float) -> np.ndarray:
    """Return (N,) bool: whether points (N, 2) lie in a box widened by `margin`."""
    inside = (points >= low - margin) & (points <= high + margin)
    return inside[:, 0] & inside[:, 1]


def _times(matrices: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    return np.einsum("nij,nj->ni", matrices, vectors)


def _solve(matrices: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Return the solutions (N, 2) of N 2x2 systems; infinite where the map folds (determinant zero)."""
    (a, b), (c, d) = matrices.transpose(1, 2, 0)
    x, y = right.T
    det = a * d - b * c
    out = np.empty_like(right)
    out[:, 0], out[:, 1] = d * x - b * y, a * y - c * x
    folded = np.abs(det) < 1e-9 * np.einsum("nij,nij->n", matrices, matrices)
    if folded.any():
        out[folded], det[folded] = np.inf, 1.0
    out /= det[:, None]
    return out
