"""Which of the frame's beads should be seen near a pixel, and how many of them the calibration rests on.

Labelling drops what does not fit the rest, such as the beads of a strip of torn rows. The map there is then a guess
from elsewhere, and no residual says so. A bead that something hides leaves nothing behind, and contradicts nothing: the
map's own covariance allows for it. So each detection near by that was not labelled stands for a missing bead; what is
missing beyond these is taken to be hidden.
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import ConvexHull, QhullError
from scipy.spatial.distance import cdist

NEIGHBOURS = 8  # [ours] beads about a pixel, of both plates: within 1.1 pitches of 7 x 7 and 8 x 8 beads


@dataclass(frozen=True, eq=False)
class Support:
    """E beads that the view shows apart from each other: `places_px` (E, 2), `radii_px` (E,), `used` (E,) bool.

    `stray_px` (M, 2): what was detected and is none of the beads used; None where nobody knows, and then no bead counts
    as hidden.
    """

    places_px: np.ndarray
    radii_px: np.ndarray
    used: np.ndarray
    stray_px: np.ndarray | None

    @staticmethod
    def of(places_px: np.ndarray, radii_px: np.ndarray, used: np.ndarray, stray_px: np.ndarray | None) -> "Support":
        """Of all beads that the view projects (M, 2); of two that touch or overlap detection may find none, or one that
        is neither."""
        apart = cdist(places_px, places_px) - radii_px[:, None] - radii_px
        np.fill_diagonal(apart, np.inf)
        alone = apart.min(axis=1, initial=np.inf) > 0.0
        if stray_px is not None:
            on_pair = (cdist(stray_px, places_px[~alone]) < radii_px[~alone]).any(axis=1)
            stray_px = stray_px[~on_pair]
        return Support(places_px[alone], radii_px[alone], used[alone], stray_px)

    def near(self, uv_px: np.ndarray) -> np.ndarray:
        """Return (N, 3) int: how many of the NEIGHBOURS beads nearest to each pixel (N, 2) are used, hidden, expected.

        The field of view is convex and holds the beads used and the pixel: what lies between them is in it.
        """
        out = np.zeros((len(uv_px), 3), dtype=int)
        known = self.places_px[self.used]
        within = _inside(known, self.places_px, self.radii_px)
        for k, uv in enumerate(uv_px):
            beyond = np.concatenate([known, uv[None]])
            seen = within if _inside(known, uv[None]).all() else _inside(beyond, self.places_px, self.radii_px)
            rows = np.flatnonzero(seen | self.used)
            distance = np.linalg.norm(self.places_px[rows] - uv, axis=1)
            order = np.argsort(distance)[:NEIGHBOURS]
            used = int(self.used[rows[order]].sum())
            out[k] = used, self._hidden(uv, len(order) - used, distance[order].max(initial=0.0)), len(order)
        return out

    def _hidden(self, uv_px: np.ndarray, missing: int, reach_px: float) -> int:
        if self.stray_px is None:
            return 0
        stray = int((np.linalg.norm(self.stray_px - uv_px, axis=1) <= reach_px).sum())
        return max(missing - stray, 0)


def _inside(corners_px: np.ndarray, uv_px: np.ndarray, margin_px: np.ndarray | float = 0.0) -> np.ndarray:
    """(N,) bool: pixels (N, 2) within the convex hull of others, by at least a margin.

    All are where the others span none: then no bead is excused.
    """
    try:
        sides = ConvexHull(corners_px).equations
    except (QhullError, ValueError):
        return np.ones(len(uv_px), dtype=bool)
    return (uv_px @ sides[:, :2].T + sides[:, 2]).max(axis=1) <= -np.asarray(margin_px)
