"""The exact inverse of a smooth plane map, by Newton's method."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from scipy.spatial import KDTree

from sightline.errors import OutsideRegionError

ITERATIONS = 10  # four are enough wherever a view is calibrated [calc]
# The step after which one stops: the next would be its square times the map's curvature, 1e-3 per px, and less than the
# rounding of a pixel [calc].
CONVERGED_PX = 1e-5
# How far beyond the controls' box a pixel may lie, in sizes of that box [ours]: a polynomial says nothing there.
REACH = 0.5


class SmoothPlaneMap(Protocol):
    """A map with a derivative everywhere."""

    def linearised(self, uv_px: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Plane coordinates (N, 2) of pixels (N, 2), and their derivative (N, 2, 2), mm/px."""
        ...


@dataclass(frozen=True, eq=False)
class Inverse:
    """From plane to pixels. Where it starts, `tree` of the controls on the plane, is found once for all points.

    `controls_mm` (M, 2): where `plane_map` takes the controls `controls_px` (M, 2); `back` (M, 2, 2): px/mm there.
    """

    plane_map: SmoothPlaneMap
    controls_px: np.ndarray
    controls_mm: np.ndarray
    back: np.ndarray
    tree: KDTree

    @staticmethod
    def of(plane_map: SmoothPlaneMap, controls_px: np.ndarray) -> "Inverse":
        """Of a map that holds near its controls (M, 2)."""
        xy, jacobian = plane_map.linearised(controls_px)
        return Inverse(plane_map, controls_px, xy, np.linalg.pinv(jacobian), KDTree(xy))

    def __call__(self, xy_mm: np.ndarray) -> np.ndarray:
        """Pixels (N, 2) that the map takes to points (N, 2). Raises OutsideRegionError where there is none near."""
        target = np.asarray(xy_mm, dtype=np.float64)
        uv, found = self.find(target)
        if not found.all():
            where = ", ".join(f"({x:.1f}, {y:.1f})" for x, y in target[~found][:3])
            raise OutsideRegionError(
                f"{(~found).sum()} points lie outside the region the beads calibrate (plane coordinates {where} mm); "
                "choose points inside the beads' hull, or move the frame"
            )
        return uv

    def find(self, xy_mm: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Pixels (M, 2) of those points (N, 2) that have one near the controls, and which do, (N,) bool."""
        low_mm, high_mm = self.controls_mm.min(axis=0), self.controls_mm.max(axis=0)
        low, high = self.controls_px.min(axis=0), self.controls_px.max(axis=0)
        size = float((high - low).max())
        # Twice as far outside as a pixel may lie: so much more no map stretches there what it can still say.
        at = np.flatnonzero(_within(xy_mm, low_mm, high_mm, 2 * REACH * float((high_mm - low_mm).max())))
        near = self.tree.query(xy_mm[at])[1]
        uv = np.zeros((len(xy_mm), 2))
        uv[at] = self.controls_px[near] + _times(self.back[near], xy_mm[at] - self.controls_mm[near])
        before, found = np.full(len(uv), np.inf), np.zeros(len(uv), dtype=bool)
        for _ in range(ITERATIONS):
            if not len(at):
                break
            xy, jacobian = self.plane_map.linearised(uv[at])
            step = _solve(jacobian, xy_mm[at] - xy)
            length = np.linalg.norm(step, axis=1)
            leads = length < 0.5 * before[at]  # Newton's steps shrink fast, or lead nowhere
            at, step, length = at[leads], step[leads], length[leads]
            uv[at] += step * np.minimum(1.0, 0.25 * size / np.maximum(length, 1e-300))[:, None]
            before[at], found[at] = length, length < CONVERGED_PX
            at = at[~found[at] & _within(uv[at], low, high, 1.25 * REACH * size)]  # others do not come back
        found &= _within(uv, low, high, REACH * size)
        return uv[found], found


def _within(points: np.ndarray, low: np.ndarray, high: np.ndarray, margin: float) -> np.ndarray:
    """(N,) bool: points (N, 2) in a box widened by a margin."""
    return np.all((points >= low - margin) & (points <= high + margin), axis=1)


def _times(matrices: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    return np.einsum("nij,nj->ni", matrices, vectors)


def _solve(matrices: np.ndarray, right: np.ndarray) -> np.ndarray:
    """(N, 2) solutions of N systems of two equations; infinite where the map folds (determinant zero)."""
    (a, b), (c, d) = np.moveaxis(matrices, 0, -1)
    x, y = right.T
    det = a * d - b * c
    folded = np.abs(det) < 1e-9 * (a * a + b * b + c * c + d * d)
    det = np.where(folded, 1.0, det)
    out = np.stack([d * x - b * y, a * y - c * x], axis=1) / det[:, None]
    out[folded] = np.inf
    return out
