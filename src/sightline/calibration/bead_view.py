"""A view calibrated from its beads, whatever the method."""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self

import numpy as np

from sightline.calibration.checks import handedness_check
from sightline.calibration.hull import Hull
from sightline.calibration.posterior import Posterior
from sightline.calibration.residuals import Residuals
from sightline.calibration.support import Support
from sightline.calibration.view import LinesOfSight, PlaneMap
from sightline.checks import Check
from sightline.errors import UnusableInputError
from sightline.frame import FrameView
from sightline.geometry.planes import Plane


@dataclass(frozen=True, eq=False)
class BeadView:
    """A `CalibratedView`: `plane_map` takes pixels to the reference plane `plane`.

    `residuals`: of every bead given; `hull`: of the beads used, in the image; `frame_key`: `Frame.fingerprint`;
    `frame_view`: the frame's beads of this view.
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
    frame_view: FrameView
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

    @cached_property
    def _support(self) -> Support:
        fiducials = self.frame_view.fiducials
        xyz = np.array([f.xyz_mm for f in fiducials], dtype=np.float64)
        places, seen = self.project_seen(xyz)
        # As wide as their diameter across the beam: the rim's image, as far from the centre's.
        rims, rim_seen = self.project_seen(xyz + np.outer([f.diameter_mm / 2 for f in fiducials], self.plane.axes[0]))
        both = seen & rim_seen
        radii = np.linalg.norm(rims[both[rim_seen]] - places[both[seen]], axis=1)
        used = {i for i, taken in zip(self.residuals.ids, self.residuals.used, strict=True) if taken}
        ids = [f.id for f, shown in zip(fiducials, both, strict=True) if shown]
        return Support.of(places[both[seen]], radii, np.array([i in used for i in ids], dtype=bool))

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
            beads_near=self._support.near(uv),
        )
