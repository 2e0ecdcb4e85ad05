"""Which plate a grown lattice is, and which way round: every other way of laying a plate on it is held against it."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numba import njit

from sightline.detection.labelling.growth import Grown
from sightline.detection.labelling.patterns import Pattern

# A bead costs half its squared log-radius error over RADIUS_SD, at most CONTRADICTION: the log odds against a
# misjudged size, or against a bead where the plate has none (2 % each) [ours].
RADIUS_SD = 0.1
CONTRADICTION = 4.0
HOPELESS = 24.0  # a reading that costs as much more than another is not followed further: six contradictions [ours]
ON_PLACE = 0.25  # of the pitch [ours]
CELLS = 96
SECTOR = np.pi / 6  # two plates of one view are turned alike within half of this [ours]


@dataclass(frozen=True, eq=False)
class Readings:
    """All ways to lay one pattern on one lattice: turn · z + shift of z = x + iy, mm, conjugate first if `flip`."""

    pattern: Pattern
    turn: np.ndarray
    shift: np.ndarray
    flip: np.ndarray
    cost: np.ndarray


@lru_cache(maxsize=32)
def _place_table(pattern: Pattern) -> tuple[np.ndarray, np.ndarray, float]:
    """The place within reach of each of CELLS x CELLS cells over the plate, or -1; the corner and the cell, mm."""
    low = pattern.xy_mm.min(axis=0) - pattern.pitch_mm
    cell = float((pattern.xy_mm.max(axis=0) + pattern.pitch_mm - low).max() / CELLS)
    middle = low + (np.indices((CELLS, CELLS)).reshape(2, -1).T + 0.5) * cell
    distance = np.linalg.norm(middle[:, None] - pattern.xy_mm[None], axis=2)
    table = np.where(distance.min(axis=1) < ON_PLACE * pattern.pitch_mm, distance.argmin(axis=1), -1)
    return table.reshape(CELLS, CELLS), low, cell


@njit(cache=True)
def _costs(z, log_ratio, turn, shift, flip, table, low, cell, log_half):  # noqa: PLR0917 - a kernel
    out = np.zeros(len(turn))
    of_place = np.empty((len(z), len(log_half) + 1))
    of_place[:, -1] = CONTRADICTION  # place -1: none
    for n in range(len(z)):
        for p in range(len(log_half)):
            of_place[n, p] = min(CONTRADICTION, 0.5 * ((log_ratio[n] - log_half[p]) / RADIUS_SD) ** 2)
    cells, least = 1.0 / cell, np.inf
    for t in range(len(turn)):
        for n in range(len(z)):
            at = turn[t] * (z[n].conjugate() if flip[t] else z[n]) + shift[t]
            x, y = (at.real - low[0]) * cells, (at.imag - low[1]) * cells
            inside = 0.0 <= x < CELLS and 0.0 <= y < CELLS
            out[t] += of_place[n, table[int(x), int(y)] if inside else -1]
            if out[t] > least + HOPELESS:
                break
        least = min(least, out[t])
    return out


@lru_cache(maxsize=8)
def _base_pair(grown: Grown) -> tuple[int, int] | None:
    """Two detections on neighbouring places, as near to the middle of the lattice as there are."""
    row_of = np.full(len(grown.pattern.ids), -1)
    row_of[grown.all_places] = grown.all_rows
    pairs = row_of[grown.pattern.neighbours]
    pairs = pairs[(pairs >= 0).all(axis=1)]
    if not len(pairs):
        return None
    off = grown.xy_mm[pairs].mean(axis=1) - grown.xy_mm[grown.all_rows].mean(axis=0)
    return tuple(pairs[np.argmin((off**2).sum(axis=1))].tolist())


def readings(grown: Grown, pattern: Pattern) -> Readings | None:
    """Every way to lay `pattern` on a grown lattice, neighbours on neighbours, and what it costs."""
    base = _base_pair(grown)
    if base is None:
        return None
    row_of = dict(zip(grown.all_rows.tolist(), grown.all_places.tolist(), strict=True))
    origin, other = (complex(*grown.pattern.xy_mm[row_of[r]]) for r in base)
    z = pattern.xy_mm @ np.array([1.0, 1j])
    a, b = z[pattern.neighbours[:, 0]], z[pattern.neighbours[:, 1]]
    step = other - origin
    turn = np.concatenate([(b - a) / step, (b - a) / step.conjugate()])
    shift = np.concatenate([a, a]) - turn * np.repeat([origin, origin.conjugate()], len(a))
    flip = np.repeat([False, True], len(a))
    table, low, cell = _place_table(pattern)
    log_half = np.log(pattern.diameter_mm / 2)
    log_ratio = grown.log_ratio[grown.all_rows]
    larger = log_ratio - np.median(log_ratio)
    telling = np.argsort(-larger)  # first the beads that few readings explain
    cost = _costs(
        grown.xy_mm[grown.all_rows[telling]] @ np.array([1.0, 1j]),
        larger[telling],
        turn,
        shift,
        flip,
        table,
        low,
        cell,
        log_half - np.median(log_half),
    )
    return Readings(pattern, turn, shift, flip, cost)


def _classes(grown: Grown, r: Readings, reference_rad: float) -> np.ndarray:
    """Handedness and sector of each reading against the image: plates of one view must agree in them."""
    mirror = r.flip ^ grown.sheet.similarity.mirror
    off = np.angle(grown.sheet.similarity.turn) - reference_rad
    sector = np.round((np.angle(r.turn) + np.where(mirror, off, -off)) / SECTOR).astype(int) % 12
    return sector + 12 * mirror


@dataclass(frozen=True, eq=False)
class Naming:
    """The cheapest reading of two lattices together: the pattern of each, and the places of its `all_rows`.

    `margin`: by how much any other reading costs more; `margin_in_view`: any other one of the same view.
    `unchanged`: the reading is the one with which the lattices came.
    """

    patterns: tuple[Pattern, Pattern]
    places: tuple[np.ndarray, np.ndarray]
    cost: float
    margin: float
    margin_in_view: float
    unchanged: bool


@njit(cache=True)
def _two_smallest(cost, classes):
    """(24,) the least and the second least cost of each class, and the index of the least."""
    first, second, index = np.full(24, np.inf), np.full(24, np.inf), np.full(24, -1)
    for t in range(len(cost)):
        c = classes[t]
        if cost[t] < first[c]:
            first[c], second[c], index[c] = cost[t], first[c], t
        else:
            second[c] = min(second[c], cost[t])
    return first, second, index


def _places(grown: Grown, r: Readings, index: int) -> np.ndarray:
    """(rows,) the place of each of the lattice's beads under a reading, -1 where there is none."""
    z = grown.xy_mm[grown.all_rows] @ np.array([1.0, 1j])
    at = r.turn[index] * (z.conj() if r.flip[index] else z) + r.shift[index]
    d = np.abs(at[:, None] - (r.pattern.xy_mm @ np.array([1.0, 1j]))[None])
    return np.where(d.min(axis=1) < ON_PLACE * r.pattern.pitch_mm, d.argmin(axis=1), -1)


def _is_own(grown: Grown, r: Readings, index: int) -> bool:
    """Whether a reading is the one with which the lattice came."""
    same = not r.flip[index] and abs(r.turn[index] - 1) < 1e-9 and abs(r.shift[index]) < 1e-6
    return r.pattern is grown.pattern and bool(same)


def name(pair: tuple[Grown, Grown], couples: list[tuple[Pattern, Pattern]]) -> Naming | None:
    """The best reading of two lattices as XRII and source plate, either way round, of one of `couples`.

    The first of `couples` wins a tie. None where a lattice has no two neighbouring beads.
    """
    reference = float(np.angle(pair[0].sheet.similarity.turn))
    found = []
    for couple in couples:
        for order in ((0, 1), (1, 0)):
            read = [readings(pair[k], pattern) for k, pattern in zip(order, couple, strict=True)]
            if read[0] is None or read[1] is None:
                return None
            both = [(pair[k], r) for k, r in zip(order, read, strict=True) if r]
            found.append((order, both, [_two_smallest(r.cost, _classes(g, r, reference)) for g, r in both]))
    totals = [a[0] + b[0] for _, _, (a, b) in found]
    best = int(np.argmin([total.min() for total in totals]))
    if not np.isfinite(totals[best].min()):
        return None
    order, both, (a, b) = found[best]
    c = int(totals[best].argmin())
    cost = float(totals[best][c])
    totals[best][c] = min(a[1][c] + b[0][c], a[0][c] + b[1][c])
    rivals = np.array([total.min() for total in totals])
    same_view = [one[1][0][1].pattern.view == both[0][1].pattern.view for one in found]
    chosen = [(g, r, int(index)) for (g, r), index in zip(both, (a[2][c], b[2][c]), strict=True)]
    first, second = (chosen[order.index(k)] for k in (0, 1))
    return Naming(
        patterns=(first[1].pattern, second[1].pattern),
        places=(_places(*first), _places(*second)),
        cost=cost,
        margin=float(rivals.min()) - cost,
        margin_in_view=float(rivals[same_view].min()) - cost,
        unchanged=_is_own(*first) and _is_own(*second),
    )
