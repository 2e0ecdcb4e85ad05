"""Volumes in the beam: the share of a material in every voxel. Lengths mm, points in CFCS."""

from dataclasses import dataclass, field, replace

import numpy as np

from sightline.errors import SetUpError


@dataclass(frozen=True, eq=False)
class Volume:
    """The share of a material (nx, ny, nz), float32; the remainder is the material `within`; None: air.

    Value [i, j, k] is at origin_mm + (voxel_mm * (i, j, k)) @ axes, with `voxel_mm` (3,), and the volume's own axes as
    rows of `axes` (3, 3).
    """

    values: np.ndarray
    origin_mm: np.ndarray
    voxel_mm: np.ndarray
    axes: np.ndarray = field(default_factory=lambda: np.eye(3))
    material: str = "bone"
    within: str | None = "tissue"

    def __post_init__(self) -> None:
        if self.values.ndim != 3 or min(self.values.shape) < 2:
            raise SetUpError(f"a volume needs at least two voxels per side, not the shape {self.values.shape}")
        object.__setattr__(self, "values", np.ascontiguousarray(self.values, dtype=np.float32))

    def along_mm(self, xyz_mm: np.ndarray, direction: np.ndarray) -> np.ndarray:
        """Return the distance (nx, ny, nz), float32, of every voxel from a point (3,) along a direction (3,)."""
        first = (self.origin_mm - xyz_mm) @ direction
        i, j, k = (np.arange(n, dtype=np.float32) for n in self.values.shape)
        a, b, c = (self.voxel_mm * (self.axes @ direction)).astype(np.float32)
        return np.float32(first) + a * i[:, None, None] + b * j[:, None] + c * k


def bored(volume: Volume, ends_mm: np.ndarray, diameter_mm: float) -> Volume:
    """Return the volume with a round bore between two points (2, 3), flat at both ends. Raises SetUpError."""
    start, end = np.asarray(ends_mm, dtype=np.float64)
    length = float(np.linalg.norm(end - start))
    if not (length > 0 and diameter_mm > 0):
        raise SetUpError("a bore needs two different points and a diameter above zero")
    along = (end - start) / length
    across = np.linalg.svd(along[None])[2][1:]
    edge = np.float32(volume.voxel_mm.mean())
    radial = np.hypot(*(volume.along_mm(start, axis) for axis in across))
    beyond = volume.along_mm(start, along)
    depth = np.minimum(np.float32(diameter_mm / 2) - radial, np.minimum(beyond, np.float32(length) - beyond))
    return replace(volume, values=volume.values * (1 - _step(depth / edge)))


def fractured(volume: Volume, at_mm: np.ndarray, normal: np.ndarray, gap_mm: float = 1.0) -> tuple[Volume, Volume]:
    """Return the two fragments behind and before a plane through a point (3,) with a `normal` (3,), with a gap between.

    The gap is filled with the material around the volume. A gap of 1 mm [ours] is a fracture line; `things.moved`
    displaces a fragment. Raises SetUpError.
    """
    length = float(np.linalg.norm(normal))
    if not (length > 0 and gap_mm >= 0):
        raise SetUpError("a fracture needs a normal that is not zero, and a gap of zero or more")
    beyond = volume.along_mm(np.asarray(at_mm), np.asarray(normal) / length)
    edge = np.float32(volume.voxel_mm.mean())
    behind, before = (_step((side * beyond - np.float32(gap_mm / 2)) / edge) for side in (-1, 1))
    return replace(volume, values=volume.values * behind), replace(volume, values=volume.values * before)


def _step(voxels: np.ndarray) -> np.ndarray:
    """Return a linear ramp from 0 to 1 across one voxel around 0: a voxel's partial volume."""
    return np.clip(voxels + np.float32(0.5), 0, 1)
