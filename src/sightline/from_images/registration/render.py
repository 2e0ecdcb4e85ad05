"""The radiograph that a calibrated view would see of a CT: monoenergetic, without scatter, noise or blur."""

from typing import TYPE_CHECKING

import numpy as np
from scipy.ndimage import map_coordinates

from sightline.calibration import BeadView, CalibratedView
from sightline.calibration.maps.localized import LocalizedMap
from sightline.common.bounded import MAX_PIXELS
from sightline.errors import OutsideRegionError, UnusableInputError
from sightline.imaging import Radiograph
from sightline.imaging.volumes.ct import AIR_HU, WATER_PER_CM, CtScan
from sightline.imaging.volumes.rays import Rays, volume_integral

if TYPE_CHECKING:
    from scipy.spatial.transform import RigidTransform

OPEN_BEAM = 65535  # [ours] white: in 12 bits a pelvis seen from the side would have two grey levels
# Lines of sight are interpolated between; they are off by less than 0.01 px, across triangles of the localized method
# by 0.05 px [measured].
GRID_PX = 4
_PER_MM = WATER_PER_CM / 10 / 1000  # attenuation of one unit of a CT number at 60 keV


def render(
    volume: CtScan, view: CalibratedView, pose: "RigidTransform | None" = None, shape: tuple[int, int] | None = None
) -> Radiograph:
    """Return the radiograph that a view would see of a CT, or of a mesh filled by `volumes.filled`.

    Pixels are 65535 exp(-∫µ) along the line of sight of each pixel's centre, with µ = µ_water (1 + HU/1000) at 60 keV,
    0 where the view is not calibrated. `pose`: takes the volume's coordinates, mm, to CFCS; None: they are the view's.
    `shape`: height and width, px; None: those of the view's image, which a matrix does not state. The source is the
    view's focal point, on the side of it where the volume lies.
    Raises UnusableInputError, and OutsideRegionError if the view does not show the volume.

    >>> from sightline.imaging.volumes import CtScan
    >>> water = CtScan(np.zeros((61, 61, 41), np.int16), np.array([-30, -30, -20]), np.ones(3), np.eye(3))
    >>> P = np.array([[3000.0, 0, 256, 256 * 600], [0, 3000, 256, 256 * 600], [0, 0, 1, 600]])
    >>> int(sl.render(water, sl.view_from_matrix(P), shape=(512, 512)).pixels[256, 256])  # exp(-0.0206 / mm * 40 mm)
    28749
    """
    size = view.image_shape if shape is None and isinstance(view, BeadView) else shape
    if size is None:
        raise UnusableInputError(f"view {view.name} does not state the size of its image; give the shape in pixels")
    if min(size) < 1 or size[0] * size[1] > MAX_PIXELS:
        raise UnusableInputError(f"an image of {size[1]} x {size[0]} pixels cannot be made; the limit is {MAX_PIXELS}")
    rays = _rays_through(volume, view, pose, size)
    above_air = np.maximum(volume.hu, AIR_HU)
    above_air -= AIR_HU
    integral = volume_integral(rays, above_air, volume.origin_mm @ volume.axes.T, volume.voxel_mm)
    if not integral.any():
        raise OutsideRegionError(f"view {view.name} does not show the volume; check its pose and the image's size")
    light = np.rint(OPEN_BEAM * np.exp(-_PER_MM * integral))
    return Radiograph(np.where(rays.inside, light, 0).astype(np.uint16), float(OPEN_BEAM))


def _rays_through(volume: CtScan, view: CalibratedView, pose: "RigidTransform | None", shape: tuple[int, int]) -> Rays:
    """Return the ray of each pixel's centre from the source to behind the volume, along the volume's own axes, mm."""
    xyz, seen = _on_plane(view, shape)
    focal = view.focal_point_mm
    if pose is not None:
        back = pose.inv()
        focal, xyz = back.apply(focal), back.apply(xyz.reshape(-1, 3)).reshape(xyz.shape)
    corners = (
        volume.origin_mm
        + (volume.voxel_mm * np.indices((2, 2, 2)).reshape(3, -1).T * (np.array(volume.hu.shape) - 1)) @ volume.axes
    )
    towards = xyz - focal
    towards /= np.linalg.norm(towards, axis=-1, keepdims=True)
    ahead = np.sign((corners.mean(axis=0) - focal) @ towards[seen].sum(axis=0))
    reach = ahead * np.linalg.norm(corners - focal, axis=1).max()
    return Rays(focal @ volume.axes.T, (focal + reach * towards) @ volume.axes.T, seen)


def _on_plane(view: CalibratedView, shape: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Return where the lines of sight of all pixels meet the view's reference plane, (H, W, 3) CFCS, and which are
    calibrated, (H, W) bool."""
    grid = np.stack(
        np.meshgrid(*(np.arange(0, side - 1 + GRID_PX, GRID_PX) for side in shape), indexing="ij")[::-1], -1
    )
    uv = grid.reshape(-1, 2).astype(np.float64)
    near = _calibrated(view, uv)
    lines = view.lines_of_sight(uv[near])
    known = np.zeros((len(uv), 3))
    known[near] = np.column_stack([lines.xy_mm, np.ones(len(lines.xy_mm))])
    at = np.indices(shape) / GRID_PX
    x, y, share = (
        map_coordinates(values, at, order=1) for values in known.reshape(*grid.shape[:2], 3).transpose(2, 0, 1)
    )
    return lines.plane.to_space(np.stack([x, y], axis=-1)), share > 1 - 1e-9


def _calibrated(view: CalibratedView, uv_px: np.ndarray) -> np.ndarray:
    """Return which pixels (N, 2) have a line of sight, (N,) bool; of a matrix, all."""
    if not isinstance(view, BeadView):
        return np.ones(len(uv_px), dtype=bool)
    near = view.hull.is_near(uv_px)
    if isinstance(view.plane_map, LocalizedMap):  # which does not extrapolate
        near &= view.plane_map.containing_triangle(uv_px) >= 0
    return near
