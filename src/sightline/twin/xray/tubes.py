"""Image intensifiers drawn from their distributions, with second moments; and the magnetic field around them.

The field is that of a place, of steel nearby, behind a shield: CFCS, µT. The patient lies supine, so +Z is up; the
table's heading rotates the frame's X axis from north.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import TypeAlias

import numpy as np

from sightline.common.geometry.covariance import factor_of
from sightline.common.names import named
from sightline.errors import SetUpError
from sightline.twin.xray.distributions import Distortion
from sightline.twin.xray.intensifier import DistortionMap, DistortionPrior, Intensifier, RandomField, disc_mm, monomials
from sightline.twin.xray.presets import ImageChain

# The geomagnetic field (3,), µT, CFCS, with a stray field to be drawn; or a field and its gradient, of `field_at`.
Magnet: TypeAlias = np.ndarray | tuple[np.ndarray, np.ndarray]
PINCUSHION_RADIUS_MM = 107.0  # the radius of Distortion.pincushion_at_107_mm
# East, north, up, µT [calc, IGRF; the first as physics.md has it, the others at 2025.0]
PLACES = {
    "loughborough": (-1.3, 18.6, -44.9),
    "tromso": (2.0, 10.6, -52.7),
    "boston": (-5.0, 20.0, -47.0),
    "quito": (-2.2, 26.5, -9.7),
    "singapore": (0.1, 41.0, 9.4),
    "sao-paulo": (-6.5, 16.1, 14.8),
    "sydney": (5.4, 24.0, 51.4),
}


def draw_tube(rng: np.random.Generator, chain: ImageChain, spread: Distortion) -> "Tube | FlatPanel":
    """Draw the parts of an intensifier that are the same in all its exposures; a flat panel has none."""
    if chain.tube_mm is None:
        return FlatPanel(chain)
    low, high = np.log(spread.turn_rad_per_ut)
    return Tube(
        chain=chain,
        radius_mm=chain.tube_mm / 2,
        spread=spread,
        k1=rng.uniform(*spread.pincushion_at_107_mm) / PINCUSHION_RADIUS_MM**2,
        turn_rad_per_ut=float(np.exp(rng.uniform(low, high))),
        cubic_mm=spread.asymmetric_mm / np.sqrt(14) * rng.standard_normal((7, 2)),
    )


@dataclass(frozen=True, eq=False)
class Tube:
    """An image intensifier before an exposure: its pincushion, its response to magnetic fields, its asymmetry."""

    chain: ImageChain
    radius_mm: float
    spread: Distortion
    k1: float
    turn_rad_per_ut: float
    cubic_mm: np.ndarray

    def expose(self, rng: np.random.Generator, axes: np.ndarray, magnet: Magnet) -> Intensifier:
        """Draw the intensifier in one exposure.

        `axes` (3, 3): rows are its x, y and z (away from the source) in CFCS. In a known field its prior is that of an
        unknown one.
        """
        spread, radius = self.spread, self.radius_mm
        if isinstance(magnet, tuple):
            magnetic = tube_numbers(axes, *magnet, radius)
        else:
            magnetic = magnetic_numbers(
                axes @ (magnet + spread.stray_ut * rng.standard_normal(3)),
                spread.gradient_ut_per_mm * radius * (_gradient_basis() @ rng.standard_normal(9)).reshape(3, 3),
            )
        correlation = float(rng.uniform(*spread.correlation_mm))
        field = RandomField.over(radius, correlation)
        share = share_beyond_degree5(radius, correlation, spread.correlation_mm)
        sd = float(rng.uniform(*spread.beyond_degree5_mm)) / (np.sqrt(2) * share)
        drawn = DistortionMap(
            radius_mm=radius,
            k1=self.k1,
            turn=self.turn_rad_per_ut * magnetic[:3],
            shift_mm=spread.shift_mm_per_ut * magnetic[3:].reshape(2, 3),
            cubic_mm=self.cubic_mm,
            field=field,
            random_mm=sd * rng.standard_normal((len(field), 2)),
        )
        return Intensifier(self.chain, drawn, DistortionPrior(_smooth_factor(spread, radius, axes), sd))


@dataclass(frozen=True)
class FlatPanel:
    """A detector without distortion."""

    chain: ImageChain

    def expose(self, rng: np.random.Generator, axes: np.ndarray, magnet: Magnet) -> Intensifier:
        """Return the panel, which is the same in every exposure."""
        return self.undistorted

    @property
    def undistorted(self) -> Intensifier:
        """The panel as an intensifier without distortion."""
        radius = self.chain.field_mm / 2
        field = RandomField.over(radius, radius)
        none = DistortionMap(
            radius, 0.0, np.zeros(3), np.zeros((2, 3)), np.zeros((7, 2)), field, np.zeros((len(field), 2))
        )
        return Intensifier(self.chain, none, DistortionPrior(np.zeros((24, 24)), 0.0))


def draw_earth(rng: np.random.Generator, spread: Distortion) -> np.ndarray:
    """Draw the geomagnetic field (3,), µT, CFCS, for a supine patient (+Z up) and a random heading of the table."""
    heading = rng.uniform(0, 2 * np.pi)
    horizontal, up = spread.earth_ut
    return np.array([horizontal * np.cos(heading), horizontal * np.sin(heading), up])


@lru_cache(maxsize=8)
def _shares(radius_mm: float, range_mm: tuple[float, float]) -> tuple[np.ndarray, np.ndarray]:
    """Return correlation lengths, and for each the expected rms over the field that a unit-variance random field leaves
    after a polynomial fit of degree 5."""
    points = disc_mm(radius_mm)
    q = np.linalg.qr(monomials(points / radius_mm, 5))[0]
    lengths = np.linspace(*range_mm, 13)
    values = (RandomField.over(radius_mm, length).values(points) for length in lengths)
    shares = [np.sqrt(((v - q @ (q.T @ v)) ** 2).sum() / len(points)) for v in values]
    return lengths, np.array(shares)


def share_beyond_degree5(radius_mm: float, correlation_mm: float, range_mm: tuple[float, float]) -> float:
    """Return the expected rms over the field that a unit-variance random field leaves after a fit of degree 5,
    interpolated with an error of up to 1 %."""
    lengths, shares = _shares(radius_mm, range_mm)
    return float(np.exp(np.interp(correlation_mm, lengths, np.log(shares))))


@lru_cache(maxsize=1)
def _gradient_basis() -> np.ndarray:
    """Return the matrix (9, 9) from nine unit-variance numbers to a flattened symmetric, traceless 3x3 tensor (no
    currents, no monopoles in the tube) with off-diagonal elements of unit variance."""
    basis = np.zeros((9, 9))
    for k in range(9):
        a = np.zeros(9)
        a[k] = 1.0
        tensor = (a.reshape(3, 3) + a.reshape(3, 3).T) / np.sqrt(2)
        basis[:, k] = (tensor - np.trace(tensor) / 3 * np.eye(3)).ravel()
    return basis


def _smooth_factor(spread: Distortion, radius_mm: float, axes: np.ndarray) -> np.ndarray:
    """Return a factor (24, 24) of the covariance of k1, turn, shift and cubic weights for a tube with these axes."""
    horizontal, up = spread.earth_ut
    mean = magnetic_numbers(axes @ np.array([0.0, 0.0, up]), np.zeros((3, 3)))
    field_ut2 = np.diag([horizontal**2 / 2, horizontal**2 / 2, 0.0]) + spread.stray_ut**2 * np.eye(3)
    basis = _gradient_basis() * spread.gradient_ut_per_mm * radius_mm
    responses = np.stack(
        [magnetic_numbers(column, np.zeros((3, 3))) for column in (axes @ np.sqrt(field_ut2)).T]
        + [magnetic_numbers(np.zeros(3), column.reshape(3, 3)) for column in basis.T],
        axis=-1,
    )
    covariance = responses @ responses.T
    low, high = spread.turn_rad_per_ut
    first = (high - low) / np.log(high / low)  # E[g], E[g²] of a log-uniform g
    second = (high**2 - low**2) / 2 / np.log(high / low)
    scale = np.array([first] * 3 + [spread.shift_mm_per_ut] * 6)
    magnetic = scale[:, None] * covariance * scale
    square = covariance[:3, :3] + np.outer(mean[:3], mean[:3])
    magnetic[:3, :3] = second * square - first**2 * np.outer(mean[:3], mean[:3])
    low, high = spread.pincushion_at_107_mm
    factor = np.zeros((24, 24))
    factor[0, 0] = (high - low) / np.sqrt(12) / PINCUSHION_RADIUS_MM**2
    factor[1:10, 1:10] = factor_of(magnetic)
    factor[10:, 10:] = spread.asymmetric_mm / np.sqrt(14) * np.eye(14)
    return factor


@dataclass(frozen=True)
class Steel:
    """A lump of iron, modelled as a ball magnetised by the geomagnetic field: its centre in CFCS and its radius, mm.

    The field of a ball of high permeability is B = (a/r)³ (3 (B0 · r) r - B0), with r a unit vector [src Jackson,
    Classical Electrodynamics, 5.11].
    """

    at_mm: tuple[float, float, float]
    radius_mm: float


@dataclass(frozen=True)
class Site:
    """The place of a C-arm. `heading`: rad, of the frame's +X axis, from north over east.

    `shield`: share of the field that passes a shield around the whole tube. 1: no such shield; the tube's own shield at
    its sides is part of `Distortion`.
    """

    place: str = "loughborough"
    heading: float = 0.0
    shield: float = 1.0
    steel: tuple[Steel, ...] = ()


def earth_ut(place: str, heading: float) -> np.ndarray:
    """Return the geomagnetic field (3,), CFCS, µT. Raises UnusableInputError, which lists the valid places."""
    east, north, up = named(place, PLACES, "place")
    c, s = np.cos(heading), np.sin(heading)
    return np.array([north * c + east * s, north * s - east * c, up])


def field_at(site: Site, at_mm: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the field (3,), µT, at a point (3,), CFCS, and its gradient (3, 3), µT/mm, of component i along j.

    Raises SetUpError for a shield outside 0 to 1, and for a point inside the steel.
    """
    if not 0 <= site.shield <= 1:
        raise SetUpError(f"the shield passes a share of {site.shield:g} of the field; give 0 to 1")
    earth = earth_ut(site.place, site.heading)
    field, gradient = earth.copy(), np.zeros((3, 3))
    for lump in site.steel:
        offset = np.asarray(at_mm, dtype=np.float64) - lump.at_mm
        distance = float(np.linalg.norm(offset))
        if not 0 < lump.radius_mm < distance:
            raise SetUpError("steel must have a radius above zero, and the intensifier must be outside it")
        r, strength = offset / distance, (lump.radius_mm / distance) ** 3
        along = float(earth @ r)
        field += strength * (3 * along * r - earth)
        both = np.outer(earth, r) + np.outer(r, earth) + along * np.eye(3) - 5 * along * np.outer(r, r)
        gradient += 3 * strength / distance * both
    return site.shield * field, site.shield * gradient


def tube_numbers(
    axes: np.ndarray, field_ut: np.ndarray, gradient_ut_per_mm: np.ndarray, radius_mm: float
) -> np.ndarray:
    """Return nine values, µT, that rotate and shift the image of a tube with x, y, z (away from the source) as rows of
    `axes`.

    The first three rotate it: the axial field and its change over one radius along x and y. The others shift it: the
    same of z x B, x then y.
    """
    return magnetic_numbers(axes @ field_ut, axes @ (gradient_ut_per_mm * radius_mm) @ axes.T)


def magnetic_numbers(field_ut: np.ndarray, change_ut: np.ndarray) -> np.ndarray:
    """Return the values (9,) of `tube_numbers` for a field (3,) in the tube's axes, µT.

    `change_ut` (3, 3): change of component i over one radius along axis j.
    """
    each = np.concatenate([field_ut[:, None], change_ut[:, :2]], axis=1)
    return np.concatenate([each[2], -each[1], each[0]])
