"""The magnetic field at the intensifier: the geomagnetic field of a place, steel nearby, a shield. CFCS, µT.

The patient lies supine, so +Z is up; the table's heading rotates the frame's X axis from north.
"""

from dataclasses import dataclass

import numpy as np

from sightline.errors import SetUpError, UnusableInputError

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


@dataclass(frozen=True)
class Steel:
    """A lump of iron, modelled as a ball magnetised by the geomagnetic field: its centre in CFCS and its radius, mm.

    The field of a ball of high permeability is B = (a/r)³ (3 (B0 · r) r - B0), with r a unit vector [mem].
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
    if place not in PLACES:
        raise UnusableInputError(f"there is no place {place!r}; there are: {', '.join(PLACES)}")
    east, north, up = PLACES[place]
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
