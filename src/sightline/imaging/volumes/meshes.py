"""Closed triangle meshes of one material, and their files (STL, PLY, OBJ). Lengths mm, CFCS."""

from dataclasses import dataclass
from io import BytesIO
from pathlib import Path

import numpy as np

from sightline.common.bounded import read_bounded
from sightline.errors import UnusableInputError

MAX_TRIANGLES = 2**21  # [ours] 25 times those of a femur from clinical CT
MAX_FILE_BYTES = 128 * MAX_TRIANGLES  # binary STL has 50 bytes a triangle
SIZE_MM = (1.0, 1000.0)  # [ours] longest side: smaller meshes are in metres or inches, larger ones do not fit the beam
FLAT = 1e-9  # volume over longest side cubed: smaller values are rounding errors
FILE_TYPES = ("stl", "ply", "obj")


@dataclass(frozen=True, eq=False)
class Mesh:
    """A closed surface filled with a material, which displaces the material around it (`within`; None: air).

    `vertices_mm` (V, 3); `triangles` (T, 3): rows of three vertices, counter-clockwise seen from outside (if all are
    clockwise, they are reversed). Shells may nest: a hollow is a shell with reversed triangles. Overlapping shells
    count twice. Raises UnusableInputError if the surface is not closed: each edge must occur as often in one direction
    as in the other.
    """

    vertices_mm: np.ndarray
    triangles: np.ndarray
    material: str = "bone"
    within: str | None = "tissue"

    def __post_init__(self) -> None:
        vertices = np.ascontiguousarray(self.vertices_mm, dtype=np.float64).reshape(-1, 3)
        triangles = np.ascontiguousarray(self.triangles, dtype=np.int64).reshape(-1, 3)
        _check(vertices, triangles)
        filled = np.einsum("ij,ij->", *_corners_and_crosses(vertices, triangles)) / 6
        if abs(filled) < FLAT * np.ptp(vertices, axis=0).max() ** 3:
            raise UnusableInputError("the mesh encloses nothing; give the surface of a solid")
        object.__setattr__(self, "vertices_mm", vertices)
        object.__setattr__(self, "triangles", triangles if filled > 0 else np.ascontiguousarray(triangles[:, ::-1]))

    @property
    def volume_mm3(self) -> float:
        """Enclosed volume, mm³."""
        return float(np.einsum("ij,ij->", *_corners_and_crosses(self.vertices_mm, self.triangles)) / 6)


def read_mesh(path: str | Path, material: str = "bone", within: str | None = "tissue") -> Mesh:
    """Read a mesh from an STL, PLY or OBJ file in mm, in the file's coordinates; `things.moved` places it.

    Identical vertices are merged, and triangles without area are removed. Raises UnusableInputError.
    """
    import trimesh  # loads slowly, and few scenes have meshes

    file = Path(path)
    file_type = file.suffix.lower().removeprefix(".")
    if file_type not in FILE_TYPES:
        raise UnusableInputError(
            f"{file.name} is not a mesh file ({', '.join(FILE_TYPES)}); convert it to one of these"
        )
    data = read_bounded(file, MAX_FILE_BYTES, UnusableInputError, "reduce the mesh")
    try:
        loaded = trimesh.load_mesh(BytesIO(data), file_type=file_type, process=False)
        vertices, triangles = np.asarray(loaded.vertices, np.float64), np.asarray(loaded.faces, np.int64)
    except Exception as error:  # broken bytes may make the reader raise anything
        raise UnusableInputError(
            f"{file.name} is damaged or not a {file_type.upper()} mesh; export it again"
        ) from error
    try:
        if len(triangles) and triangles.max() < len(vertices):
            vertices, corner = np.unique(vertices, axis=0, return_inverse=True)
            triangles = corner.reshape(-1)[triangles]
            distinct = (triangles != np.roll(triangles, 1, axis=1)).all(axis=1)
            triangles = triangles[distinct]
        return Mesh(vertices, triangles, material, within)
    except UnusableInputError as error:
        raise UnusableInputError(f"{file.name}: {error}") from error


def _check(vertices: np.ndarray, triangles: np.ndarray) -> None:
    if not len(triangles):
        raise UnusableInputError("the mesh has no triangles; give the surface of a solid")
    if len(triangles) > MAX_TRIANGLES:
        raise UnusableInputError(f"the mesh has {len(triangles)} triangles; the limit is {MAX_TRIANGLES}: reduce it")
    if triangles.min() < 0 or triangles.max() >= len(vertices):
        raise UnusableInputError("a triangle of the mesh names a missing vertex; export it again")
    if not np.isfinite(vertices).all():
        raise UnusableInputError("the mesh has vertices that are not finite; export it again")
    size = float(np.ptp(vertices[np.unique(triangles)], axis=0).max())
    if not SIZE_MM[0] <= size <= SIZE_MM[1]:
        raise UnusableInputError(
            f"the mesh is {size:.4g} mm long (allowed: {SIZE_MM[0]:g} to {SIZE_MM[1]:g} mm); give it in mm"
        )
    edges = np.concatenate([triangles, np.roll(triangles, -1, axis=1)], axis=0).reshape(2, -1).T
    name = edges.min(axis=1) * len(vertices) + edges.max(axis=1)
    _, which = np.unique(name, return_inverse=True)
    unbalanced = np.count_nonzero(np.bincount(which, np.sign(edges[:, 1] - edges[:, 0])))
    if unbalanced:
        raise UnusableInputError(
            f"the mesh is not closed: {unbalanced} of its edges lack a triangle on one side, or its triangles do not "
            "all face outwards; repair it (fill its holes, make its normals consistent)"
        )


def _corners_and_crosses(vertices: np.ndarray, triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return first vertices, and cross products of the other two, (T, 3) each, relative to the mesh's centre."""
    a, b, c = np.moveaxis((vertices - vertices.mean(axis=0))[triangles], 1, 0)
    return a, np.cross(b, c)
