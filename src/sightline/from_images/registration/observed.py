"""What a view shows of a bone, at one resolution: attenuation, its weights, and the rays of its pixels."""

from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np

from sightline.calibration import CalibratedView
from sightline.calibration.bead_view import BeadView, bead_shadows_px
from sightline.detection import detect
from sightline.errors import DetectionRefusedError
from sightline.from_images.registration.cast import RayBundle
from sightline.imaging import Radiograph

_BEAD_RIM_PX = 3.0  # [ours] beyond a bead's edge, for blur
_LEAST_SHARE = 0.5  # [ours] of a pooled pixel's area that must be usable
_DARKEST = 1e-3  # of white [ours]: darker pixels count as this


@dataclass(frozen=True, eq=False)
class Observed:
    """An image of `view` pooled to (H, W) pixels of `factor` x `factor`.

    `attenuation`: negative logarithm of the light over white; `usable` (H, W) bool: inside the field, away from beads
    and writing.
    """

    view: CalibratedView
    attenuation: np.ndarray
    usable: np.ndarray
    factor: int
    corner_px: np.ndarray

    @cached_property
    def calibrated(self) -> np.ndarray:
        """(H, W) bool: where the view knows its lines of sight."""
        near = self.view.hull.is_near(self._uv_px) if isinstance(self.view, BeadView) else True
        return np.broadcast_to(near, len(self._uv_px)).reshape(self.attenuation.shape)

    @cached_property
    def known(self) -> np.ndarray:
        """(H, W) bool: usable and calibrated."""
        return self.usable & self.calibrated

    @cached_property
    def rays(self) -> RayBundle:
        """The rays of the pooled pixels, row by row; where none is calibrated, any other."""
        near = self.calibrated.ravel()
        lines = self.view.lines_of_sight(self._uv_px[near])
        along = np.tile(lines.directions[:1], (len(near), 1))
        along[near] = lines.directions
        return RayBundle(self.view.focal_point_mm, along)

    @cached_property
    def _uv_px(self) -> np.ndarray:
        rows, columns = np.indices(self.attenuation.shape)
        return np.stack([columns.ravel(), rows.ravel()], axis=1) * self.factor + (self.factor - 1) / 2 + self.corner_px

    def around(self, xyz_mm: np.ndarray, margin: int = 4) -> "Observed":
        """Return the part around the images of points (N, 3), CFCS, with a margin in pooled pixels; the whole image if
        the view does not show all points."""
        uv, seen = self.view.project_seen(xyz_mm)
        if not seen.all():
            return self
        uv = (uv - self.corner_px) / self.factor
        shape = np.array(self.attenuation.shape[::-1])
        low = np.clip(np.floor(uv.min(axis=0)).astype(int) - margin, 0, shape - 2)
        high = np.clip(np.ceil(uv.max(axis=0)).astype(int) + margin + 1, low + 2, shape)
        part = slice(low[1], high[1]), slice(low[0], high[0])
        return replace(
            self,
            attenuation=self.attenuation[part],
            usable=self.usable[part],
            corner_px=self.corner_px + low * self.factor,
        )

    def mm_per_px(self, xyz_mm: np.ndarray) -> float:
        """Return the size of a pooled pixel in the middle of the image, at the depth of a point (3,), CFCS."""
        lines = self.view.lines_of_sight(self._uv_px[self.calibrated.ravel()].mean(axis=0)[None])
        focal = lines.focal_point_mm
        share = np.linalg.norm(xyz_mm - focal) / np.linalg.norm(lines.points_mm[0] - focal)
        return float(self.factor * share * np.sqrt(np.abs(np.linalg.det(lines.jacobian[0]))))

    def at(self, xyz_mm: np.ndarray) -> np.ndarray:
        """Return the column and row (M, 2) of the pooled pixels that show points (N, 3), CFCS."""
        at = self.pooled_px(self.view.project_seen(xyz_mm)[0])
        inside = ((at >= 0) & (at < np.array(self.attenuation.shape[::-1]))).all(axis=1)
        return at[inside]

    def pooled_px(self, uv_px: np.ndarray) -> np.ndarray:
        """Return the column and row (N, 2), int, of the pooled pixels that hold pixels (N, 2)."""
        return np.rint((uv_px - self.corner_px - (self.factor - 1) / 2) / self.factor).astype(int)


@dataclass(frozen=True, eq=False)
class BoneShot:
    """An image and its view."""

    image: Radiograph
    view: CalibratedView

    @cached_property
    def mask(self) -> np.ndarray:
        """(H, W) uint8, 1 where the image shows neither bead, nor writing, nor the surround."""
        mask = self.image.field_mask.astype(np.uint8)
        if self.image.burnt_in is not None:
            mask[self.image.burnt_in] = 0
        for u, v, radius in _beads(self.image, self.view):
            cv2.circle(mask, (round(u), round(v)), int(np.ceil(radius + _BEAD_RIM_PX)), 0, -1)
        return mask

    @cached_property
    def middle_px(self) -> np.ndarray:
        """(2,) u and v of the field's middle."""
        return np.argwhere(self.image.field_mask).mean(axis=0)[::-1]

    def share_seen(self, xyz_mm: np.ndarray) -> float:
        """Return the share of points (N, 3), CFCS, that the field shows."""
        at = np.rint(self.view.project_seen(xyz_mm)[0]).astype(int)
        at = at[((at >= 0) & (at < np.array(self.image.shape[::-1]))).all(axis=1)]
        return float(self.image.field_mask[at[:, 1], at[:, 0]].sum()) / len(xyz_mm)

    def pooled(self, size: int) -> Observed:
        """Return the image with at most `size` pixels along its longer side, in whole multiples of its own."""
        if size not in self._levels:
            self._levels[size] = self._pooled(size)
        return self._levels[size]

    @cached_property
    def _levels(self) -> dict[int, Observed]:
        return {}

    def _pooled(self, size: int) -> Observed:
        pixels = self.image.pixels
        factor = max(int(np.ceil(max(pixels.shape) / size)), 1)
        h, w = (side // factor for side in pixels.shape)
        parts = [
            array[: h * factor, : w * factor].astype(np.float32).reshape(h, factor, w, factor)
            for array in (pixels * self.mask, self.mask)
        ]
        light, known = (part.sum(axis=(1, 3)) for part in parts)
        mean = light / np.maximum(known, 1) / np.float32(self.image.white)
        return Observed(
            self.view,
            -np.log(np.maximum(mean, _DARKEST)).astype(np.float64),
            known >= _LEAST_SHARE * factor**2,
            factor,
            np.zeros(2),
        )


def _beads(image: Radiograph, view: CalibratedView) -> np.ndarray:
    """Return centre and radius (N, 3) of the frame's balls, seen or not; without a frame of all that looks like one."""
    if isinstance(view, BeadView):
        return bead_shadows_px(view)
    try:
        found = detect(image)
    except DetectionRefusedError:
        return np.zeros((0, 3))
    return np.column_stack([found.uv_px, found.radius_px])
