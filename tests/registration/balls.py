"""A bone of hollow balls, whose line integrals are known exactly; its CT, two views of it, and their images."""

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from sightline.calibration import MatrixView, view_from_matrix
from sightline.from_images.registration import ScannedBone
from sightline.imaging import Radiograph
from sightline.imaging.volumes.ct import CtScan

CENTRES_MM = np.array(
    [[3.2, -1.1, 41.3], [-14.9, 16.2, 22.7], [2.3, 3.9, 1.4], [18.8, -9.6, -22.2], [7.1, 14.4, -38.9]]
)
RADII_MM, WALL_MM = np.array([21.3, 13.8, 16.1, 12.4, 14.7]), 2.6
DENSE_PER_MM, DENSE_HU, TISSUE_HU = 0.0387, 1932, 40  # attenuation beyond soft tissue's, and a scan's numbers
SHAPE, PITCH_MM, SOURCE_MM, DETECTOR_MM = (320, 320), 0.8, 600.0, 1000.0
CT_AXES = Rotation.from_euler("xyz", [4.0, -3.0, 6.0], degrees=True).as_matrix()
TURN = Rotation.from_rotvec([0.21, -0.34, 0.17])
POSE = RigidTransform.from_components([4.7, -2.9, 7.3], TURN)
HEAD_MM = CENTRES_MM[:1]


def view(name: str, turn_deg: float) -> MatrixView:
    """Return a view along CFCS z, turned about y, exactly known."""
    turned = Rotation.from_euler("y", turn_deg, degrees=True).as_matrix()
    camera = np.diag([DETECTOR_MM / PITCH_MM, DETECTOR_MM / PITCH_MM, 1.0])
    camera[:2, 2] = (np.array(SHAPE[::-1]) - 1) / 2
    matrix = camera @ np.column_stack([turned.T, [0.0, 0.0, SOURCE_MM]])
    return view_from_matrix(matrix, np.zeros((12, 12)), name)


@dataclass(frozen=True, eq=False)
class Scene:
    """Views, and the pose of the bone at each of them."""

    views: tuple[MatrixView, ...] = (view("pa", 3.0), view("lateral", 86.0))
    poses: tuple[RigidTransform, ...] = (POSE, POSE)

    def images(self, seed: int = 1) -> list[Radiograph]:
        """Return the images: exact integrals, a slope of soft tissue, 1 % of noise."""
        rng = np.random.default_rng(seed)
        return [image(seen, pose, rng) for seen, pose in zip(self.views, self.poses, strict=True)]

    def moved(self, by: RigidTransform) -> "Scene":
        """Return the scene in which the bone moved, in CFCS, before the last image."""
        return replace(self, poses=(*self.poses[:-1], by * self.poses[-1]))


def image(seen: MatrixView, pose: RigidTransform, rng: np.random.Generator) -> Radiograph:
    v, u = np.indices(SHAPE)
    along = seen.lines_of_sight(np.stack([u.ravel(), v.ravel()], axis=1).astype(float)).directions
    depth = 2.0 + 0.004 * u.ravel() + chords(pose.apply(CENTRES_MM) - seen.focal_point_mm, along) * DENSE_PER_MM
    light = np.exp(-depth) * (1 + 0.01 * rng.standard_normal(len(depth)))
    return Radiograph(np.clip(light * 4 * 65535, 0, 65535).reshape(SHAPE).astype(np.uint16), 65535.0)


def chords(centres: np.ndarray, along: np.ndarray) -> np.ndarray:
    """Return the length (N,) of rays from the origin along (N, 3) in the balls' walls."""
    near = along @ centres.T
    apart2 = (centres**2).sum(axis=1) - near**2
    outer, inner = (2 * np.sqrt(np.maximum(radii**2 - apart2, 0.0)) for radii in (RADII_MM, RADII_MM - WALL_MM))
    return (outer - inner).sum(axis=1)


def scan(voxel_mm: float = 1.0, size: float = 1.0, mirrored: bool = False) -> CtScan:
    """Return a CT of the bone in soft tissue: partial volumes, off-grid axes; larger by `size`, or mirrored in x."""
    centres = size * CENTRES_MM * [-1.0 if mirrored else 1.0, 1.0, 1.0]
    low = (centres @ CT_AXES.T - size * RADII_MM[:, None]).min(axis=0) - 4.0
    high = (centres @ CT_AXES.T + size * RADII_MM[:, None]).max(axis=0) + 4.0
    counts = np.ceil((high - low) / voxel_mm).astype(int)
    at = low + voxel_mm * np.stack(np.indices(counts), axis=-1)
    share = np.zeros(counts)
    for centre, radius in zip(centres @ CT_AXES.T, RADII_MM, strict=True):
        depth = size * radius - np.linalg.norm(at - centre, axis=-1)
        share += np.clip(depth / voxel_mm + 0.5, 0, 1) - np.clip((depth - size * WALL_MM) / voxel_mm + 0.5, 0, 1)
    hu = np.rint(TISSUE_HU + share * (DENSE_HU - TISSUE_HU)).astype(np.int16)
    return CtScan(hu, low @ CT_AXES, np.full(3, voxel_mm), CT_AXES)


def bone(**scanned: float | bool) -> ScannedBone:
    """Return the bone of `scan`."""
    return ScannedBone.of_ct(scan(**scanned))
