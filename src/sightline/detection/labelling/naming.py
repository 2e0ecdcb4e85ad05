"""Identify the plate and orientation of grown lattices by comparing all ways to place a plate on them."""

from cmath import phase
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from sightline.common.fitting import exact_squares, median
from sightline.common.kernels import kernel
from sightline.detection.labelling.growth import Grown
from sightline.detection.labelling.patterns import Pattern
from sightline.detection.labelling.seeds import complex_points, real_points

# Cost of a bead: half the square of its log-radius error over RADIUS_SD, at most CONTRADICTION. That is the log odds
# against a misjudged size, or against a bead where the plate has none: log(0.98 / 0.02) = 3.9 [twin: 2 % each].
RADIUS_SD = 0.1
CONTRADICTION = 4.0
HOPELESS = 6 * CONTRADICTION  # excess cost at which a reading is abandoned
ON_PLACE = 0.25  # of the pitch [ours]
CELLS = 96
SECTOR = np.pi / 6  # rotations of the plates of one view agree to within half of this [ours]


@dataclass(frozen=True, eq=False)
class Readings:
    """The cheapest of all ways (readings) to place each of P patterns on one lattice, neighbours on neighbours.

    Per pattern and class (P, 24), the handedness and rotation sector in the image, which both plates of a view share:
    the lowest `cost`, the `second` lowest, and the `index` of the cheapest reading. `index` is -1 where there is no
    reading, or an abandoned one, whose cost is too low.
    """

    cost: np.ndarray
    second: np.ndarray
    index: np.ndarray


class _Map(NamedTuple):
    """A pattern in the form that kernels need.

    `table`: the place within reach of each of CELLS x CELLS cells of `cell` mm from the corner `low`, or P. Pairs of
    neighbours are places `start` with steps `step` in directions `step_rad`; `larger`: log sizes over the median.
    """

    table: np.ndarray
    low: np.ndarray
    cell: float
    start: np.ndarray
    step: np.ndarray
    step_rad: np.ndarray
    larger: np.ndarray


@lru_cache(maxsize=32)
def _map_of(pattern: Pattern) -> _Map:
    low = pattern.xy_mm.min(axis=0) - pattern.pitch_mm
    cell = float((pattern.xy_mm.max(axis=0) + pattern.pitch_mm - low).max() / CELLS)
    middle = low + (np.indices((CELLS, CELLS)).reshape(2, -1).T + 0.5) * cell
    table = np.empty(len(middle), np.int64)
    for row in range(0, len(middle), CELLS):  # the distances of all cells would take 8 MB
        distance = np.sqrt(exact_squares(middle[row : row + CELLS], pattern.xy_mm))
        near = distance.min(axis=1) < ON_PLACE * pattern.pitch_mm
        table[row : row + CELLS] = np.where(near, distance.argmin(axis=1), len(pattern.z))
    start, end = pattern.z[pattern.neighbours].T
    step = end - start
    larger = pattern.log_half - median(pattern.log_half)
    return _Map(table.reshape(CELLS, CELLS), low, cell, np.ascontiguousarray(start), step, np.angle(step), larger)


class _Beads(NamedTuple):
    """A lattice in the form that kernels need.

    Beads at `x`, `y`, mm; two neighbours at `origin` and at `away` from it, x + iy. `own`: the reading of its own
    pattern with which the lattice was grown. `tilt_rad`: rotation of the plate in the image; `mirror`: whether it is a
    mirror image.
    """

    x: np.ndarray
    y: np.ndarray
    origin: complex
    away: complex
    own: int
    away_rad: float
    tilt_rad: float
    mirror: bool


class _Costs(NamedTuple):
    """The two lowest costs of each class of readings (24,), and the index of the cheapest reading."""

    first: np.ndarray
    second: np.ndarray
    cheapest: np.ndarray


@kernel()
def _reading(start, step, origin, away, flip):
    """Return rotation and shift of z = x + iy, mm, conjugated first for `flip`.

    They place the beads at `origin` and `away` from it on a pair of neighbours of a pattern, at `start` and `step` from
    it.
    """
    per_mm2 = 1.0 / (away.real**2 + away.imag**2)
    rotation = step * complex(away.real * per_mm2, (away.imag if flip else -away.imag) * per_mm2)
    return rotation, start - rotation * (origin.conjugate() if flip else origin)


@kernel()
def _cheapest(beads, pattern, of_place, least, costs):
    """Fill `costs`; return the lowest cost of all and of `least`, which is infinite for the lattice's own pattern.

    `of_place` (N, P + 1): the cost of each bead on each place, by its size, and off all places.
    """
    first, second, index = costs
    x, y, count = beads.x, beads.y, len(beads.x)
    table, starts, steps, step_rad = pattern.table, pattern.start, pattern.step, pattern.step_rad
    per_mm, low_u, low_v, readings = 1.0 / pattern.cell, pattern.low[0], pattern.low[1], len(pattern.step)
    # Its own reading, first, is usually cheap, so that most others are soon abandoned.
    for turn in range(-1 if least == np.inf else 0, 2 * readings):
        t = beads.own if turn < 0 else turn
        k, flip, limit = t % readings, t >= readings, least + HOPELESS
        rotation, shift = _reading(starts[k], steps[k], beads.origin, beads.away, flip)
        a, b, sign = rotation.real * per_mm, rotation.imag * per_mm, -1.0 if flip else 1.0
        u, v, cost = (shift.real - low_u) * per_mm, (shift.imag - low_v) * per_mm, 0.0
        for begin in range(0, count, 4):
            if cost > limit:
                break
            for n in range(begin, min(begin + 4, count)):
                i = min(max(a * x[n] - b * (sign * y[n]) + u, 0.0), CELLS - 1.0)
                j = min(max(a * (sign * y[n]) + b * x[n] + v, 0.0), CELLS - 1.0)
                cost += of_place[n, table[int(i), int(j)]]
        least = min(least, cost)
        if turn < 0:
            continue
        mirrored = flip != beads.mirror
        rotation_rad = step_rad[k] + (beads.away_rad if flip else -beads.away_rad)
        sector = int(np.floor((rotation_rad + (beads.tilt_rad if mirrored else -beads.tilt_rad)) / SECTOR + 0.5))
        c = sector % 12 + 12 * mirrored  # the reading's class
        if cost < first[c]:
            first[c], second[c], index[c] = cost, first[c], -1 if cost > limit else t
        else:
            second[c] = min(second[c], cost)
    return least


@dataclass(frozen=True, eq=False)
class _Lattice:
    """A lattice to identify: beads `z` = x + iy, mm, and `larger`, log sizes over the median, largest beads first.

    Large beads are the most informative. Two beads on neighbouring places lie at `origin` and at `away` from it: the
    pair `own` of the pattern's neighbours.
    """

    grown: Grown
    z: np.ndarray
    larger: np.ndarray
    origin: complex
    away: complex
    own: int

    @staticmethod
    def of(grown: Grown) -> "_Lattice | None":
        """Return the lattice of `grown`; None where no two beads are neighbours."""
        pattern, rows = grown.pattern, grown.all_rows
        seen = np.zeros(len(pattern.ids), dtype=bool)
        seen[grown.all_places] = True
        first, second, middles = pattern.neighbouring
        pairs = np.flatnonzero(seen[first] & seen[second])
        if not len(pairs):
            return None
        z = complex_points(grown.xy_mm[rows])
        own = int(pairs[np.abs(middles[pairs] - z.mean()).argmin()])  # near the middle
        origin, other = complex(pattern.z[first[own]]), complex(pattern.z[second[own]])
        larger = grown.log_ratio[rows]
        larger = larger - median(larger)
        telling = np.argsort(-larger)
        return _Lattice(grown, z[telling], larger[telling], origin, other - origin, own)

    def readings(self, patterns: Sequence[Pattern], reference_rad: float) -> Readings:
        """Return the cheapest readings of patterns; sectors are counted from `reference_rad`."""
        similarity, least = self.grown.sheet.similarity, np.inf
        tilt_rad = phase(similarity.rotation) - reference_rad
        own = self.origin, self.away, self.own, phase(self.away), tilt_rad, similarity.mirror
        (x, y), shape = real_points(self.z).T.copy(), (len(patterns), 24)
        beads = _Beads(x, y, *own)
        cheapest = Readings(np.full(shape, np.inf), np.full(shape, np.inf), np.full(shape, -1))
        for k in sorted(range(len(patterns)), key=lambda k: patterns[k] is not self.grown.pattern):
            held, costs = _map_of(patterns[k]), _Costs(cheapest.cost[k], cheapest.second[k], cheapest.index[k])
            sizes = np.append(held.larger, np.inf)  # of no place
            of_place = np.minimum(0.5 * ((self.larger[:, None] - sizes) / RADIUS_SD) ** 2, CONTRADICTION)
            least = _cheapest(beads, held, of_place, least, costs)
        return cheapest

    def is_own(self, pattern: Pattern, index: int) -> bool:
        """Return whether a reading is the one with which the lattice was grown."""
        rotation, shift, flip = self._reading(pattern, index)
        return pattern is self.grown.pattern and not flip and abs(rotation - 1) < 1e-9 and abs(shift) < 1e-6

    def places(self, pattern: Pattern, index: int) -> np.ndarray:
        """Return the place of each of the lattice's `all_rows` under a reading, or -1."""
        rotation, shift, flip = self._reading(pattern, index)
        z = complex_points(self.grown.xy_mm[self.grown.all_rows])
        d2 = exact_squares(real_points(rotation * (z.conj() if flip else z) + shift), pattern.xy_mm)
        return np.where(d2.min(axis=1) < (ON_PLACE * pattern.pitch_mm) ** 2, d2.argmin(axis=1), -1)

    def _reading(self, pattern: Pattern, index: int) -> tuple[complex, complex, bool]:
        to, flip = _map_of(pattern), index >= len(pattern.neighbours)
        k = index % len(pattern.neighbours)
        return *_reading(to.start[k], to.step[k], self.origin, self.away, flip), flip


def most_like(grown: Grown, patterns: Sequence[Pattern]) -> Pattern:
    """Return the pattern that is most like a lattice."""
    lattice = _Lattice.of(grown)
    if lattice is None:
        return grown.pattern
    return patterns[int(lattice.readings(patterns, 0.0).cost.min(axis=1).argmin())]


@dataclass(frozen=True, eq=False)
class Naming:
    """The cheapest joint reading of one or two lattices: the pattern of each, and the places of its `all_rows`.

    `margin`: excess cost of the next best reading; `margin_in_view`: of the next best one in the same view. `places`:
    None where the reading is the one with which the lattices were grown.
    """

    patterns: tuple[Pattern, ...]
    places: tuple[np.ndarray, ...] | None
    margin: float
    margin_in_view: float


def _places(lattices: Sequence[_Lattice], read: Sequence[tuple[Pattern, int]]) -> tuple[np.ndarray, ...] | None:
    """Return `Naming.places` of one reading of each lattice: a pattern, and the index of its reading."""
    ways = list(zip(lattices, read, strict=True))
    if all(lattice.is_own(*way) for lattice, way in ways):
        return None
    return tuple(lattice.places(*way) for lattice, way in ways)


def name(pair: tuple[Grown, Grown], couples: list[tuple[Pattern, Pattern]]) -> Naming | None:
    """Return the best reading of two lattices as the plates, in either order, of one of `couples`.

    The first of `couples` wins a tie. None where a lattice has no two neighbouring beads or fits no pattern.
    """
    lattices = [lattice for lattice in map(_Lattice.of, pair) if lattice]
    if len(lattices) < 2:
        return None
    reference = phase(pair[0].sheet.similarity.rotation)
    every = [pattern for couple in couples for pattern in couple]
    first, two = (lattice.readings(every, reference) for lattice in lattices)
    other = np.arange(len(every)) ^ 1  # the other plate of each one's couple
    totals = first.cost + two.cost[other]  # (P, 24): the first lattice is pattern P, the second one the other plate
    best, c = (int(k) for k in np.unravel_index(totals.argmin(), totals.shape))
    second = int(other[best])
    if first.index[best, c] < 0 or two.index[second, c] < 0:
        return None
    cost = float(totals[best, c])
    totals[best, c] = min(first.second[best, c] + two.cost[second, c], first.cost[best, c] + two.second[second, c])
    rivals = totals.min(axis=1)
    return Naming(
        patterns=(every[best], every[second]),
        places=_places(
            lattices, ((every[best], int(first.index[best, c])), (every[second], int(two.index[second, c])))
        ),
        margin=float(rivals.min()) - cost,
        margin_in_view=float(min(rivals[k] for k, plate in enumerate(every) if plate.view == every[best].view)) - cost,
    )


def name_alone(grown: Grown) -> Naming | None:
    """Return the best reading of a lattice as its plate; None where no two beads are neighbours, or none fits."""
    lattice = _Lattice.of(grown)
    if lattice is None:
        return None
    read = lattice.readings([grown.pattern], 0.0)
    c = int(read.cost[0].argmin())
    if read.index[0, c] < 0:
        return None
    margin = float(min(read.second[0, c], np.delete(read.cost[0], c).min()) - read.cost[0, c])
    return Naming((grown.pattern,), _places([lattice], [(grown.pattern, int(read.index[0, c]))]), margin, margin)
