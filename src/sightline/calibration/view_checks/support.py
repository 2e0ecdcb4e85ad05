"""The frame's beads that should be visible near a pixel, and how many of them the calibration uses.

Labelling drops beads that do not fit the rest, such as those of a strip of torn rows. The map there is then
extrapolated, and no residual shows it. A hidden bead contradicts nothing, and the map's own covariance allows for it.
Each unlabelled detection nearby therefore counts as one missing bead that is not hidden; all other missing beads count
as hidden.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from sightline.common.fitting import distances

# Unlabelled detections beside missing beads, all by one shift along the rows: so many are a strip of shifted rows. Of
# 28 detections and 20 missing beads at random places six agree in fewer than one of a million images [calc].
MIN_STRIP = 6
_SAME_ROW_PX, _SAME_SHIFT_PX = 4.0, 8.0  # the map is extrapolated into the strip [ours]
_LEAST_SHIFT_PX, _MOST_SHIFT_PX = 3.0, 100.0  # beads that are shifted by less are labelled, and their residuals show it
NEIGHBOURS = 8  # [ours] beads about a pixel, of both plates: within 1.1 pitches with 7 x 7 and 8 x 8 beads


@dataclass(frozen=True, eq=False)
class Support:
    """E isolated beads of the view: `places_px` (E, 2), `radii_px` (E,), `used` (E,) bool.

    `stray_px` (M, 2): detections that are not used beads; None where unknown, and then no bead counts as hidden.
    """

    places_px: np.ndarray
    radii_px: np.ndarray
    used: np.ndarray
    stray_px: np.ndarray | None

    @staticmethod
    def of(places_px: np.ndarray, radii_px: np.ndarray, used: np.ndarray, stray_px: np.ndarray | None) -> "Support":
        """Return the support of all beads that the view projects (M, 2), without those whose shadows touch.

        Of two that touch, detection may find none, or a single one that is neither.
        """
        clearance = distances(places_px, places_px) - radii_px[:, None] - radii_px
        np.fill_diagonal(clearance, np.inf)
        isolated = clearance.min(axis=1, initial=np.inf) > 0.0
        if stray_px is not None:
            on_pair = (distances(stray_px, places_px[~isolated]) < radii_px[~isolated]).any(axis=1)
            stray_px = stray_px[~on_pair]
        return Support(places_px[isolated], radii_px[isolated], used[isolated], stray_px)

    def near(self, uv_px: np.ndarray) -> np.ndarray:
        """Return (N, 3) int: how many of the NEIGHBOURS beads nearest to each pixel (N, 2) are used, hidden, expected.

        Expected are beads in the convex hull of the used beads, all other detections and the pixel: the field of view
        is convex and contains these. Without the other detections nothing would be expected of a strip at the field's
        edge whose beads were all dropped.
        """
        inside = _inside(self._sides, uv_px)
        counts = np.zeros((len(uv_px), 3), dtype=int)
        counts[inside] = self._counted(uv_px[inside], self._expected)
        for k in np.flatnonzero(~inside):
            sides = _sides(np.concatenate([self._known_px, uv_px[k : k + 1]]))
            counts[k] = self._counted(uv_px[k : k + 1], _inside(sides, self.places_px, self.radii_px))
        return counts

    @cached_property
    def _known_px(self) -> np.ndarray:
        """(K, 2): the used beads and all other detections."""
        used = self.places_px[self.used]
        return used if self.stray_px is None else np.concatenate([used, self.stray_px])

    @cached_property
    def _sides(self) -> np.ndarray | None:
        return _sides(self._known_px)

    @cached_property
    def _expected(self) -> np.ndarray:
        """(E,) bool: within the convex hull of the used beads and all other detections."""
        return _inside(self._sides, self.places_px, self.radii_px)

    def _counted(self, uv_px: np.ndarray, seen: np.ndarray) -> np.ndarray:
        """Return `near` of pixels (N, 2) where the beads `seen` (E,) and the used ones are expected."""
        expected = np.flatnonzero(seen | self.used)
        away, count = distances(uv_px, self.places_px[expected]), min(len(expected), NEIGHBOURS)
        near = away.argsort(axis=1)[:, :count]
        used = self.used[expected[near]].sum(axis=1)
        hidden = np.zeros_like(used)
        if self.stray_px is not None:
            reach = np.take_along_axis(away, near, axis=1).max(axis=1, initial=0.0)
            beside = (distances(uv_px, self.stray_px) <= reach[:, None]).sum(axis=1)
            hidden = np.maximum(count - used - beside, 0)
        return np.stack([used, hidden, np.full_like(used, count)], axis=1)

    def strip_shift_px(self) -> float | None:
        """Return the shift along the rows that takes missing beads to MIN_STRIP or more unlabelled detections, if any.

        Labelling drops the beads of a strip of shifted rows, so no residual shows them.
        """
        missing = self.places_px[~self.used]
        if self.stray_px is None or min(len(missing), len(self.stray_px)) < MIN_STRIP:
            return None
        shift, off_row = np.moveaxis(self.stray_px[:, None] - missing, -1, 0)
        beside = (np.abs(off_row) < _SAME_ROW_PX) & (np.abs(shift) < _MOST_SHIFT_PX) & (np.abs(shift) > _LEAST_SHIFT_PX)
        starts = np.append(shift[beside], 0.0)
        together = beside & (np.abs(shift - starts[:, None, None] - _SAME_SHIFT_PX / 2) <= _SAME_SHIFT_PX / 2)
        count = np.minimum(together.any(axis=1).sum(axis=1), together.any(axis=2).sum(axis=1))
        best = int(count.argmax())
        return float(np.median(shift[together[best]])) if count[best] >= MIN_STRIP else None


def _sides(corners_px: np.ndarray) -> np.ndarray | None:
    """Return the sides (S, 3) of the convex hull of pixels (N, 2): normal outwards and offset; None without a hull."""
    from scipy.spatial import ConvexHull, QhullError  # here: only lines of sight need it, and it takes 6 MB

    try:
        return ConvexHull(corners_px).equations
    except (QhullError, ValueError):
        return None


def _inside(sides: np.ndarray | None, uv_px: np.ndarray, margin_px: np.ndarray | float = 0.0) -> np.ndarray:
    """Return (N,) bool: whether pixels (N, 2) lie within the sides of a convex hull, by at least a margin.

    All True without a hull: then every bead is expected.
    """
    if sides is None:
        return np.ones(len(uv_px), dtype=bool)
    return (uv_px @ sides[:, :2].T + sides[:, 2]).max(axis=1) <= -np.asarray(margin_px)
