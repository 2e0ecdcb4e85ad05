"""The shape of a solid: which balls cast shadows of their own, where it may stand, and its symmetries.

A symmetry is a rotation, with or without a reflection, that carries the balls onto each other.
"""

import numpy as np
from scipy.spatial import KDTree
from scipy.spatial.distance import cdist
from scipy.spatial.transform import Rotation

from sightline.common.geometry.rigid import fibonacci_sphere, rigid_fit
from sightline.frame.plate import SOURCE_TO_HIP_MM, RigidBody

# Fields at the hip by the detector: 9 inches and 300 mm, 1000 mm from the source, seen at 620 mm, rounded down [calc].
FIELDS_MM = {"9-inch intensifier": 140.0, "30 cm panel": 185.0}
SHADOW_GAP_MM = 1.0  # [ours] minimum distance between two shadows for both to be measured: more than their blur
_DIRECTIONS = 400  # [ours] of a Fibonacci lattice, 10° apart
SAME_TURN = np.cos(np.radians(3))  # [ours] of two symmetries that count as one: others are many degrees apart
AXES = "xyz"
AXIS_TOLERANCE = 0.02  # of a unit vector's components: an axis within 1° of x, y or z is named so [ours]


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
    return clear_of_each_other(solid.xyz_mm, solid.diameter_mm / 2, fibonacci_sphere(_DIRECTIONS))


def offset_mm(solid: RigidBody, field_mm: float) -> float:
    """Return how far from a beam's axis, mm at the hip, the solid's middle may stand with all its balls in the field.

    However the solid is turned, and with the magnification of balls nearer to the source; negative where it is too
    large for the field.
    """
    half = field_mm / 2
    return half - radius_mm(solid) * float(np.hypot(1.0, half / SOURCE_TO_HIP_MM))


def radius_mm(solid: RigidBody) -> float:
    """Return the radius of the sphere about the middle of the balls' box that contains all balls, mm."""
    middle = (solid.xyz_mm.min(axis=0) + solid.xyz_mm.max(axis=0)) / 2
    return float((np.linalg.norm(solid.xyz_mm - middle, axis=1) + solid.diameter_mm / 2).max())


def symmetry_of(xyz_mm: np.ndarray, diameter_mm: np.ndarray, tolerance_mm: float) -> tuple[np.ndarray, ...]:
    """Return the orthogonal matrices (3, 3) that carry a cloud of balls onto itself, without the identity.

    Each takes every ball of `xyz_mm` (M, 3) to within the tolerance of one with the same diameter (M,), about the
    balls' centroid; those with a negative determinant reflect. Balls in one plane are reflected to themselves. Where
    infinitely many do, some are returned.

    >>> [in_words(one) for one in symmetry_of(np.diag([20.0, 30.0, 40.0]), np.full(3, 3.0), 0.5)]
    ['reflected in the plane perpendicular to (0.77, 0.51, 0.38)']
    """
    centred = xyz_mm - xyz_mm.mean(axis=0)
    classes = np.unique(np.round(diameter_mm, 2), return_inverse=True)[1]
    symmetries: list[np.ndarray] = []
    for matrix in _candidates(centred, classes, tolerance_mm):
        better = _improved(matrix, centred, classes, tolerance_mm)
        if better is not None and not any(
            (better * known).sum() > 1 + 2 * SAME_TURN for known in [np.eye(3), *symmetries]
        ):
            symmetries.append(better)
    return tuple(symmetries)


def _candidates(centred: np.ndarray, classes: np.ndarray, tolerance_mm: float) -> list[np.ndarray]:
    """Return the orthogonal matrices that take two balls of the cloud to two others."""
    slack = 2 * tolerance_mm
    radius, apart = np.linalg.norm(centred, axis=1), cdist(centred, centred)
    like = (np.abs(radius[:, None] - radius) < slack) & (classes[:, None] == classes)
    # The two balls that fewest others resemble, and that span a plane with the centroid.
    span = np.linalg.norm(np.cross(centred[:, None], centred), axis=2)
    broad = span > 0.3 * span.max() if span.max() > slack**2 else np.ones_like(span, dtype=bool)
    cost = np.where(broad, like.sum(axis=1)[:, None] * like.sum(axis=1), np.inf)
    np.fill_diagonal(cost, np.inf)
    a, b = np.unravel_index(cost.argmin(), cost.shape)
    pairs = [
        (i, j)
        for i in np.flatnonzero(like[a])
        for j in np.flatnonzero(like[b])
        if i != j and abs(apart[i, j] - apart[a, b]) < 2 * slack
    ]
    base = _axes(centred[a], centred[b])
    flip = np.diag([1.0, 1.0, -1.0])
    return [_axes(centred[i], centred[j]) @ side @ base.T for i, j in pairs for side in (np.eye(3), flip)]


def _axes(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return right-handed axes (3, 3), as columns: along a vector, towards a second one, and across both."""
    whole = np.stack([first, second, np.cross(first, second)], axis=1)
    q, r = np.linalg.qr(whole)
    return q * np.where(np.diag(r) < 0, -1.0, 1.0)


def _improved(matrix: np.ndarray, centred: np.ndarray, classes: np.ndarray, tolerance_mm: float) -> np.ndarray | None:
    """Return the least-squares orthogonal matrix near `matrix`, or None if it does not carry the cloud onto itself."""
    for reach in (4 * tolerance_mm, tolerance_mm):
        distance, nearest = KDTree(np.column_stack([centred, 1e6 * classes])).query(
            np.column_stack([centred @ matrix.T, 1e6 * classes])
        )
        if distance.max() > reach or len(np.unique(nearest)) < len(centred):
            return None
        sign = np.sign(np.linalg.det(matrix))
        matrix = sign * rigid_fit(sign * centred, centred[nearest]).rotation.as_matrix()
    return matrix


def in_words(matrix: np.ndarray) -> str:
    """Return an orthogonal matrix (3, 3) in words.

    >>> in_words(np.diag([-1.0, -1.0, 1.0])), in_words(np.diag([1.0, -1.0, 1.0]))
    ('rotated by 180° about z', 'reflected in the plane perpendicular to y')
    """
    if np.linalg.det(matrix) > 0:
        return _rotation_in_words(matrix)
    vector = Rotation.from_matrix(-matrix).as_rotvec()  # half a turn and the angle of the rotation
    angle = np.linalg.norm(vector)
    if np.degrees(angle) < 1:
        return "reflected through its middle"
    if np.degrees(angle) > 179:
        return f"reflected in the plane perpendicular to {_axis_in_words(vector)}"
    turn = Rotation.from_rotvec(vector * (1 - np.pi / angle)).as_matrix()
    return f"{_rotation_in_words(turn)} and reflected along this axis"


def _rotation_in_words(matrix: np.ndarray) -> str:
    vector = Rotation.from_matrix(matrix).as_rotvec()
    return f"rotated by {np.degrees(np.linalg.norm(vector)):.0f}° about {_axis_in_words(vector)}"


def _axis_in_words(vector: np.ndarray) -> str:
    """Return "x", "y", "z", or the unit vector, with its largest component positive."""
    unit = vector / np.linalg.norm(vector)
    largest = int(np.abs(unit).argmax())
    unit = unit * np.sign(unit[largest])
    if np.abs(np.delete(unit, largest)).max() < AXIS_TOLERANCE:
        return AXES[largest]
    return "(" + ", ".join(f"{value:.2f}" for value in unit + 0.0) + ")"
