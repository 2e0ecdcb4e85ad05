"""A view calibrated from its beads, whatever the method."""

from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from sightline.calibration.checks import handedness_check
from sightline.calibration.hull import Hull
from sightline.calibration.posterior import Posterior
from sightline.calibration.residuals import Residuals
from sightline.calibration.view import LinesOfSight, PlaneMap
from sightline.checks import Check
from sightline.errors import UnusableInputError
from sightline.geometry.planes import Plane


@dataclass(frozen=True, eq=False)
class BeadView:
    """A `CalibratedView`: `plane_map` takes pixels to the reference plane `plane`.

    `residuals`: of every bead given; `hull`: of the beads used, in the image; `frame_key`: `Frame.fingerprint`.
    `mirrored`: the image shows the frame file's beads as their mirror image; `mirrored_display`: what a person said of
    the display, None where nobody was asked.
    """

    name: str
    method: str
    plane: Plane
    plane_map: PlaneMap
    focal_point_mm: np.ndarray
    residuals: Residuals
    mirrored: bool
    hull: Hull
    checks: tuple[Check, ...]
    frame_key: str
    posterior: Posterior
    mirrored_display: bool | None = None

    def __post_init__(self) -> None:
        self.focal_point_mm.flags.writeable = False

    def said_to_be(self, mirrored_display: bool) -> Self:
        """The view, once a person saw whether the display is mirrored, with a check of it."""
        check = handedness_check(self.mirrored, mirrored_display)
        return replace(self, mirrored_display=mirrored_display, checks=(*self.checks, check))

    def project(self, xyz_mm: np.ndarray) -> np.ndarray:
        """Points (N, 3) CFCS to pixels (N, 2). Raises OutsideRegionError."""
        xyz = np.asarray(xyz_mm, dtype=np.float64)
        uv = self.plane_map.to_image(self.plane.central_projection(self.focal_point_mm, xyz))
        self.hull.refuse_far(uv)  # where no line of sight is given either
        return uv

    def project_seen(self, xyz_mm: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Pixels (M, 2) of those of the points (N, 3) CFCS that `project` takes, and which these are, (N,) bool."""
        xy, seen = self.plane.shadows(self.focal_point_mm, xyz_mm)
        uv, found = self.plane_map.find_image(xy)
        seen[seen] = found
        near = self.hull.is_near(uv)
        seen[seen] = near
        return uv[near], seen

    def lines_of_sight(self, uv_px: np.ndarray) -> LinesOfSight:
        """Lines of sight of pixels (N, 2). Raises OutsideRegionError, UnusableInputError."""
        uv = np.asarray(uv_px, dtype=np.float64)
        if uv.ndim != 2 or uv.shape[1] != 2 or not np.isfinite(uv).all():
            raise UnusableInputError(f"pixels must be finite and of the shape (N, 2); got the shape {uv.shape}")
        self.hull.refuse_far(uv)
        errors = self.posterior.line_errors(uv)
        xy, jacobian = self.plane_map.linearised(uv)
        return LinesOfSight(
            view=self.name,
            plane=self.plane,
            focal_point_mm=self.focal_point_mm,
            xy_mm=xy,
            jacobian=jacobian,
            covariance=errors.by_source(),
            frame_factor=errors.frame_factor,
            frame_key=self.frame_key,
            inside_hull=self.hull.contains(uv),
            upright=self.mirrored == bool(self.mirrored_display),
        )
