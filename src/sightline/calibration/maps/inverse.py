"""The inverse of a smooth plane map, by Newton's method."""

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Protocol

import numpy as np

from sightline.errors import OutsideRegionError
from sightline.kernels import kernel

if TYPE_CHECKING:
    from scipy.spatial import KDTree

ITERATIONS = 10  # four are enough wherever a view is calibrated [calc]
# Steps below this end the iteration: the next would be its square times the map's curvature (1e-3 per px), 1e-9 px
# [calc].
CONVERGED_PX = 1e-3
# How far outside the controls' bounding box a pixel may lie, in sizes of that box [ours]: further out a polynomial is
# meaningless.
MAX_OUTSIDE = 0.5
# Pairs of points and controls up to which all distances are computed: a query of the tree takes 60 µs before its first
# point, as long as these distances.
_FEW = 60_000
_DROPPED, _GOES_ON, _FOUND = 0, 1, 2


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
        # Copies, because the kernels are compiled again for arrays that are read-only or not contiguous.
        return Inverse(plane_map, np.array(controls_px), np.array(xy, order="C"), np.linalg.pinv(jacobian))

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
        few = len(target) * len(self.controls_mm) <= _FEW
        near = _nearest(target, self.controls_mm) if few else self._tree.query(target)[1]
        here = _started(near, target, self.controls_px, self.controls_mm, self.back)
        uv, length = np.zeros((len(xy_mm), 2)), np.full(len(at), np.inf)
        found = np.zeros(len(uv), dtype=bool)
        for _ in range(ITERATIONS):
            if not len(at):
                break
            xy, jacobian = self.plane_map.linearised(here)
            state = _stepped(here, length, target, np.ascontiguousarray(xy), jacobian, low, high, size)
            uv[at], found[at] = here, state == _FOUND
            on = state == _GOES_ON
            if not on.all():
                at, target, here, length = at[on], target[on], here[on], length[on]
        return uv[found], found

    @cached_property
    def _tree(self) -> "KDTree":
        """The controls, mm, for searches of many points."""
        from scipy.spatial import KDTree  # here: few points need no tree, and it takes 6 MB

        return KDTree(self.controls_mm)

    @cached_property
    def _boxes(self) -> list[tuple[np.ndarray, np.ndarray]]:
        """Lowest and highest coordinates (2,) of the controls, mm, and those of their pixels."""
        return [(one.min(axis=0), one.max(axis=0)) for one in (self.controls_mm, self.controls_px)]


def _within(points: np.ndarray, low: np.ndarray, high: np.ndarray, margin: float) -> np.ndarray:
    """Return (N,) bool: whether points (N, 2) lie in a box widened by `margin`."""
    inside = (points >= low - margin) & (points <= high + margin)
    return inside[:, 0] & inside[:, 1]


@kernel(nogil=True)
def _nearest(target, controls_mm):
    """Return for each of the points (N, 2), mm, the control (M, 2) that is nearest to it."""
    near = np.zeros(len(target), dtype=np.int64)
    for n in range(len(target)):
        least = np.inf
        for k in range(len(controls_mm)):
            x, y = target[n, 0] - controls_mm[k, 0], target[n, 1] - controls_mm[k, 1]
            away = x * x + y * y
            if away < least:
                least, near[n] = away, k
    return near


@kernel(nogil=True)
def _started(near, target, controls_px, controls_mm, back):
    """Return where the iteration starts (N, 2): points (N, 2), mm, by the inverse Jacobian at their controls `near`."""
    here = np.empty((len(near), 2))
    for n in range(len(near)):
        k = near[n]
        x, y = target[n, 0] - controls_mm[k, 0], target[n, 1] - controls_mm[k, 1]
        here[n, 0] = controls_px[k, 0] + (back[k, 0, 0] * x + back[k, 0, 1] * y)
        here[n, 1] = controls_px[k, 1] + (back[k, 1, 0] * x + back[k, 1, 1] * y)
    return here


@kernel(nogil=True, error_model="numpy")
def _stepped(here, length, target, xy, jacobian, low, high, size):  # noqa: PLR0917 - a kernel
    """Move pixels `here` (N, 2) by one Newton step, and set `length` (N,), the last step's, to this one's.

    The map takes them to `xy` (N, 2), with `jacobian` (N, 2, 2); `low`, `high` (2,), `size`: the box of the controls,
    px. Return their states (N,): _FOUND, _GOES_ON, or _DROPPED where the map folds (determinant zero), where the steps
    do not shrink as fast as converging ones do, and outside the box, from where none returns.
    """
    state = np.empty(len(here), dtype=np.int8)
    for n in range(len(here)):
        a, b, c, d = jacobian[n, 0, 0], jacobian[n, 0, 1], jacobian[n, 1, 0], jacobian[n, 1, 1]
        x, y = target[n, 0] - xy[n, 0], target[n, 1] - xy[n, 1]
        det = a * d - b * c
        state[n] = _DROPPED
        if not abs(det) >= 1e-9 * (a * a + b * b + c * c + d * d):
            continue
        du, dv = (d * x - b * y) / det, (a * y - c * x) / det
        before, length[n] = length[n], np.sqrt(du * du + dv * dv)
        if not length[n] < 0.5 * before:
            continue
        held = min(1.0, 0.25 * size / max(length[n], 1e-300))
        here[n, 0] += du * held
        here[n, 1] += dv * held
        found = length[n] < CONVERGED_PX
        margin = (1.0 if found else 1.25) * MAX_OUTSIDE * size
        inside = True
        for k in range(2):
            inside = inside and low[k] - margin <= here[n, k] <= high[k] + margin
        if inside:
            state[n] = _FOUND if found else _GOES_ON
    return state
