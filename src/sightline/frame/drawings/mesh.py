"""A plate, or a solid, as a closed surface for 3D printing or milling: STL.

The face with the bores is a Delaunay triangulation of the outline's corners and the bores' rims. The circle of a rim
contains no other point, so the triangulation keeps every rim, and the triangles within a rim are the floor of its bore.
"""

from collections.abc import Sequence

import numpy as np
from scipy.spatial import Delaunay
from trimesh import Trimesh
from trimesh.exchange.stl import export_stl

from sightline.errors import FrameError
from sightline.frame.drawings.part import SCREW_MM, Part

FACETS = 48  # [ours] of a rim: the roundness error of a 3 mm bore is 0.003 mm
Surface = tuple[np.ndarray, np.ndarray]  # vertices (M, 3), mm; triangles (T, 3), counter-clockwise from outside


def plate_mesh(part: Part, clearance_mm: float = 0.0) -> Trimesh:
    """Return the plate in its drawing's coordinates, mm, with the bores in the front face, z = thickness.

    `clearance_mm` is added to the bores' diameters. Raises FrameError.
    """
    outline = np.array(part.outline)
    flat, triangles, hole = _triangulated(outline, [(x, y, SCREW_MM / 2) for x, y in part.screws])
    back = np.column_stack([flat, np.zeros(len(flat))]), triangles[hole < 0][:, ::-1]
    edges = [np.column_stack([outline, np.full(len(outline), z)]) for z in (part.thickness_mm, 0.0)]
    side = np.concatenate(edges), _walls(np.arange(len(outline)), len(outline))
    return _closed([_bored(part, clearance_mm), back, side], part.title)


def solid_mesh(faces: Sequence[Part], clearance_mm: float = 0.0) -> Trimesh:
    """Return the solid that has these six faces, CFCS, mm; `clearance_mm` is added to the bores' diameters.

    Raises FrameError.
    """
    surfaces = []
    for face in faces:
        xyz, triangles = _bored(face, clearance_mm)
        surfaces.append((face.corner_mm + (xyz - [0.0, 0.0, face.thickness_mm]) @ face.axes, triangles))
    return _closed(surfaces, "solid")


def meshes_of(parts: Sequence[Part], clearance_mm: float = 0.0) -> dict[str, bytes]:
    """Return the binary STL of each plate, and of the solid with these faces, by the name of its file."""
    faces = [part for part in parts if part.view is None]
    solid = {"solid.stl": export_stl(solid_mesh(faces, clearance_mm))} if faces else {}
    flat = [part for part in parts if part.view is not None]
    return solid | {f"{part.name}.stl": export_stl(plate_mesh(part, clearance_mm)) for part in flat}


def _bored(part: Part, clearance_mm: float) -> Surface:
    """Return the front face of a part, z = thickness, with its bores and the walls of its screw holes."""
    holes = [(b.x_mm, b.y_mm, (b.ball.diameter_mm + clearance_mm) / 2) for b in part.bores]
    holes += [(x, y, SCREW_MM / 2) for x, y in part.screws]
    floors = [part.thickness_mm - b.depth_mm for b in part.bores] + [0.0] * len(part.screws)
    flat, triangles, hole = _triangulated(np.array(part.outline), holes)
    n, m, blind = len(part.outline), len(flat), len(part.bores)
    top = np.column_stack([flat, np.full(m, part.thickness_mm)])
    below = top.copy()
    below[n:, 2] = np.repeat(floors, FACETS)
    faces = [triangles[hole < 0], triangles[(hole >= 0) & (hole < blind)] + m]
    faces += [_walls(n + FACETS * k + np.arange(FACETS)[::-1], m) for k in range(len(holes))]
    return np.concatenate([top, below]), np.concatenate(faces)


def _triangulated(
    outline: np.ndarray, circles: Sequence[tuple[float, float, float]]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return points (M, 2) of outline and circles (x, y, radius), triangles (T, 3), and the circle of each, or -1."""
    angle = 2 * np.pi * np.arange(FACETS) / FACETS
    ring = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    flat = np.concatenate([outline, *(np.array([x, y]) + radius * ring for x, y, radius in circles)])
    triangles = Delaunay(flat).simplices
    a, b, c = flat[triangles].swapaxes(0, 1)
    area = (b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]
    triangles = np.where(area[:, None] > 0, triangles, triangles[:, ::-1])
    # A triangle lies in the circle on which all its corners lie.
    owner = np.concatenate([np.full(len(outline), -1), np.repeat(np.arange(len(circles)), FACETS)])[triangles]
    return flat, triangles, np.where((owner == owner[:, :1]).all(axis=1), owner[:, 0], -1)


def _walls(loop: np.ndarray, m: int) -> np.ndarray:
    """Return (2K, 3): triangles of the walls from a loop on the top, with the solid on its left, to the loop below."""
    after = np.roll(loop, -1)
    return np.concatenate([np.column_stack([loop, loop + m, after + m]), np.column_stack([loop, after + m, after])])


def _closed(surfaces: Sequence[Surface], name: str) -> Trimesh:
    """Return the body within surfaces that share their edges. Raises FrameError where it is not closed."""
    starts = np.cumsum([0, *(len(xyz) for xyz, _ in surfaces)])
    triangles = np.concatenate([each + start for (_, each), start in zip(surfaces, starts, strict=False)])
    mesh = Trimesh(np.concatenate([xyz for xyz, _ in surfaces]), triangles, process=False)
    mesh.merge_vertices()
    if not (mesh.is_watertight and mesh.is_winding_consistent and mesh.volume > 0):
        raise FrameError(f"the {name} does not give a closed surface; check for bores that touch")
    return mesh
