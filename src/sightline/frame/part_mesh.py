"""A plate as a closed surface for 3D printing or milling: STL.

The face with the bores is a Delaunay triangulation of the outline's corners and the bores' rims. The circle of a rim
contains no other point, so the triangulation keeps every rim, and the triangles within a rim are the floor of its bore.
"""

import numpy as np
from scipy.spatial import Delaunay
from trimesh import Trimesh
from trimesh.exchange.stl import export_stl

from sightline.errors import FrameError
from sightline.frame.part import SCREW_MM, Part

FACETS = 48  # [ours] of a rim: the roundness error of a 3 mm bore is 0.003 mm


def plate_mesh(part: Part) -> Trimesh:
    """Return the plate in its drawing's coordinates, mm, with the bores in the front face, z = thickness.

    Raises FrameError.
    """
    outline = np.array(part.outline)
    angle = 2 * np.pi * np.arange(FACETS) / FACETS
    ring = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    holes = [(b.x_mm, b.y_mm, b.ball.diameter_mm / 2, part.thickness_mm - b.depth_mm) for b in part.bores]
    holes += [(x, y, SCREW_MM / 2, 0.0) for x, y in part.screws]
    rims = [np.array([x, y]) + radius * ring for x, y, radius, _ in holes]
    flat = np.concatenate([outline, *rims])
    triangles = _counter_clockwise(flat, Delaunay(flat).simplices)
    n, m = len(outline), len(flat)
    # A triangle lies in the hole on whose rim all its corners lie.
    owner = np.concatenate([np.full(n, -1), np.repeat(np.arange(len(holes)), FACETS)])[triangles]
    inside = np.where((owner == owner[:, :1]).all(axis=1), owner[:, 0], -1)
    top = np.column_stack([flat, np.full(m, part.thickness_mm)])
    below = top.copy()  # the outline on the back, each rim on the floor of its bore
    below[:n, 2] = 0.0
    below[n:, 2] = np.repeat([floor for *_, floor in holes], FACETS)
    blind = len(part.bores)
    faces = [triangles[inside < 0], triangles[(inside >= 0) & (inside < blind)] + m]
    faces.append(_walls(np.arange(n), m))
    faces += [_walls(n + FACETS * k + np.arange(FACETS)[::-1], m) for k in range(len(holes))]
    back = np.concatenate([outline, *rims[blind:]])
    place = np.concatenate([np.arange(n), np.arange(n + FACETS * blind, m)]) + m
    behind = _counter_clockwise(back, Delaunay(back).simplices)
    on_rim = np.concatenate([np.full(n, -1), np.repeat(np.arange(len(part.screws)), FACETS)])[behind]
    solid = ~((on_rim == on_rim[:, :1]).all(axis=1) & (on_rim[:, 0] >= 0))
    faces.append(place[behind[solid]][:, ::-1])
    mesh = Trimesh(np.concatenate([top, below]), np.concatenate(faces), process=False)
    if not (mesh.is_watertight and mesh.is_winding_consistent and mesh.volume > 0):
        raise FrameError(f"the {part.name} plate does not give a closed surface; check for bores that touch")
    return mesh


def plate_stl(part: Part) -> bytes:
    """Return the plate as binary STL."""
    return export_stl(plate_mesh(part))


def _counter_clockwise(points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    a, b, c = points[triangles].swapaxes(0, 1)
    area = (b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]
    return np.where(area[:, None] > 0, triangles, triangles[:, ::-1])


def _walls(loop: np.ndarray, m: int) -> np.ndarray:
    """Return (2K, 3): triangles of the walls from a loop on the top, with the solid on its left, to the loop below."""
    after = np.roll(loop, -1)
    return np.concatenate([np.column_stack([loop, loop + m, after + m]), np.column_stack([loop, after + m, after])])
