"""Datum patterns: the balls of a grid that are large, chosen so that any three give plate, orientation and handedness.

Points are (N, 2) in steps of a plate's own grid, which the ordinary balls show in an image. Three points resemble three
others if an affine map that can occur in an image takes one to the other, mirrored or not: a tilt of 20° stretches by
1.064, pincushion at the rim by a few per cent more.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations, permutations

import numpy as np

from sightline.errors import FrameError

STRETCH = 1.10  # [ours] ratio of the singular values of that affine map
SCALE = STRETCH  # its mean scale, with the step of the grid known from the ordinary balls
HIDDEN = 0.4  # [ours] share of a plate that metal may hide as one block; with more, the map has no support either
SLENDER_STEPS = 0.9  # [ours] triples of a smaller height count as collinear: a bead's noise may flip them
MOVES = 6000  # [ours] of the search for a pattern: one or two seconds
_ORDERS = np.array(list(permutations(range(3))))
_CONGRUENT = 1e-6  # resemblance of triples that are congruent on the grid


@dataclass(frozen=True, eq=False)
class Triples:
    """The triples of a pattern: `gram` (T, 6, 3) of two sides for every order of corners; `area`, `height` (T,)."""

    gram: np.ndarray
    area: np.ndarray
    height: np.ndarray

    @staticmethod
    def of(points: np.ndarray) -> "Triples":
        """Return the triples of points (N, 2)."""
        corners = points[np.array(list(combinations(range(len(points)), 3)), dtype=int).reshape(-1, 3)]
        ordered = corners[:, _ORDERS]
        a, b = ordered[:, :, 1] - ordered[:, :, 0], ordered[:, :, 2] - ordered[:, :, 0]
        gram = np.stack([(a * a).sum(-1), (a * b).sum(-1), (b * b).sum(-1)], axis=-1)
        area = np.abs(a[:, 0, 0] * b[:, 0, 1] - a[:, 0, 1] * b[:, 0, 0])
        return Triples(gram, area, area / np.sqrt(gram[:, :, 0].max(axis=1)))

    def broad(self) -> "Triples":
        """Return the triples that are not slender."""
        keep = self.height >= SLENDER_STEPS
        return Triples(self.gram[keep], self.area[keep], self.height[keep])


def resemblance(one: Triples, other: Triples) -> np.ndarray:
    """Return (T1, 6, T2): the distance of each triple from another in each order of corners.

    It is the larger of log stretch and log scale of the affine map between them, over their limits: below 1 an image
    may confuse the two.
    """
    inverse = np.stack([other.gram[:, 0, 2], -2 * other.gram[:, 0, 1], other.gram[:, 0, 0]]) / other.area**2
    scale2 = one.area[:, None, None] / other.area
    cosh = (one.gram @ inverse) / (2 * scale2)
    return np.maximum(np.arccosh(np.maximum(cosh, 1.0)) / np.log(STRETCH), np.abs(np.log(scale2)) / (2 * np.log(SCALE)))


def in_steps(xy_mm: np.ndarray) -> np.ndarray:
    """Return points of a plate (N, 2) in steps, the median distance of a point from its nearest neighbour."""
    from scipy.spatial import KDTree  # here: views of a frame need no other part of it, and it takes 6 MB

    nearest, _ = KDTree(xy_mm).query(xy_mm, k=2)
    return (xy_mm - xy_mm.mean(axis=0)) / np.median(nearest[:, 1])


def nearest_likeness(points: np.ndarray, others: Sequence[np.ndarray] = ()) -> np.ndarray:
    """Return (T,): the smallest `resemblance` of each triple that is not slender to a triple of other patterns.

    Without `others`: to the triples of its own pattern, and to itself rotated or mirrored.
    """
    triples = Triples.of(points).broad()
    if others:
        far = [resemblance(triples, Triples.of(other).broad()).min(axis=(1, 2), initial=np.inf) for other in others]
        return np.min(far, axis=0)
    return _own_resemblance(triples).min(axis=(1, 2), initial=np.inf)


def _own_resemblance(triples: Triples) -> np.ndarray:
    far = resemblance(triples, triples)
    far[np.arange(len(far)), 0, np.arange(len(far))] = np.inf
    return far


def hidden_blocks(points: np.ndarray) -> np.ndarray:
    """Return (B, N) bool: balls hidden by blocks of the share HIDDEN, from each side, round or square about a ball."""
    count = int(HIDDEN * len(points))
    angles = np.arange(0, 2 * np.pi, np.pi / 18)
    orders = [points @ (np.cos(angle), np.sin(angle)) for angle in angles]
    orders += [np.linalg.norm(points - centre, ord=norm, axis=1) for centre in points for norm in (2, np.inf)]
    hidden = np.zeros((len(orders), len(points)), dtype=bool)
    for row, order in zip(hidden, orders, strict=True):
        row[np.argsort(order, kind="stable")[:count]] = True
    return hidden


def search(grids: Sequence[np.ndarray], count: int, rng: np.random.Generator, moves: int = MOVES) -> list[np.ndarray]:
    """Return the indices of `count` datums for each grid (N, 2): few triples resemble each other, none is congruent.

    Simulated annealing: one datum moves at a time; patterns of which a hidden block leaves fewer than three are
    excluded. Raises FrameError where no such pattern is found.
    """
    left = [~hidden_blocks(points) for points in grids]
    chosen = [_start(points, left[plate], count, rng) for plate, points in enumerate(grids)]
    triples = [Triples.of(points[indices]) for points, indices in zip(grids, chosen, strict=True)]
    best, energy, lowest = list(chosen), 0.0, 0.0
    for heat in 3.0 * (1 - np.arange(moves) / moves) ** 2 + 0.02:
        plate = int(rng.integers(len(grids)))
        moved = _moved(chosen[plate], len(grids[plate]), rng)
        if not _lasts(grids[plate][moved], left[plate][:, moved]):
            continue
        others = [plate_triples for other, plate_triples in enumerate(triples) if other != plate]
        tried = Triples.of(grids[plate][moved])
        change = _energy(tried, others) - _energy(triples[plate], others)
        if change > 0 and rng.random() >= np.exp(-change / heat):
            continue
        chosen[plate], triples[plate] = moved, tried
        energy += change
        if energy < lowest - 1e-9:
            best, lowest = list(chosen), energy
    return [np.sort(indices) for indices in best]


def _start(points: np.ndarray, left: np.ndarray, count: int, rng: np.random.Generator) -> np.ndarray:
    for _ in range(2000):
        chosen = rng.choice(len(points), min(count, len(points)), replace=False)
        if _lasts(points[chosen], left[:, chosen]):
            return chosen
    raise FrameError(f"found no {count} datums of a plate of which three always stay visible; ask for 6")


def _moved(chosen: np.ndarray, places: int, rng: np.random.Generator) -> np.ndarray:
    free = np.setdiff1d(np.arange(places), chosen)
    moved = chosen.copy()
    moved[rng.integers(len(moved))] = rng.choice(free)
    return moved


def _lasts(points: np.ndarray, left: np.ndarray) -> bool:
    """Return whether no three datums are collinear and every hidden block leaves three."""
    return bool(left.sum(axis=1).min() >= 3 and Triples.of(points).area.min() > 0)


def _energy(triples: Triples, others: Sequence[Triples]) -> float:
    """Return the penalty of one plate's triples that resemble others; congruent ones weigh most, slender ones least."""
    own = _own_resemblance(triples)
    pairs = np.concatenate([resemblance(triples, other).ravel() for other in others])
    near, own_near = pairs[pairs < 1], own[own < 1]
    slender = (triples.height < SLENDER_STEPS).sum()
    return float(_weight(near) + _weight(own_near) / 2 + 0.2 * slender)


def _weight(near: np.ndarray) -> float:
    return float((2.0 - 1.5 * near + 8.0 * (near < _CONGRUENT)).sum())
