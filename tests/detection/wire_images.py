"""Images of a steel wire with known truth: chords of a cylinder with a conical point, Poisson counts, blur."""

from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np
from tests.detection.bead_images import radiograph

from sightline.imaging import Radiograph

SIZE = 512
PX_PER_MM = 7.0
_PER_MM, _SHARE = np.array([3.03, 1.60, 1.01]), np.array([0.22, 0.39, 0.39])


@dataclass(frozen=True)
class Drawn:
    """A wire perpendicular to the rays: its tip, px, and the direction to which it points, radians.

    `widening_per_mm`: relative growth of its scale behind the tip, as of a wire that runs towards the detector.
    """

    tip_px: tuple[float, float]
    turn_rad: float
    diameter_mm: float = 2.5
    point_mm: float = 3.75
    widening_per_mm: float = 0.0

    @property
    def along(self) -> np.ndarray:
        """Unit vector (2,) towards the tip."""
        return np.array([np.cos(self.turn_rad), np.sin(self.turn_rad)])


@dataclass(frozen=True, eq=False)
class Expected:
    """See `ProjectedWire`."""

    uv_px: np.ndarray
    along_mm: np.ndarray
    px_per_mm: np.ndarray
    sine: np.ndarray
    beads_px: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))


def expected(wire: Drawn, aside_mm: float = 0.0, turned_rad: float = 0.0, length_mm: float = 52.0) -> Expected:
    """Return the planned wire: displaced and rotated against the true one, 15 mm longer."""
    along_mm = np.arange(-length_mm, 15.0)
    angle = wire.turn_rad + turned_rad
    way, across = np.array([np.cos(angle), np.sin(angle)]), np.array([-np.sin(angle), np.cos(angle)])
    middle = np.array(wire.tip_px) - 0.5 * length_mm * PX_PER_MM * wire.along + aside_mm * PX_PER_MM * across
    uv = middle + (along_mm[:, None] + 0.5 * length_mm) * PX_PER_MM * way
    flat = np.ones(len(along_mm))
    return Expected(uv, along_mm, PX_PER_MM * (flat - wire.widening_per_mm * along_mm), flat)


@lru_cache(maxsize=8)
def steel(wires: tuple[Drawn, ...], over: int = 2) -> np.ndarray:
    """Return the transmission (SIZE, SIZE) of the primary radiation."""
    fine = (np.arange(SIZE * over) + 0.5) / over - 0.5
    left = np.ones((SIZE * over, SIZE * over))
    for wire in wires:
        u, v = (fine[None, :] - wire.tip_px[0]) / PX_PER_MM, (fine[:, None] - wire.tip_px[1]) / PX_PER_MM
        behind, across = -(u * wire.along[0] + v * wire.along[1]), v * wire.along[0] - u * wire.along[1]
        across /= 1 + wire.widening_per_mm * behind
        radius = wire.diameter_mm / 2 * (np.clip(behind / wire.point_mm, 0, 1) if wire.point_mm else behind > 0)
        chord = 2 * np.sqrt(np.clip(radius**2 - across**2, 0, None))
        left *= np.tensordot(_SHARE, np.exp(-_PER_MM[:, None, None] * chord), 1)
    return left.reshape(SIZE, over, SIZE, over).mean(axis=(1, 3))


def image_of(
    wires: list[Drawn],
    rng: np.random.Generator,
    quanta: float = 150.0,
    background: float | np.ndarray = 1.0,
    metal: float | np.ndarray = 1.0,
) -> Radiograph:
    """A radiograph of wires before a background, its light (SIZE, SIZE) relative to 1, with 40 % of scatter.

    `metal`: share of the straight light that other metal lets through; scatter is not stopped by it."""
    return radiograph(quanta * background * (steel(tuple(wires)) * metal + 0.4), rng)
