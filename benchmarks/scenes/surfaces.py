"""Surfaces of bones: signed distances on a grid, and closed meshes of their levels. mm, patient coordinates.

Patient coordinates are those of a CT scan: x to the patient's left, y to the back, z to the head. Bones are left ones.
"""

import os
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path

import numpy as np
import trimesh
from scipy.ndimage import binary_fill_holes, map_coordinates
from scipy.spatial import cKDTree

from sightline.errors import SetUpError
from sightline.twin.anatomy.bones import AIIS, BRIM, HIP, ROOF, Pelvis, Vertebra

FEMUR = Path(__file__).parents[3] / "shared" / "data" / "femur" / "m3_lfemur_mm.stl"  # no part of the repository
# Environment variable: folder of the computed distances, by default in that of temporary files. Delete them after a
# change of the twin's bones.
CACHE = "SIGHTLINE_BONES"
STEP_MM = {"femur": 1.0, "pelvis": 1.0, "vertebra": 0.8}  # of the grid: a level is within about 0.02 mm [ours]
REACH_MM, PLANE_MM = 8.0, 1.5  # distances are clipped to the first, and taken from tangent planes up to the second
# (lateral, caudal, anterior) of the twin's bones in patient coordinates, and where their origin is put [ours].
PATIENT_OF_BONE = np.array([[1.0, 0, 0], [0, 0, -1], [0, -1, 0]])
ORIGIN_MM = {"pelvis": np.array([3.0, 42.0, -655.0]), "vertebra": np.array([-4.0, 31.0, -512.0])}
HIP_REACH_MM = np.array([[-82.0, -82.0, -82.0], [46.0, 66.0, 70.0]])  # of the pelvis that is drawn, from the hip
# Read off the mesh; the head's centre is that of a sphere fitted to it, with a radius of 22.7 mm.
FEMUR_POINTS_MM = {
    "head centre": (85.0, -122.8, -831.0),
    "neck": (107.0, -116.0, -843.0),
    "greater trochanter": (138.0, -96.0, -830.0),
    "lesser trochanter": (104.0, -95.0, -877.0),
    "shaft": (126.0, -117.0, -900.0),
}


@dataclass(frozen=True, eq=False)
class Anatomy:
    """A bone. `distance_mm` [i, j, k] is the signed distance, negative inside, at low_mm + step_mm * (i, j, k).

    `points_mm`: five places (3,) spread over the bone, by name; the first is at its joint, or its middle.
    """

    name: str
    distance_mm: np.ndarray
    low_mm: np.ndarray
    step_mm: float
    points_mm: dict[str, np.ndarray]

    @property
    def joint_mm(self) -> np.ndarray:
        """The first of the places (3,)."""
        return next(iter(self.points_mm.values()))

    def at(self, xyz_mm: np.ndarray) -> np.ndarray:
        """Return the signed distances (...) of points (..., 3)."""
        index = np.moveaxis((xyz_mm - self.low_mm) / self.step_mm, -1, 0)
        return map_coordinates(self.distance_mm, index, order=1, mode="nearest")

    @cached_property
    def grid_mm(self) -> np.ndarray:
        """The points (nx, ny, nz, 3) of the grid."""
        return self.low_mm + self.step_mm * np.moveaxis(np.indices(self.distance_mm.shape), 0, -1)

    def surface(self, level_mm: float, cut: tuple[np.ndarray, np.ndarray] | None = None) -> trimesh.Trimesh:
        """Return the closed mesh of a level; `cut`: only behind a plane through a point (3,) with a normal (3,)."""
        field = self.distance_mm - level_mm
        if cut is not None:
            field = np.maximum(field, (self.grid_mm - cut[0]) @ cut[1])
        mesh = zero_surface(field)
        mesh.apply_scale(self.step_mm)
        mesh.apply_translation(self.low_mm)
        return mesh


def zero_surface(field: np.ndarray) -> trimesh.Trimesh:
    """Return the closed mesh around the negative values of a field, in indices [src Gibson 1998, surface nets].

    Each cell that the surface passes has one vertex: the mean of where the surface crosses the cell's edges.
    """
    field = np.pad(field, 1, constant_values=REACH_MM)
    crossings, cells = [], []
    for along, across, up in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        step, first, second = np.eye(3, dtype=int)[[along, across, up]]
        low, high = (np.take(field, range(k, field.shape[along] - 1 + k), along) for k in (0, 1))
        at = np.argwhere((low < 0) != (high < 0))
        a, b = low[tuple(at.T)], high[tuple(at.T)]
        crossings.append(at + (a / (a - b))[:, None] * step)
        around = at[:, None] - np.stack([0 * step, first, first + second, second])
        around[a >= 0] = around[a >= 0][:, ::-1]
        cells.append(around)
    at, quads = np.concatenate(crossings), np.concatenate(cells)
    found, corner = np.unique(np.ravel_multi_index(tuple(np.moveaxis(quads, -1, 0)), field.shape), return_inverse=True)
    corner = corner.reshape(-1, 4)
    owner, count = corner.ravel(), np.bincount(corner.ravel())
    sums = [np.bincount(owner, np.repeat(axis, 4), len(found)) for axis in at.T]
    triangles = np.concatenate([corner[:, [0, 1, 2]], corner[:, [0, 2, 3]]])
    return trimesh.Trimesh(np.stack(sums, axis=1) / count[:, None] - 1.0, triangles, process=False)


@lru_cache(maxsize=3)
def anatomy(name: str) -> Anatomy:
    """Return "femur", "pelvis" or "vertebra". Raises SetUpError where the femur's mesh is not beside the repository."""
    folder = Path(os.environ.get(CACHE) or Path(tempfile.gettempdir()) / "sightline-bones")
    file = folder / f"{name}.npz"
    mesh, points = _femur() if name == "femur" else _of_twin(name)
    if file.is_file():
        with np.load(file) as kept:
            return Anatomy(name, kept["distance_mm"], kept["low_mm"], STEP_MM[name], points)
    whole = _distances(name, mesh(), STEP_MM[name], points)
    folder.mkdir(parents=True, exist_ok=True)
    part = file.with_suffix(f".{os.getpid()}.npz")
    np.savez_compressed(part, distance_mm=whole.distance_mm, low_mm=whole.low_mm)
    part.replace(file)  # another process never sees a part of it
    return whole


Made = tuple[Callable[[], trimesh.Trimesh], dict[str, np.ndarray]]


def _femur() -> Made:
    if not FEMUR.is_file():
        raise SetUpError("the femur's mesh is not beside the repository (../shared/data/femur); choose another anatomy")
    return lambda: trimesh.load_mesh(FEMUR), {name: np.array(at) for name, at in FEMUR_POINTS_MM.items()}


def _of_twin(name: str) -> Made:
    """Return the mesh of the mean bone of the twin, and its places."""
    if name == "pelvis":
        bone, joint, reach = Pelvis().bone(), HIP, HIP_REACH_MM
        points = {"hip": HIP, "roof": ROOF, "spine": AIIS, "brim": BRIM, "ischium": HIP - [18.0, -34.0, 20.0]}
    else:
        vertebra = Vertebra()
        bone, reach = vertebra.bone(), np.array([[-46.0, -40.0, -75.0], [46.0, 44.0, 26.0]])
        left, mirror = vertebra.pedicle_mm, np.array([-1.0, 1.0, 1.0])
        spinous = bone.landmarks_mm["spinous process"] + [0.0, -5.0, 5.0]
        joint = np.zeros(3)
        points = {
            "middle": joint,
            "left": left,
            "right": left * mirror,
            "spinous": spinous,
            "front": [14.0, -9.0, 12.0],
        }
    low, high = np.sort((joint + reach) @ PATIENT_OF_BONE.T, axis=0)
    step = STEP_MM[name] / 1.25

    def mesh() -> trimesh.Trimesh:
        grid = low + step * np.moveaxis(np.indices(np.ceil((high - low) / step).astype(int)), 0, -1)
        surface = zero_surface(bone.depth_mm(grid @ PATIENT_OF_BONE))
        surface.apply_scale(step)
        surface.apply_translation(low + ORIGIN_MM[name])
        return surface

    return mesh, {key: PATIENT_OF_BONE @ at + ORIGIN_MM[name] for key, at in points.items()}


def _distances(name: str, mesh: trimesh.Trimesh, step: float, points: dict[str, np.ndarray]) -> Anatomy:
    """Return the signed distances from a closed mesh: along its normals near it, else to its nearest vertex."""
    fine = mesh.subdivide()  # vertices about 0.5 mm apart
    low = fine.bounds[0] - REACH_MM
    shape = np.ceil((fine.bounds[1] + REACH_MM - low) / step).astype(int)
    grid = (low + step * np.moveaxis(np.indices(shape), 0, -1)).reshape(-1, 3)
    far, nearest = cKDTree(fine.vertices).query(grid, distance_upper_bound=REACH_MM)
    near = np.isfinite(far)
    rise = ((grid[near] - fine.vertices[nearest[near]]) * fine.vertex_normals[nearest[near]]).sum(axis=1)
    signed = np.full(len(grid), REACH_MM)
    signed[near] = np.where(far[near] < PLANE_MM, rise, np.copysign(far[near], rise))
    signed = signed.reshape(shape)
    signed[binary_fill_holes(signed < 0) & (signed >= REACH_MM)] = -REACH_MM
    return Anatomy(name, signed.astype(np.float32), low, step, points)
