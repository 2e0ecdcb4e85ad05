"""Datum patterns: which balls of a grid are large, so that any three of them tell plate, orientation and handedness.

Points are (N, 2) in steps of a plate's own grid, which the ordinary balls show in an image. Three points resemble three
others if an affine map that an image may hold takes one to the other, mirrored or not: a tilt of 20° stretches by
1.064, pincushion at the rim by a few per cent more.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations, permutations

import numpy as np
from scipy.spatial import KDTree

from sightline.errors import FrameError

STRETCH = 1.10  # [ours] ratio of the singular values of that affine map
SCALE = 1.10  # [ours] its mean scale, once the step of the grid is known from the ordinary balls
HIDDEN = 0.4  # the labelling is to bear this share of a plate hidden, as one block [ours]
SLENDER_STEPS = 0.9  # [ours] triples lower than this are called collinear: a bead's own noise may flip them
MOVES = 6000  # [ours] one or two seconds
_ORDERS = np.array(list(permutations(range(3))))
_CONGRUENT = 1e-6  # resemblance of triples that are congruent on the grid


@dataclass(frozen=True, eq=False)
class Triples:
    """The triples of a pattern: `gram` (T, 6, 3) of two sides, corners in every order; `area`, least `height` (T,)."""

    gram: np.ndarray
    area: np.ndarray
    height: np.ndarray

    @staticmethod
    def of(points: np.ndarray) -> "Triples":
        """The triples of points (N, 2)."""
        corners = points[np.array(list(combinations(range(len(points)), 3)), dtype=int).reshape(-1, 3)]
        ordered = corners[:, _ORDERS]
        a, b = ordered[:, :, 1] - ordered[:, :, 0], ordered[:, :, 2] - ordered[:, :, 0]
        gram = np.stack([(a * a).sum(-1), (a * b).sum(-1), (b * b).sum(-1)], axis=-1)
        area = np.abs(a[:, 0, 0] * b[:, 0, 1] - a[:, 0, 1] * b[:, 0, 0])
        return Triples(gram, area, area / np.sqrt(gram[:, :, 0].max(axis=1)))

    def broad(self) -> "Triples":
        """Those that are not slender."""
        keep = self.height >= SLENDER_STEPS
        return Triples(self.gram[keep], self.area[keep], self.height[keep])


def resemblance(one: Triples, other: Triples) -> np.ndarray:
    """(T1, 6, T2): how far each triple is from another in each order of its corners; below 1 an image may confuse them.

    The larger of log stretch and log scale of the affine map between them, over their limits.
    """
    inverse = np.stack([other.gram[:, 0, 2], -2 * other.gram[:, 0, 1], other.gram[:, 0, 0]]) / other.area**2
    scale2 = one.area[:, None, None] / other.area
    cosh = (one.gram @ inverse) / (2 * scale2)
    return np.maximum(np.arccosh(np.maximum(cosh, 1.0)) / np.log(STRETCH), np.abs(np.log(scale2)) / (2 * np.log(SCALE)))


def in_steps(xy_mm: np.ndarray) -> np.ndarray:
    """Points of a plate (N, 2) in steps: the median distance of a point from its nearest neighbour."""
    nearest, _ = KDTree(xy_mm).query(xy_mm, k=2)
    return (xy_mm - xy_mm.mean(axis=0)) / np.median(nearest[:, 1])


def nearest_likeness(points: np.ndarray, others: Sequence[np.ndarray] = ()) -> np.ndarray:
    """(T,): for each triple of a pattern that is not slender, its least `resemblance` to a triple of other patterns.

    Without `others`: to the triples of its own pattern, and to itself turned or mirrored.
    """
    mine = Triples.of(points).broad()
    if others:
        far = [resemblance(mine, Triples.of(other).broad()).min(axis=(1, 2), initial=np.inf) for other in others]
        return np.min(far, axis=0)
    return _own(mine).min(axis=(1, 2), initial=np.inf)


def _own(mine: Triples) -> np.ndarray:
    far = resemblance(mine, mine)
    far[np.arange(len(far)), 0, np.arange(len(far))] = np.inf
    return far


def hidden_blocks(points: np.ndarray) -> np.ndarray:
    """(B, N) bool: the balls that blocks of HIDDEN of a plate hide: from each side, round or square about each ball."""
    count = int(HIDDEN * len(points))
    turns = np.arange(0, 2 * np.pi, np.pi / 18)
    orders = [points @ (np.cos(turn), np.sin(turn)) for turn in turns]
    orders += [np.linalg.norm(points - centre, ord=norm, axis=1) for centre in points for norm in (2, np.inf)]
    hidden = np.zeros((len(orders), len(points)), dtype=bool)
    for row, order in zip(hidden, orders, strict=True):
        row[np.argsort(order, kind="stable")[:count]] = True
    return hidden


def search(grids: Sequence[np.ndarray], count: int, rng: np.random.Generator, moves: int = MOVES) -> list[np.ndarray]:
    """For each grid (N, 2) the indices of `count` datums: few triples resemble each other, none is congruent.

    Annealing: one datum moves at a time; a pattern of which a hidden block leaves fewer than three is never tried.
    Raises FrameError where there is no such pattern.
    """
    left = [~hidden_blocks(points) for points in grids]
    chosen = [_start(points, left[plate], count, rng) for plate, points in enumerate(grids)]
    triples = [Triples.of(points[mine]) for points, mine in zip(grids, chosen, strict=True)]
    best, energy, least = list(chosen), 0.0, 0.0
    for heat in 3.0 * (1 - np.arange(moves) / moves) ** 2 + 0.02:
        plate = int(rng.integers(len(grids)))
        moved = _moved(chosen[plate], len(grids[plate]), rng)
        if not _lasts(grids[plate][moved], left[plate][:, moved]):
            continue
        others = [one for other, one in enumerate(triples) if other != plate]
        tried = Triples.of(grids[plate][moved])
        change = _energy(tried, others) - _energy(triples[plate], others)
        if change > 0 and rng.random() >= np.exp(-change / heat):
            continue
        chosen[plate], triples[plate] = moved, tried
        energy += change
        if energy < least - 1e-9:
            best, least = list(chosen), energy
    return [np.sort(mine) for mine in best]


def _start(points: np.ndarray, left: np.ndarray, count: int, rng: np.random.Generator) -> np.ndarray:
    for _ in range(2000):
        chosen = rng.choice(len(points), min(count, len(points)), replace=False)
        if _lasts(points[chosen], left[:, chosen]):
            return chosen
    raise FrameError(f"no {count} datums of a plate were found of which three always remain; ask for 6")


def _moved(chosen: np.ndarray, places: int, rng: np.random.Generator) -> np.ndarray:
    free = np.setdiff1d(np.arange(places), chosen)
    out = chosen.copy()
    out[rng.integers(len(out))] = rng.choice(free)
    return out


def _lasts(points: np.ndarray, left: np.ndarray) -> bool:
    """No three datums on a line, and three left by every hidden block."""
    return bool(left.sum(axis=1).min() >= 3 and Triples.of(points).area.min() > 0)


def _energy(mine: Triples, others: Sequence[Triples]) -> float:
    """What the triples of one plate add to the number of lookalikes; congruent ones weigh most, slender ones least."""
    own = _own(mine)
    pairs = np.concatenate([resemblance(mine, other).ravel() for other in others])
    near, own_near = pairs[pairs < 1], own[own < 1]
    slender = (mine.height < SLENDER_STEPS).sum()
    return float(_weight(near) + _weight(own_near) / 2 + 0.2 * slender)


def _weight(near: np.ndarray) -> float:
    return float((2.0 - 1.5 * near + 8.0 * (near < _CONGRUENT)).sum())
