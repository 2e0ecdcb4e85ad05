"""Directions; intersections and closest approaches of lines."""

from dataclasses import dataclass

import numpy as np

from sightline.errors import ReconstructionRefusedError

PARALLEL_RAD = np.radians(1.0)  # [ours] at 1°, a distance of 0.1 mm shifts the point along the lines by 6 mm
SPREAD_RAD = 1e-3  # [ours] rms spread of a bundle; the lines through two plates spread by 50 mrad and more


@dataclass(frozen=True, eq=False)
class NearestApproach:
    """Closest approach of two lines: points `first_mm` and `second_mm` (..., 3), and their distance `gap_mm` (...)."""

    first_mm: np.ndarray
    second_mm: np.ndarray
    gap_mm: np.ndarray

    @property
    def middle_mm(self) -> np.ndarray:
        """Midpoint (..., 3) of the two points."""
        return (self.first_mm + self.second_mm) / 2


def meeting_point(origin_mm: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """Return the point (3,) with the smallest sum of squared distances from N lines through (N, 3) along (N, 3).

    Raises ReconstructionRefusedError for fewer than two lines and for nearly parallel lines.
    """
    origin, way = np.asarray(origin_mm, dtype=np.float64), _directed(direction)
    if len(origin) < 2:
        raise ReconstructionRefusedError("one line has no intersection; give at least two")
    normal = len(origin) * np.eye(3) - way.T @ way  # the sum of the projections across the lines
    if np.linalg.eigvalsh(normal)[0] < len(origin) * SPREAD_RAD**2:
        raise ReconstructionRefusedError(
            "the lines are nearly parallel and determine no intersection; use beads further apart"
        )
    return np.linalg.solve(normal, (origin - (way * origin).sum(axis=1, keepdims=True) * way).sum(axis=0))


def unit(vector: np.ndarray) -> np.ndarray:
    """Return vectors (..., n) scaled to unit length."""
    return vector / np.linalg.norm(vector, axis=-1, keepdims=True)


def across(vector: np.ndarray, along: np.ndarray) -> np.ndarray:
    """Return the components of vectors (..., 3) perpendicular to unit vectors `along` (..., 3)."""
    return vector - (vector * along).sum(axis=-1, keepdims=True) * along


def angle_rad(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return the angles (...) between vectors (..., 3), also exact where they are small."""
    return np.arctan2(np.linalg.norm(np.cross(first, second), axis=-1), (first * second).sum(axis=-1))


def cross(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return the cross products (..., 3) of vectors (..., 3): of few in a fifth of the time that `np.cross` takes."""
    (a, b, c), (d, e, f) = ([vectors[..., k] for k in range(3)] for vectors in (first, second))
    return np.stack([b * f - c * e, c * d - a * f, a * e - b * d], axis=-1)


def nearest_approach(
    origin1_mm: np.ndarray, direction1: np.ndarray, origin2_mm: np.ndarray, direction2: np.ndarray
) -> NearestApproach:
    """Return the closest approach of lines through (..., 3) along (..., 3), pair by pair (the paper's Fig. 9).

    Raises ReconstructionRefusedError where two lines are nearly parallel.
    """
    a, b = _directed(direction1), _directed(direction2)
    common = cross(a, b)
    sine2 = (common**2).sum(axis=-1)
    if (sine2 < np.sin(PARALLEL_RAD) ** 2).any():
        raise ReconstructionRefusedError(
            f"two lines of sight are parallel to within {np.degrees(PARALLEL_RAD):g}° and determine no point; "
            "take the views from directions further apart"
        )
    between = np.asarray(origin2_mm, dtype=np.float64) - np.asarray(origin1_mm, dtype=np.float64)
    along1 = (cross(between, b) * common).sum(axis=-1) / sine2
    along2 = (cross(between, a) * common).sum(axis=-1) / sine2
    first, second = origin1_mm + along1[..., None] * a, origin2_mm + along2[..., None] * b
    return NearestApproach(first, second, np.linalg.norm(second - first, axis=-1))


def _directed(direction: np.ndarray) -> np.ndarray:
    direction = np.asarray(direction, dtype=np.float64)
    length = np.sqrt((direction * direction).sum(axis=-1, keepdims=True))  # as np.linalg.norm, in a third of the time
    if not (length > 0).all():
        raise ReconstructionRefusedError("a line has no direction; give two different points of it")
    return direction / length
