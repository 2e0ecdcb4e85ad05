"""Identify the plate and orientation of grown lattices by comparing all ways to place a plate on them."""

from collections.abc import Iterable
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numba import njit

from sightline.detection.labelling.growth import Grown
from sightline.detection.labelling.patterns import Pattern
from sightline.detection.labelling.seeds import complex_points, real_points
from sightline.fitting.kernels import exact_squares
from sightline.fitting.robust import median

# Cost of a bead: half the square of its log-radius error over RADIUS_SD, at most CONTRADICTION. That is the log odds
# against a misjudged size, or against a bead where the plate has none (2 % each) [ours].
RADIUS_SD = 0.1
CONTRADICTION = 4.0
HOPELESS = 24.0  # excess cost at which a reading is abandoned: six contradictions [ours]
ON_PLACE = 0.25  # of the pitch [ours]
CELLS = 96
SECTOR = np.pi / 6  # rotations of the plates of one view agree to within half of this [ours]


@dataclass(frozen=True, eq=False)
class Readings:
    """The cheapest of all ways (readings) to place one pattern on one lattice, neighbours on neighbours.

    Per class (24,), the handedness and rotation sector in the image, which both plates of a view share: the lowest
    `cost`, the `second` lowest, and the `index` of the cheapest reading. `index` is -1 where there is no reading, or an
    abandoned one, whose cost is too low.
    """

    pattern: Pattern
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

    Beads `z` = x + iy, mm; `larger`: log sizes over the median; two neighbours at `origin` and at `away` from it.
    `own`: the reading of its own pattern with which the lattice was grown. `tilt_rad`: rotation of the plate in the
    image; `mirror`: whether it is a mirror image.
    """

    z: np.ndarray
    larger: np.ndarray
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


@njit(cache=True, error_model="numpy", forceinline=True)
def _reading(start, step, origin, away, flip):
    """Return rotation and shift of z = x + iy, mm, conjugated first for `flip`.

    They place the beads at `origin` and `away` from it on a pair of neighbours of a pattern, at `start` and `step` from
    it.
    """
    per_mm2 = 1.0 / (away.real**2 + away.imag**2)
    rotation = step * complex(away.real * per_mm2, (away.imag if flip else -away.imag) * per_mm2)
    return rotation, start - rotation * (origin.conjugate() if flip else origin)


@njit(cache=True, error_model="numpy")
def _cost_on_place(larger, sizes):
    """Return the cost (N, P + 1) of each bead on each place, by its size, and off all places."""
    out = np.empty((len(larger), len(sizes) + 1))
    for n in range(len(larger)):
        for p in range(len(sizes)):
            out[n, p] = min(CONTRADICTION, 0.5 * ((larger[n] - sizes[p]) / RADIUS_SD) ** 2)
        out[n, len(sizes)] = CONTRADICTION
    return out


@njit(cache=True, error_model="numpy")
def _cheapest(beads, pattern, least, costs):
    """Fill `costs`; return the lowest cost of all and of `least`, which is infinite for the lattice's own pattern."""
    of_place = _cost_on_place(beads.larger, pattern.larger)
    first, second, index = costs
    x, y, count = beads.z.real.copy(), beads.z.imag.copy(), len(beads.z)
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

    def readings(self, patterns: Iterable[Pattern], reference_rad: float) -> dict[Pattern, Readings]:
        """Return the cheapest readings for each pattern; sectors are counted from `reference_rad`."""
        out, least = {}, np.inf
        similarity = self.grown.sheet.similarity
        beads = _Beads(
            self.z,
            self.larger,
            self.origin,
            self.away,
            self.own,
            float(np.angle(self.away)),
            float(np.angle(similarity.rotation)) - reference_rad,
            similarity.mirror,
        )
        for pattern in sorted(patterns, key=lambda one: one is not self.grown.pattern):
            costs = _Costs(np.full(24, np.inf), np.full(24, np.inf), np.full(24, -1))
            least = _cheapest(beads, _map_of(pattern), least, costs)
            out[pattern] = Readings(pattern, costs.first, costs.second, costs.cheapest)
        return out

    def places(self, pattern: Pattern, index: int) -> tuple[np.ndarray, bool]:
        """Return the place of each of the lattice's `all_rows` under a reading, or -1.

        And whether the reading is the one with which the lattice was grown.
        """
        to, flip = _map_of(pattern), index >= len(pattern.neighbours)
        k = index % len(pattern.neighbours)
        rotation, shift = _reading(to.start[k], to.step[k], self.origin, self.away, flip)
        z = complex_points(self.grown.xy_mm[self.grown.all_rows])
        d2 = exact_squares(real_points(rotation * (z.conj() if flip else z) + shift), pattern.xy_mm)
        own = pattern is self.grown.pattern and not flip and abs(rotation - 1) < 1e-9 and abs(shift) < 1e-6
        return np.where(d2.min(axis=1) < (ON_PLACE * pattern.pitch_mm) ** 2, d2.argmin(axis=1), -1), own


def most_like(grown: Grown, patterns: Iterable[Pattern]) -> Pattern:
    """Return the pattern that is most like a lattice."""
    lattice = _Lattice.of(grown)
    if lattice is None:
        return grown.pattern
    return min(lattice.readings(patterns, 0.0).values(), key=lambda one: one.cost.min()).pattern


@dataclass(frozen=True, eq=False)
class Naming:
    """The cheapest joint reading of one or two lattices: the pattern of each, and the places of its `all_rows`.

    `margin`: excess cost of the next best reading; `margin_in_view`: of the next best one in the same view.
    `unchanged`: the reading is the one with which the lattices were grown.
    """

    patterns: tuple[Pattern, ...]
    places: tuple[np.ndarray, ...]
    margin: float
    margin_in_view: float
    unchanged: bool


def name(pair: tuple[Grown, Grown], couples: list[tuple[Pattern, Pattern]]) -> Naming | None:
    """Return the best reading of two lattices as the plates, in either order, of one of `couples`.

    The first of `couples` wins a tie. None where a lattice has no two neighbouring beads or fits no pattern.
    """
    lattices = [_Lattice.of(grown) for grown in pair]
    if lattices[0] is None or lattices[1] is None:
        return None
    reference = float(np.angle(pair[0].sheet.similarity.rotation))
    every = [pattern for couple in couples for pattern in couple]
    read = [lattice.readings(every, reference) for lattice in lattices if lattice]
    ways = [(read[0][a], read[1][b]) for couple in couples for a, b in (couple, couple[::-1])]
    totals = [a.cost + b.cost for a, b in ways]
    best = int(np.argmin([total.min() for total in totals]))
    first, second = ways[best]
    c = int(totals[best].argmin())
    if first.index[c] < 0 or second.index[c] < 0:
        return None
    cost = float(totals[best][c])
    totals[best][c] = min(first.second[c] + second.cost[c], first.cost[c] + second.second[c])
    rivals = np.array([total.min() for total in totals])
    in_view = [a.pattern.view == first.pattern.view for a, _ in ways]
    places0, own0 = lattices[0].places(first.pattern, int(first.index[c]))
    places1, own1 = lattices[1].places(second.pattern, int(second.index[c]))
    return Naming(
        patterns=(first.pattern, second.pattern),
        places=(places0, places1),
        margin=float(rivals.min()) - cost,
        margin_in_view=float(rivals[in_view].min()) - cost,
        unchanged=own0 and own1,
    )


def name_alone(grown: Grown) -> Naming | None:
    """Return the best reading of a lattice as its plate; None where no two beads are neighbours, or none fits."""
    lattice = _Lattice.of(grown)
    if lattice is None:
        return None
    read = lattice.readings([grown.pattern], 0.0)[grown.pattern]
    c = int(read.cost.argmin())
    if read.index[c] < 0:
        return None
    margin = float(min(read.second[c], np.delete(read.cost, c).min()) - read.cost[c])
    places, own = lattice.places(grown.pattern, int(read.index[c]))
    return Naming((grown.pattern,), (places,), margin, margin, own)
