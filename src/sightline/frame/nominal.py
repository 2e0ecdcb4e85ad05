"""The nominal C-arm, used to design and check frames; never used to compute a result."""

import numpy as np

from sightline.common.geometry.planes import Plane
from sightline.frame.plate import FrameView

SOURCE_TO_HIP_MM = 620.0  # physics.md, C-arm and image chain [ours]
SOURCE_TO_DETECTOR_MM = 1000.0  # ARCADIS Varic 968 [src manual]
FIELD_DIAMETER_MM = 215.0  # [ours] useful field of a 9 inch (229 mm) intensifier, its rim left out


def axis(view: FrameView) -> np.ndarray:
    """Return the unit vector (3,), CFCS, of the beam from source to intensifier, through the plates' centroids."""
    along = view.xrii.xyz_mm.mean(axis=0) - view.source.xyz_mm.mean(axis=0)
    return along / np.linalg.norm(along)


def focal_point_mm(view: FrameView) -> np.ndarray:
    """Return the expected focal point (3,), CFCS, with the hip at the origin."""
    return -SOURCE_TO_HIP_MM * axis(view)


def depth_mm(view: FrameView, xyz_mm: np.ndarray) -> np.ndarray:
    """Return (N,): distances of points (N, 3) from the source along the beam."""
    return (xyz_mm - focal_point_mm(view)) @ axis(view)


def at_distance_mm(view: FrameView, xyz_mm: np.ndarray, distance_mm: float) -> np.ndarray:
    """Return (N, 2): points (N, 3) in front of the source, projected to a plane across the beam."""
    plane = Plane.across(axis(view), focal_point_mm(view))
    return plane.to_plane(xyz_mm) * (distance_mm / depth_mm(view, xyz_mm))[:, None]


def in_field(view: FrameView, xyz_mm: np.ndarray) -> np.ndarray:
    """Return (N,) bool: whether points (N, 3) lie between source and intensifier, inside its field."""
    depth = depth_mm(view, xyz_mm)
    out = (depth > 0) & (depth < SOURCE_TO_DETECTOR_MM)
    on_detector = at_distance_mm(view, xyz_mm[out], SOURCE_TO_DETECTOR_MM)
    out[out] = np.linalg.norm(on_detector, axis=1) <= FIELD_DIAMETER_MM / 2
    return out
