"""Index the points of a regular lattice (perforated plates, bead grids) through any smooth distortion."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import KDTree

REACH = 0.25  # of the pitch: maximum distance of a point from the position predicted by its neighbours [ours]
STARTS = 5  # number of points near the middle that are tried as the first one [ours]
MIN_SINE = 0.75  # between both axes: 60, 90 and 120 degrees and distortion [ours]
HEXAGONAL_COSINE = 0.25  # between both axes: above 75.5 degrees a lattice counts as square


@dataclass(frozen=True, eq=False)
class Lattice:
    """A lattice of N points. `members` (N,): indices of its points; `uv_px` (N, 2); `index` (N, 2): integers along its
    axes.

    `axes` (2, 2): rows are the axes on the ideal plate, in pitches, 60 or 90 degrees apart. `pitch_px`: at the start.
    """

    members: np.ndarray
    uv_px: np.ndarray
    index: np.ndarray
    axes: np.ndarray
    pitch_px: float

    def __len__(self) -> int:
        return len(self.members)

    @property
    def xy(self) -> np.ndarray:
        """Positions (N, 2) of the points on the ideal plate, in pitches."""
        return self.index @ self.axes


def grow(uv_px: np.ndarray) -> Lattice | None:
    """Return the largest lattice grown from a start near the middle of points (N, 2); None if no three points span one.

    It grows from neighbour to neighbour, so that accumulated distortion does no harm. Points that fit nowhere are left
    out.
    """
    if len(uv_px) < 4:
        return None
    tree = KDTree(uv_px)
    starts = np.atleast_1d(tree.query(np.median(uv_px, axis=0), k=STARTS)[1])
    grown = [one for start in starts if start < len(uv_px) and (one := _from(uv_px, tree, int(start))) is not None]
    return max(grown, key=len, default=None)


def _axes(uv_px: np.ndarray, tree: KDTree, start: int) -> np.ndarray | None:
    """Return the steps (2, 2) to two neighbours, 60 to 90 degrees apart."""
    near = np.asarray(tree.query(uv_px[start], k=min(9, len(uv_px)))[1])[1:]
    steps = uv_px[near] - uv_px[start]
    length = np.linalg.norm(steps, axis=1)
    sine = np.abs(steps[0, 0] * steps[:, 1] - steps[0, 1] * steps[:, 0]) / (length[0] * length)
    across = np.flatnonzero((sine > MIN_SINE) & (length < 1.3 * length[0]))
    if not len(across):
        return None
    first, second = (_centred(steps, steps[k]) for k in (0, across[0]))
    return np.array([first, second if first @ second >= -HEXAGONAL_COSINE * length[0] ** 2 else second + first])


def _centred(steps: np.ndarray, step: np.ndarray) -> np.ndarray:
    """Return a step, averaged with the opposite step if there is one."""
    gap = np.linalg.norm(steps + step, axis=1)
    opposite = int(np.argmin(gap))
    return (step - steps[opposite]) / 2 if gap[opposite] < REACH * np.linalg.norm(step) else step


def walk(uv_px: np.ndarray, tree: KDTree, start: int, axes: np.ndarray) -> dict[tuple[int, int], int]:
    """Return the index of the point (N, 2) at each site of a lattice with axes (2, 2), px, around point `start`."""
    pitch = float(np.linalg.norm(axes, axis=1).mean())
    place: dict[tuple[int, int], int] = {(0, 0): start}
    taken, todo = {start}, [(0, 0)]
    for i, j in todo:  # the loop appends to its own list
        here = uv_px[place[i, j]]
        for di, dj in ((1, 0), (-1, 0), (0, 1), (0, -1)):
            site, behind = (i + di, j + dj), place.get((i - di, j - dj))
            if site in place:
                continue
            step = here - uv_px[behind] if behind is not None else np.array([di, dj]) @ axes
            distance, found = tree.query(here + step)
            if distance < REACH * pitch and found not in taken:
                place[site] = int(found)
                taken.add(int(found))
                todo.append(site)
    return place


def _from(uv_px: np.ndarray, tree: KDTree, start: int) -> Lattice | None:
    axes = _axes(uv_px, tree, start)
    if axes is None:
        return None
    place = walk(uv_px, tree, start, axes)
    pitch = float(np.linalg.norm(axes, axis=1).mean())
    members = np.array(list(place.values()))
    cosine = axes[0] @ axes[1] / np.prod(np.linalg.norm(axes, axis=1))
    ideal = np.array([[1.0, 0.0], [0.5, np.sqrt(0.75)] if cosine > HEXAGONAL_COSINE else [0.0, 1.0]])
    return Lattice(members, uv_px[members], np.array(list(place)), ideal, pitch)
