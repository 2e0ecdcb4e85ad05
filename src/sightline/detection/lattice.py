"""The square or hexagonal lattice that the balls or holes of one image stand on, without ids."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import KDTree

from sightline.common.fitting import monomials
from sightline.detection.labelling.naming import ON_PLACE
from sightline.errors import DetectionRefusedError

# Of a lattice, whose points lie within ON_PLACE of where their neighbours predict them:
MIN_POINTS = 20  # two for each coefficient of a cubic: of fewer, a map follows the noise [ours]
ON_LATTICE = 0.8  # [ours] share of the points that must stand on one lattice: the others may be metal or writing
REACH = 2  # sites across which a lattice goes on: one row may be missing [ours]
STARTS = 5  # points tried as the first one: on a square lattice the middle one and its four neighbours
MIN_SINE = 0.75  # between both axes: 60, 90 and 120 degrees and distortion [ours]
HEXAGONAL_COSINE = 0.25  # between both axes: above 75.5 degrees a lattice counts as square
SQUARE, HEXAGONAL = np.eye(2), np.array([[1.0, 0.0], [0.5, np.sqrt(0.75)]])  # axes (2, 2), in pitches


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
    grown = [
        lattice for start in starts if start < len(uv_px) and (lattice := _from(uv_px, tree, int(start))) is not None
    ]
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
    return (step - steps[opposite]) / 2 if gap[opposite] < ON_PLACE * np.linalg.norm(step) else step


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
            distance, nearest = tree.query(here + step)
            if distance < ON_PLACE * pitch and nearest not in taken:
                place[site] = int(nearest)
                taken.add(int(nearest))
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
    ideal = HEXAGONAL if cosine > HEXAGONAL_COSINE else SQUARE
    return Lattice(members, uv_px[members], np.array(list(place)), ideal, pitch)


def lattice_of_sheet(uv_px: np.ndarray) -> Lattice:
    """Return the one lattice of a sheet's points (N, 2), across a missing row.

    Raises DetectionRefusedError where too few points, or too small a share of them, stand on it, or it is not regular.
    """
    lattice = grow(uv_px)
    if lattice is not None and len(lattice) >= MIN_POINTS:
        lattice = _across_gaps(uv_px, lattice)
    number = 0 if lattice is None else len(lattice)
    if lattice is None or number < max(MIN_POINTS, ON_LATTICE * len(uv_px)):
        raise DetectionRefusedError(
            f"{number} of {len(uv_px)} balls or holes stand on one lattice; at least {MIN_POINTS} and {ON_LATTICE:.0%} "
            "of them are needed: show one sheet alone, square or hexagonal, with more of it in the field"
        )
    return lattice


def _across_gaps(uv_px: np.ndarray, lattice: Lattice) -> Lattice:
    """Return the lattice with the points near sites that a polynomial of its own points predicts, REACH sites away.

    Raises DetectionRefusedError where its own points are not within ON_PLACE of that polynomial.
    """
    ring = np.stack(np.meshgrid(*2 * [np.arange(-REACH, REACH + 1)]), axis=-1).reshape(-1, 2)
    index, members, limit_px = lattice.index, lattice.members, ON_PLACE * lattice.pitch_px
    while True:
        known = {(int(i), int(j)) for i, j in index}
        around = np.unique((index[:, None] + ring).reshape(-1, 2), axis=0)
        sites = np.array([site for site in around if tuple(site.tolist()) not in known])
        at, off_px = _predicted(index, uv_px[members], sites)
        if (worst := float(np.linalg.norm(off_px, axis=1).max())) > limit_px:
            raise DetectionRefusedError(
                f"the balls or holes stand up to {worst:.1f} px from a regular lattice (limit {limit_px:.1f} px): some "
                "rows are shifted; show one flat sheet with one pitch"
            )
        free = np.setdiff1d(np.arange(len(uv_px)), members)
        distance, site = map(np.asarray, KDTree(at).query(uv_px[free].reshape(-1, 2)))
        near = distance < limit_px
        taken, first = np.unique(site[near], return_index=True)
        if not len(taken):
            return Lattice(members, uv_px[members], index, lattice.axes, lattice.pitch_px)
        index = np.concatenate([index, sites[taken]])
        members = np.concatenate([members, free[near][first]])


def _predicted(index: np.ndarray, uv_px: np.ndarray, sites: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the pixels of `sites` (M, 2) by a polynomial fitted to points (N, 2), and its residuals (N, 2), px.

    Its degree is 5, or 3 for few points: what is left of an intensifier's distortion is below 1 px (physics.md).
    """
    middle = index.mean(axis=0)
    scale = np.abs(index - middle).max()
    degree = 5 if len(index) >= 2 * MIN_POINTS + 2 else 3
    terms = monomials((index - middle) / scale, degree)
    coefficients = np.linalg.lstsq(terms, uv_px, rcond=None)[0]
    return monomials((sites - middle) / scale, degree) @ coefficients, uv_px - terms @ coefficients
