"""Checks of a solid's design, and where it may stand beside the target."""

import numpy as np

from sightline.frame import nominal
from sightline.frame.model import Frame
from sightline.frame.plate import RigidBody
from sightline.frame.rules import Rule, Values
from sightline.frame.symmetry import in_words, symmetry_of

# Fields at the hip by the detector: 9 inches and 300 mm, 1000 mm from the source, seen at 620 mm, rounded down [calc].
FIELDS_MM = {"9-inch intensifier": 140.0, "30 cm panel": 185.0}
SHADOW_GAP_MM = 1.0  # [ours] minimum distance between two shadows for both to be measured
_DIRECTIONS = 400  # [ours] of a Fibonacci lattice, 10° apart
SYMMETRY_MM = 1.0  # [ours] five times the error of a printed ball: nearer to a symmetry, labels may be exchanged
_RARE = 0.02  # [ours] share of the directions in which an image may be refused


def clear_of_each_other(xyz_mm: np.ndarray, radius_mm: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Return (D,): how many of N balls (N, 3) cast a shadow of their own along each unit vector (D, 3)."""
    i, j = np.triu_indices(len(xyz_mm), 1)
    apart = xyz_mm[i] - xyz_mm[j]
    across = np.sqrt(np.maximum((apart**2).sum(axis=1)[:, None] - (apart @ directions.T) ** 2, 0))
    near = across < (radius_mm[i] + radius_mm[j])[:, None] + SHADOW_GAP_MM
    hidden = np.zeros((len(xyz_mm), len(directions)), dtype=bool)
    for pair, which in enumerate(near):
        hidden[i[pair]] |= which
        hidden[j[pair]] |= which
    return (~hidden).sum(axis=0)


def clear_beads(solid: RigidBody) -> np.ndarray:
    """Return (400,): how many balls are clear of each other, from directions spread over the sphere."""
    k = np.arange(_DIRECTIONS) + 0.5
    height, angle = 1 - 2 * k / _DIRECTIONS, np.pi * (1 + np.sqrt(5)) * k
    level = np.sqrt(1 - height**2)
    directions = np.stack([level * np.cos(angle), level * np.sin(angle), height], axis=1)
    return clear_of_each_other(solid.xyz_mm, solid.diameter_mm / 2, directions)


def offset_mm(solid: RigidBody, field_mm: float) -> float:
    """Return how far from a beam's axis, mm at the hip, the solid's middle may stand with all its balls in the field.

    However the solid is turned, and with the magnification of balls nearer to the source; negative where it is too
    large for the field.
    """
    half = field_mm / 2
    return half - radius_mm(solid) * float(np.hypot(1.0, half / nominal.SOURCE_TO_HIP_MM))


def radius_mm(solid: RigidBody) -> float:
    """Return the radius of the sphere about the middle of the balls' box that contains all balls, mm."""
    middle = (solid.xyz_mm.min(axis=0) + solid.xyz_mm.max(axis=0)) / 2
    return float((np.linalg.norm(solid.xyz_mm - middle, axis=1) + solid.diameter_mm / 2).max())


def _beads(frame: Frame) -> Values:
    if frame.solid is not None:
        yield frame.name, len(frame.solid.ids)


def _extent(frame: Frame) -> Values:
    """Yield the rms distance of the balls from their best-fitting plane; that from a line is never smaller."""
    if frame.solid is not None:
        centred = frame.solid.xyz_mm - frame.solid.xyz_mm.mean(axis=0)
        yield frame.name, float(np.linalg.svd(centred, compute_uv=False)[2] / np.sqrt(len(centred)))


def _clear_mean(frame: Frame) -> Values:
    if frame.solid is not None:
        yield frame.name, float(clear_beads(frame.solid).mean())


def _clear_worst(frame: Frame) -> Values:
    if frame.solid is not None:
        yield frame.name, float(np.quantile(clear_beads(frame.solid), _RARE, method="lower"))


def _symmetries(frame: Frame) -> Values:
    """Yield the number of symmetries, with one of them: a rotation where there is one."""
    if frame.solid is not None:
        found = symmetry_of(frame.solid.xyz_mm, frame.solid.diameter_mm, SYMMETRY_MM)
        named = f", {in_words(max(found, key=np.linalg.det))}" if found else ""
        yield frame.name + named, len(found)


def _field(frame: Frame) -> Values:
    """Yield the `offset_mm` in the largest field."""
    if frame.solid is not None:
        name, field = max(FIELDS_MM.items(), key=lambda entry: entry[1])
        yield name, offset_mm(frame.solid, field)


SOLID_BEADS = (
    Rule(
        "solid-beads", _beads, at_least=True, limit=9, unit="beads",  # [ours] what labelling needs with 1e-6 of error
        meaning="there are enough beads to label an image by their geometry",
        advice="there are too few beads to label an image reliably; add beads",
    ),
    Rule(
        "solid-extent", _extent, at_least=True, limit=5.0, unit="mm",  # [ours] half of what a block of 30 mm has
        meaning="the beads spread in three directions (rms from their best-fitting plane)",
        advice="the beads lie in or near a plane, which leaves the focal length unknown; add beads away from it",
    ),
)  # fmt: skip
SOLID_VIEWS = (
    Rule(
        "solid-clear", _clear_mean, at_least=True, limit=9.0, unit="beads",  # as solid-beads
        meaning="from a random direction this many beads are clear of each other on average",
        advice="from most directions too few beads are clear of each other; move beads apart or add some",
    ),
    Rule(
        "solid-worst", _clear_worst, at_least=True, limit=6.0, unit="beads",  # 12 equations, 11 unknowns
        meaning="from all but 2 % of the directions at least this many beads are clear of each other",
        advice="from over 2 % of the directions too few beads are clear of each other; move beads out of rows",
    ),
    Rule(
        "solid-symmetry", _symmetries, at_least=False, limit=0, unit="symmetries",
        meaning="no rotation or mirror image can be confused with the solid",
        advice="the solid looks the same, so its balls cannot be labelled; move balls, or give some another size",
    ),
    Rule(
        "solid-field", _field, at_least=True, limit=0.0, unit="mm",
        meaning="at the hip the solid's middle may stand this far from the beam's axis with all beads in the image",
        advice="at the hip beads are cut off from the image; make the solid smaller",
    ),
)  # fmt: skip
