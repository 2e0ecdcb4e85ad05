"""A view calibrated from its beads, whatever the method."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self

import numpy as np

from sightline.calibration.checks import handedness_check
from sightline.calibration.focal_length import CArm, FocalLength, steady_check
from sightline.calibration.hull import Hull
from sightline.calibration.joint import JointFit
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
    `joint`: the smooth fit of both plates, by which beads were judged; None where they are too few for it.
    `image_shape` (H, W) where it is known. `rejected_px` (M, 2): what was detected in the image and not labelled; None
    where nobody knows. `c_arm`: what was said of the C-arm.
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
    joint: JointFit | None = None
    image_shape: tuple[int, int] | None = None
    rejected_px: np.ndarray | None = None
    mirrored_display: bool | None = None
    c_arm: CArm | None = None

    def __post_init__(self) -> None:
        self.focal_point_mm.flags.writeable = False

    @property
    def upright(self) -> bool:
        """Whether the image shows the beads as the frame file has them, on the display that a person described."""
        return self.mirrored == bool(self.mirrored_display)

    def said_to_be(self, mirrored_display: bool | None) -> Self:
        """The view, once a person saw whether the display is mirrored, with a check of it; None where nobody looked."""
        if mirrored_display is None:
            return self
        told = replace(self, mirrored_display=mirrored_display)
        return replace(told, checks=(*told.checks, handedness_check(told.upright, mirrored_display)))

    @cached_property
    def focal_length(self) -> FocalLength | None:
        """At the image's middle, or at that of the beads where the image is not known or its middle lies outside them;
        None where the beads are too few for the smooth fit."""
        if self.joint is None:
            return None
        if self.image_shape is not None:
            middle = (np.array(self.image_shape[::-1], dtype=np.float64) - 1.0) / 2.0
            if self.hull.contains(middle[None])[0]:
                return FocalLength.of(self.joint, middle)
        return FocalLength.of(self.joint, self.joint.beads.uv_px.mean(axis=0))

    def taken_by(self, c_arm: CArm) -> Self:
        """The view with the checks of what is known of its C-arm."""
        told = [] if self.focal_length is None else c_arm.checks(self.focal_length)
        return replace(self, c_arm=c_arm, checks=(*self.checks, *told))

    def steady_since(self, before: Sequence["BeadView"]) -> Self:
        """The view with a check against earlier images of the same view, frame and size by the same C-arm, if it has a
        flat panel: an intensifier's own magnification changes by more than flex does."""
        if self.focal_length is None or not self.focal_length.is_of_a_panel:
            return self
        alike = (
            one.focal_length
            for one in before
            if (one.name, one.frame_key, one.image_shape) == (self.name, self.frame_key, self.image_shape)
        )
        known = [length for length in alike if length is not None]
        return replace(self, checks=(*self.checks, steady_check(self.focal_length, known))) if known else self

    def checked(self, checks: Iterable[Check]) -> Self:
        """The view with checks of its image before its own."""
        return replace(self, checks=(*checks, *self.checks))

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
        known = np.array([i in used for i in ids], dtype=bool)
        # A bead that was left out as wrong was seen, and stands where no bead should be.
        wrong = self.residuals.uv_px[~self.residuals.used]
        stray = None if self.rejected_px is None else np.concatenate([self.rejected_px, wrong])
        return Support.of(places[both[seen]], radii, known, stray)

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
            upright=self.upright,
            beads_near=self._support.near(uv),
        )
