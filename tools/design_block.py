"""Search for the ball places of a built-in block: `python tools/design_block.py block60` prints its two tables.

Ball centres lie DEPTH_MM under a face, on whole millimetres along it. Of random places those are kept that leave most
balls clear of each other in parallel projection, on average and in the worst directions; then single balls are moved.
A search takes one minute for 16 balls, ten for 32.
"""

import sys
from dataclasses import dataclass

import numpy as np

from sightline.frame.designs import LARGE_MM, SMALL_MM
from sightline.frame.solid_shape import clear_of_each_other

DEPTH_MM = 3.5  # of a ball's centre under its face: 1 mm of PMMA over the larger balls
GAP_MM = 6.0  # minimum distance between the surfaces of two balls
DIRECTIONS = 400
STARTS, MOVES = 6000, 15000
STEP_MM = 6.0  # s.d. of a move


@dataclass(frozen=True)
class Design:
    """A block of `size_mm` with `balls`, `large` of them of the larger diameter, `margin_mm` from the edges.

    `square`: share of the directions that are within some 8° of its edges: of a block that stands square to the beams.
    """

    size_mm: tuple[float, float, float]
    balls: int
    large: int
    margin_mm: float
    seed: int
    square: float = 0.0


DESIGNS = {
    "block30": Design((30.0, 30.0, 50.0), balls=12, large=4, margin_mm=6.0, seed=30),
    "block40": Design((40.0, 40.0, 40.0), balls=14, large=4, margin_mm=6.0, seed=40, square=0.6),
    "block60": Design((60.0, 60.0, 60.0), balls=16, large=5, margin_mm=6.0, seed=60),
    # 10 mm from the edges keep all balls within a 30 cm panel's field at the hip, however the cube is turned.
    "cube120": Design((120.0, 120.0, 120.0), balls=32, large=10, margin_mm=10.0, seed=120),
}


class Search:
    """The search for one design; `places` (N, 3) is the best found so far, mm, larger balls first."""

    def __init__(self, design: Design) -> None:
        self.design = design
        self.rng = np.random.default_rng(design.seed)
        self.half = np.array(design.size_mm) / 2
        self.span = self.half - design.margin_mm
        directions = self.rng.standard_normal((DIRECTIONS, 3))
        for k in range(round(design.square * DIRECTIONS)):
            directions[k] = np.eye(3)[k % 3] + 0.1 * directions[k]
        self.directions = directions / np.linalg.norm(directions, axis=1)[:, None]
        self.radius = np.full(design.balls, SMALL_MM / 2)
        self.radius[: design.large] = LARGE_MM / 2
        self.places, self.score = np.empty((0, 3)), -np.inf

    def run(self) -> None:
        """Try random places, then move single balls of the best."""
        for _ in range(STARTS):
            self._keep(self._random())
        for _ in range(MOVES):
            self._keep(self._moved())

    def _keep(self, places: np.ndarray) -> None:
        if (score := self._score(places)) > self.score:
            self.places, self.score = places, score

    def _score(self, places: np.ndarray) -> float:
        i, j = np.triu_indices(len(places), 1)
        apart = np.linalg.norm(places[i] - places[j], axis=1)
        if (apart < self.radius[i] + self.radius[j] + GAP_MM).any():
            return -1.0
        clear = clear_of_each_other(places, self.radius, self.directions)
        return float(clear.mean() + 0.3 * np.quantile(clear, 0.02))

    def _random(self) -> np.ndarray:
        face = np.arange(self.design.balls) % 6
        self.rng.shuffle(face)
        out = np.empty((len(face), 3))
        for place, f in zip(out, face, strict=True):
            axis = f // 2
            place[axis] = (1 if f % 2 else -1) * (self.half[axis] - DEPTH_MM)
            for along in np.delete(np.arange(3), axis):
                place[along] = np.round(self.rng.uniform(-self.span[along], self.span[along]))
        return out

    def _moved(self) -> np.ndarray:
        out = self.places.copy()
        place = out[self.rng.integers(len(out))]
        for along in np.flatnonzero(np.abs(place) != self.half - DEPTH_MM):
            moved = np.round(place[along] + self.rng.normal(0, STEP_MM))
            place[along] = np.clip(moved, -self.span[along], self.span[along])
        return out


def main(name: str) -> None:
    """Print the tables of a built-in block."""
    search = Search(DESIGNS[name])
    search.run()
    for diameter in (LARGE_MM, SMALL_MM):
        print(f"{diameter:g} mm:", *(tuple(p.tolist()) for p in search.places[2 * search.radius == diameter]), sep="\n")
    print(f"score {search.score:.3f}")


if __name__ == "__main__":
    main(sys.argv[1])
