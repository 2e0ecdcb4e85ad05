"""Edges of a nail and its hole as points, from the geometry alone: contour points are where rays graze the surface.

Nothing here is shared with the estimator: outlines are found on the bent surface by its normals, rims along the hole's
generators, and what a lens shows by polygons in the image.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import cv2
import numpy as np

from sightline.planning import Edge, Hole, HoleSeen
from sightline.twin.anatomy.nailed_femur import DistalNail

OUTLINE_PX, RIM_PX = 0.15, 0.3  # s.d. of a point across its edge, and
OUTLINE_COMMON_PX, RIM_COMMON_PX = 0.05, 0.15  # of an error that the points of an edge share
OUTLINE_MM = np.arange(-22.0, 23.0, 2.0)  # from the hole, along the nail
AROUND = 240  # points of a rim before every few are used


@dataclass(frozen=True, eq=False)
class Sight:
    """One image: where the X-ray source is (3,), and the true pixels (N, 2) of points (N, 3)."""

    focal_mm: np.ndarray
    project: Callable[[np.ndarray], np.ndarray]


def outline(nail: DistalNail, sight: Sight, side: int, s_mm: np.ndarray = OUTLINE_MM) -> np.ndarray:
    """Return points (N, 3) where rays graze the nail on one side (0 or 1), at places (N,) along it."""
    angle = np.linspace(-np.pi, np.pi, 73)
    facing = _facing(nail, sight, np.tile(s_mm, len(angle)), np.repeat(angle, len(s_mm))).reshape(len(angle), -1)
    turns = ((facing[:-1] < 0) != (facing[1:] < 0)) & ((facing[1:] > facing[:-1]) == bool(side))
    first = turns.argmax(axis=0)
    a, b = angle[first], angle[first + 1]
    for _ in range(40):
        middle = (a + b) / 2
        same = (_facing(nail, sight, s_mm, middle) < 0) == (_facing(nail, sight, s_mm, a) < 0)
        a, b = np.where(same, middle, a), np.where(same, b, middle)
    return _surface(nail, s_mm, a)


def rim(nail: DistalNail, hole: int, end: int) -> np.ndarray:
    """Return points (AROUND, 3) of a rim: `end` 0 where the hole's direction comes from, 1 where it goes to."""
    point, axis = nail.holes[hole]
    first = np.cross(axis, nail.along)
    first /= np.linalg.norm(first)
    angle = 2 * np.pi * np.arange(AROUND)[:, None] / AROUND
    start = point + nail.hole_diameter_mm / 2 * (np.cos(angle) * first + np.sin(angle) * np.cross(axis, first))
    sign = 2 * end - 1
    a, b = np.zeros(AROUND), np.full(AROUND, nail.diameter_mm)
    for _ in range(45):
        middle = (a + b) / 2
        inside = _from_axis(nail, start + sign * middle[:, None] * axis) < nail.diameter_mm / 2
        a, b = np.where(inside, middle, a), np.where(inside, b, middle)
    return start + sign * a[:, None] * axis


def seen(
    rng: np.random.Generator,
    nail: DistalNail,
    sights: Mapping[str, Sight],
    hole: int = 0,
    *,
    hidden: float = 0.0,
    lens: bool = True,
    every: int = 6,
    noise: float = 1.0,
) -> list[HoleSeen]:
    """Return the edges that each image shows, with errors; `noise` scales them.

    `hidden`: share of each rim's circle that is covered. `lens`: only the points on the boundary of the open lens;
    otherwise whole rims. The entry is nearer to the first source.
    """
    point, axis = nail.holes[hole]
    entry = 0 if axis @ (point - next(iter(sights.values())).focal_mm) > 0 else 1
    rims = [rim(nail, hole, end) for end in (entry, 1 - entry)]

    def edge(uv: np.ndarray, sd: float, common: float, outwards: float, middle: np.ndarray) -> Edge:
        normal = np.gradient(uv, axis=0)[:, ::-1] * [1.0, -1.0]
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
        normal *= np.sign(((uv - middle) * normal).sum(axis=1))[:, None]
        off = noise * (sd * rng.standard_normal(len(uv)) + common * outwards)
        return Edge(uv + off[:, None] * normal, np.full(len(uv), sd**2), common)

    def in_image(sight: Sight) -> HoleSeen:
        grazing = [sight.project(outline(nail, sight, side)) for side in (0, 1)]
        middle = np.mean([uv.mean(axis=0) for uv in grazing], axis=0)
        outlines = [edge(uv, OUTLINE_PX, OUTLINE_COMMON_PX, rng.standard_normal(), middle) for uv in grazing]
        polygons = [sight.project(points) for points in rims]
        shared, covered = rng.standard_normal(), rng.uniform(0, 2 * np.pi)
        edges = []
        for own, other in (polygons, polygons[::-1]):
            angle = np.arctan2(*(own - own.mean(axis=0)).T)
            kept = (angle - covered) % (2 * np.pi) >= 2 * np.pi * hidden
            if lens:
                contour = other.astype(np.float32)[:, None]
                kept &= np.array([cv2.pointPolygonTest(contour, (float(u), float(v)), True) > 0.3 for u, v in own])
            kept[np.arange(len(own)) % every != 0] = False
            whole = edge(own, RIM_PX, RIM_COMMON_PX, shared, own.mean(axis=0))
            edges.append(Edge(whole.uv_px[kept], whole.variance_px2[kept], whole.common_px))
        return HoleSeen((outlines[0], outlines[1]), edges[0], edges[1])

    return [in_image(sight) for sight in sights.values()]


def _surface(nail: DistalNail, s: np.ndarray, angle: np.ndarray) -> np.ndarray:
    radius = nail.diameter_mm / 2
    return nail.placed(np.column_stack([radius * np.cos(angle), radius * np.sin(angle), s]))


def _facing(nail: DistalNail, sight: Sight, s: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """Return the cosine (N,) between ray and surface normal at places of the nail."""
    on = _surface(nail, s, angle)
    normal = on - nail.placed(np.column_stack([np.zeros((len(s), 2)), s]))
    return (normal * (on - sight.focal_mm)).sum(axis=1)


def _from_axis(nail: DistalNail, xyz_mm: np.ndarray) -> np.ndarray:
    """Return the distances (N,) of points from the nail's bent axis, which is searched along its length."""
    near = (xyz_mm - nail.hole_mm) @ nail.along
    for _ in range(3):
        on, ahead = (nail.placed(np.column_stack([np.zeros((len(near), 2)), near + d])) for d in (0.0, 1e-3))
        near = near + ((xyz_mm - on) * (ahead - on)).sum(axis=1) / 1e-3
    return np.linalg.norm(xyz_mm - nail.placed(np.column_stack([np.zeros((len(near), 2)), near])), axis=1)


def ends_of_outlines(nail: DistalNail, sight: Sight, reach_mm: float) -> np.ndarray:
    """Return the pixels (2, 2, 2) of both outlines, `reach_mm` to either side of the first hole."""
    at = np.array([-reach_mm, reach_mm])
    return np.stack([sight.project(outline(nail, sight, side, at)) for side in (0, 1)])


@dataclass(frozen=True)
class HoleError:
    """Errors of one hole at its middle, mm, and of its direction, °; squared Mahalanobis lengths of both together (4
    degrees of freedom)."""

    off_mm: float
    off_deg: float
    square: float


def scored(hole: Hole, nail: DistalNail) -> HoleError:
    """Return how a measured hole differs from the first hole of a nail."""
    point, axis = nail.holes[0]
    axis = axis * np.sign(axis @ hole.direction)
    measured = np.stack([hole.entry_mm, hole.exit_mm])
    true = point + axis * ((measured - point) @ axis)[:, None]
    to_axis = np.kron(np.eye(2), np.linalg.svd(hole.direction[None])[2][1:])
    error = to_axis @ (measured - true).ravel()
    square = float(error @ np.linalg.solve(to_axis @ hole.covariance_mm2 @ to_axis.T, error))
    off = float(np.linalg.norm(np.cross(hole.middle_mm - point, axis)))
    return HoleError(off, float(np.rad2deg(np.arcsin(np.linalg.norm(np.cross(axis, hole.direction))))), square)
