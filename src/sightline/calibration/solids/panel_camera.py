"""A flat panel as a pinhole camera with square pixels, with its derivatives by its parameters and by points."""

from dataclasses import dataclass, replace

import numpy as np

from sightline.calibration.matrix_view import HomographyMap
from sightline.common.geometry.planes import Plane
from sightline.common.geometry.rigid import cross_matrix

PARAMETERS = 9  # rotation vector of the camera (rad), translation (mm), log focal length, principal point (px)
FOCAL, CENTRE = 6, slice(7, 9)  # their places among the parameters


@dataclass(frozen=True)
class PanelPrior:
    """What is known of a panel before its image is calibrated, with standard deviations.

    `focal_px` and `focal_share`, relative; `centre_px` (u, v) and `centre_sd_px`, per axis. Of an intensifier all are
    mm on its plate.
    """

    focal_px: float
    focal_share: float
    centre_px: tuple[float, float]
    centre_sd_px: float


@dataclass(frozen=True, eq=False)
class PanelCamera:
    """u = centre + focal_px (m x / z, y / z) of a point (x, y, z) = `rotation` X + `translation_mm`, X in CFCS, mm.

    m is -1 for a mirrored image, else 1. Camera axes as in `exchange.Pinhole`: z from the source to the panel.
    """

    rotation: np.ndarray
    translation_mm: np.ndarray
    focal_px: float
    centre_px: np.ndarray
    mirrored: bool

    @property
    def focal_point_mm(self) -> np.ndarray:
        """(3,) the focal point, CFCS."""
        return -self.rotation.T @ self.translation_mm

    @property
    def _scale_px(self) -> np.ndarray:
        return self.focal_px * np.array([-1.0 if self.mirrored else 1.0, 1.0])

    @property
    def matrix(self) -> np.ndarray:
        """(3, 4): takes CFCS points (x, y, z, 1), mm, to pixels (u w, v w, w)."""
        inner = np.diag([*self._scale_px, 1.0])
        inner[:2, 2] = self.centre_px
        return inner @ np.column_stack([self.rotation, self.translation_mm])

    @staticmethod
    def orthographic(prior: PanelPrior, xyz_mm: np.ndarray, uv_px: np.ndarray, *, mirrored: bool) -> "PanelCamera":
        """Return the camera whose scaled orthography is nearest to images (N, 2) of points (N, 3), to begin with."""
        sign, centre = np.array([-1.0 if mirrored else 1.0, 1.0]), np.array(prior.centre_px)
        middle, at = xyz_mm.mean(axis=0), uv_px.mean(axis=0)
        affine = np.linalg.lstsq(xyz_mm - middle, sign * (uv_px - at), rcond=None)[0].T
        left, scales, right = np.linalg.svd(affine, full_matrices=False)
        rows = left @ right
        rotation = np.vstack([rows, np.cross(rows[0], rows[1])])
        at_mm = np.append(sign * (at - centre), prior.focal_px) / scales.mean()
        return PanelCamera(rotation, at_mm - rotation @ middle, prior.focal_px, centre, mirrored)

    def moved(self, step: np.ndarray) -> "PanelCamera":
        """Return the camera with its parameters changed by `step` (9,); the rotation acts in camera axes.

        The translation is changed to first order: the origin's pixel linearly and its depth in proportion, as the focal
        length is. A long step thus keeps the scale of the image, which a linear one would not.
        """
        from scipy.spatial.transform import Rotation  # here: views of plates do not need it, and it takes 6 MB

        grown, deeper = float(np.exp(step[FOCAL])), step[5] / self.translation_mm[2]
        across = self.translation_mm[:2] * (1.0 - deeper + step[FOCAL]) + step[3:5]
        depth = float(np.exp(deeper))
        return replace(
            self,
            rotation=Rotation.from_rotvec(step[:3]).as_matrix() @ self.rotation,
            translation_mm=np.append(across * depth / grown, self.translation_mm[2] * depth),
            focal_px=self.focal_px * grown,
            centre_px=self.centre_px + step[CENTRE],
        )

    def in_front(self, xyz_mm: np.ndarray) -> bool:
        """Whether all points (N, 3), CFCS, lie on the panel's side of the focal point."""
        return bool((xyz_mm @ self.rotation[2] + self.translation_mm[2] > 0).all())

    def shadows(self, xyz_mm: np.ndarray, radius_mm: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the centres (N, 2), px, of the shadows of balls at points (N, 3), with their derivatives by the
        parameters (N, 2, 9) and by the points (N, 2, 3).

        The shadow of a ball of radius r is an ellipse about (x z, y z) / (z² - r²), not about (x, y) / z.
        """
        turned = xyz_mm @ self.rotation.T
        x, y, z = (turned + self.translation_mm).T
        below = z**2 - radius_mm**2
        ratio = np.stack([x, y], axis=1) * (z / below)[:, None]
        by_camera = np.zeros((len(z), 2, 3))
        by_camera[:, 0, 0] = by_camera[:, 1, 1] = z / below
        by_camera[:, :, 2] = -np.stack([x, y], axis=1) * ((z**2 + radius_mm**2) / below**2)[:, None]
        by_camera *= self._scale_px[:, None]
        by_parameters = np.zeros((len(z), 2, PARAMETERS))
        by_parameters[:, :, :3] = by_camera @ -cross_matrix(turned)
        by_parameters[:, :, 3:6] = by_camera
        by_parameters[:, :, FOCAL] = self._scale_px * ratio
        by_parameters[:, 0, CENTRE.start] = by_parameters[:, 1, CENTRE.start + 1] = 1.0
        return self.centre_px + self._scale_px * ratio, by_parameters, by_camera @ self.rotation

    def plane_map(self, plane: Plane) -> HomographyMap:
        """Return the map between the image and a plane."""
        return HomographyMap.of(self.matrix, plane)

    def lines_by_parameters(self, plane: Plane, uv_px: np.ndarray) -> np.ndarray:
        """Return (3 + 2N, 9): derivative of the focal point and of where the lines of sight of pixels (N, 2) meet a
        fixed plane, by the parameters."""
        scale = self._scale_px
        at = (uv_px - self.centre_px) / scale
        ray = np.column_stack([at, np.ones(len(at))])
        ray_by = np.zeros((len(at), 3, PARAMETERS))
        ray_by[:, :, :3] = cross_matrix(ray)
        ray_by[:, :2, FOCAL] = -at
        ray_by[:, 0, CENTRE.start], ray_by[:, 1, CENTRE.start + 1] = -1.0 / scale
        ray, ray_by = ray @ self.rotation, self.rotation.T @ ray_by
        focal_by = np.zeros((3, PARAMETERS))
        focal_by[:, :3] = -self.rotation.T @ cross_matrix(self.translation_mm)
        focal_by[:, 3:6] = -self.rotation.T
        steep = ray @ plane.normal
        reach = -plane.height_mm(self.focal_point_mm) / steep
        moved = focal_by + reach[:, None, None] * ray_by
        along = ray / steep[:, None]
        moved = moved - along[:, :, None] * (plane.normal @ moved)[:, None, :]
        return np.vstack([focal_by, (plane.axes @ moved).reshape(-1, PARAMETERS)])
