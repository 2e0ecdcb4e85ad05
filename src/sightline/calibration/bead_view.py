"""A view calibrated from its beads, by any method."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from sightline.calibration.bead_checks import MIN_STRIP, Support, handedness_check, strip_check
from sightline.calibration.lengths import (
    BallSize,
    CArm,
    FocalLength,
    ball_size_check,
    pixel_solid_angle,
    steady_check,
)
from sightline.calibration.maps.hull import Hull
from sightline.calibration.maps.polynomial import Affine
from sightline.calibration.plates.classical import PlateName
from sightline.calibration.plates.joint import JointFit
from sightline.calibration.view import (
    CalibratedView,
    Deferred,
    LinesOfSight,
    PlaneMap,
    Posterior,
    Residuals,
    finite_pixels,
)
from sightline.common.checks import Check
from sightline.common.geometry.planes import Plane
from sightline.common.show import Plotted, checks_lines, counted, dataframe, numbers
from sightline.detection.results import Observations
from sightline.frame import Fiducial, Frame

if TYPE_CHECKING:
    from pandas import DataFrame

SOLID = "solid"  # the method of views of a solid
_MAX_FAILED = 3  # checks that a summary names


@dataclass(frozen=True, eq=False)
class CalibrationInputs:
    """Arguments of `calibrate` that the view itself does not state; `degree` and `plate` as there."""

    observations: Observations
    frame: Frame
    degree: int = 3
    plate: PlateName = "xrii"


@dataclass(frozen=True, eq=False, repr=False)
class BeadView(Plotted):
    """A `CalibratedView`: `plane_map` takes pixels to the reference plane `plane`.

    `residuals`: of every bead given; `hull`: convex hull of the beads used, in the image; `frame_key`:
    `Frame.fingerprint`; `fiducials`: the frame's of this view. `joint`: the smooth fit of both plates, by which
    wrong beads were found; None with too few beads for it. `image_shape` (H, W), None where unknown. `rejected_px`
    (M, 2): detections that were not labelled; None where unknown. `c_arm`: the known dimensions of the C-arm.
    `mirrored`: whether the image shows the frame file's beads as their mirror image; `mirrored_display`: whether a
    person saw that the display is mirrored, None where nobody was asked. `inputs`: what the view was calibrated from,
    None where it was made otherwise. `adjustment`: names the adjustment of several views that this one comes from;
    None where it was calibrated by itself.
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
    fiducials: tuple[Fiducial, ...]
    posterior: Posterior
    joint: JointFit | None = None
    image_shape: tuple[int, int] | None = None
    rejected_px: np.ndarray | None = None
    mirrored_display: bool | None = None
    c_arm: CArm | None = None
    inputs: CalibrationInputs | None = None
    adjustment: str | None = None

    def __post_init__(self) -> None:
        self.focal_point_mm.flags.writeable = False

    def summary(self) -> str:
        """Return the focal point with its error, the residuals, and the checks that failed."""
        left, left_out = self.residuals, self.residuals.left_out
        focal = f"{numbers(self.focal_point_mm, 1)} mm, s.d. {numbers(self.focal_point_sd_mm, 1)} mm"
        named = f" ({', '.join(left_out[:4])}{', ...' if len(left_out) > 4 else ''})" if left_out else ""
        return "\n".join(
            [
                f"View {self.name} of frame {self.frame_key.partition('#')[0].rstrip('/')}, method {self.method}",
                f"  focal point {focal}, CFCS",
                f"  {counted(int(left.used.sum()), 'bead')} used, {len(left_out)} left out{named}",
                f"  residual {left.rms_mm:.3f} mm rms per axis, leave-one-out {left.leave_one_out_rms_mm:.3f} mm",
                *(["  the image is a mirror image of the frame"] if self.mirrored else []),
                *checks_lines(self.checks, _MAX_FAILED),
            ]
        )

    def to_dataframe(self) -> "DataFrame":
        """Return a row for each bead: id, u_px, v_px, residual and leave-one-out error in mm, used. Needs pandas."""
        left = self.residuals
        predicted = np.where(left.predicted[:, None], left.leave_one_out_mm, np.nan)
        return dataframe(
            {
                "id": left.ids,
                **{name: left.uv_px[:, k] for k, name in enumerate(("u_px", "v_px"))},
                **{name: left.residual_mm[:, k] for k, name in enumerate(("residual_x_mm", "residual_y_mm"))},
                **{name: predicted[:, k] for k, name in enumerate(("leave_one_out_x_mm", "leave_one_out_y_mm"))},
                "used": left.used,
            }
        )

    def _draw(self, ax: Any) -> None:
        """Draw the residuals as arrows, carried into the image by the affine map that is nearest to the view's own."""
        from sightline.common import draw

        left = self.residuals
        by_px = self._mm_per_px()
        moved_px = np.linalg.solve(by_px, left.residual_mm.T).T
        mm_px = float(np.sqrt(np.abs(np.linalg.det(by_px))))
        draw.image(ax, self.pixels, self.image_shape, left.uv_px, "")
        draw.marks(ax, left.uv_px[left.used], ".", draw.ORANGE, f"used ({left.used.sum()})")
        draw.marks(ax, left.uv_px[~left.used], "x", draw.RED, f"left out ({(~left.used).sum()})")
        times = draw.arrows(ax, left.uv_px[left.used], moved_px[left.used], mm_px, draw.BLUE)
        ax.set_title(f"view {self.name}: residuals, {times:g} times as large", loc="left", fontsize="medium")
        draw.legend(ax)

    def _mm_per_px(self) -> np.ndarray:
        """Return the Jacobian (2, 2) of the best affine map; a localized map is not defined at each bead."""
        places = {f.id: f.xyz_mm for f in self.fiducials}
        xyz = np.array([places[name] for name in self.residuals.ids])
        shadows = self.plane.central_projection(self.focal_point_mm, xyz)
        affine, radius_mm = Affine.fit(self.residuals.uv_px, shadows)
        return radius_mm * affine.matrix

    @property
    def pixels(self) -> np.ndarray | None:
        """(H, W) the image; None where it is not known."""
        return None if self.inputs is None else self.inputs.observations.pixels

    @property
    def focal_point_sd_mm(self) -> np.ndarray:
        """(3,) standard deviations of the focal point's coordinates."""
        middle = self.residuals.uv_px[self.residuals.used].mean(axis=0)
        errors = self.posterior.line_errors(middle[None]).by_source()
        return np.sqrt(np.sum([np.diag(covariance)[:3] for covariance in errors.values()], axis=0))

    @property
    def upright(self) -> bool:
        """Whether the image shows the beads as the frame file has them, given the display that a person described."""
        return self.mirrored == bool(self.mirrored_display)

    def said_to_be(self, mirrored_display: bool | None) -> Self:
        """Return the view with what a person saw of the display, and its check; unchanged for None (nobody looked)."""
        if mirrored_display is None:
            return self
        view = replace(self, mirrored_display=mirrored_display)
        return replace(view, checks=(*view.checks, handedness_check(view.upright, mirrored_display)))

    @cached_property
    def focal_length(self) -> FocalLength | None:
        """The focal length at the image's middle; None with too few beads for the smooth fit.

        At the beads' mean where the image's size is unknown or its middle lies outside their convex hull.
        """
        if self.joint is None:
            return None
        if self.image_shape is not None:
            middle = (np.array(self.image_shape[::-1], dtype=np.float64) - 1.0) / 2.0
            if self.hull.contains(middle[None])[0]:
                return FocalLength.of(self.joint, middle)
        return FocalLength.of(self.joint, self.joint.beads.uv_px.mean(axis=0))

    @cached_property
    def ball_size(self) -> BallSize | None:
        """How large the used balls look; None where their radii were not measured, or too few are used."""
        seen, fit = None if self.inputs is None else self.inputs.observations, self.joint
        if seen is None or seen.radius_px is None or (fit is None and self.method != SOLID):
            return None
        radius_px = dict(zip(seen.ids, seen.radius_px.tolist(), strict=True))
        known, used = {one.id: one for one in self.fiducials}, self.residuals.used
        shown = [known[i] for i, taken in zip(self.residuals.ids, used, strict=True) if taken]
        plane_map, plane, focal = (
            (self.plane_map, self.plane, self.focal_point_mm)
            if fit is None
            else (fit.map, fit.beads.plane, fit.pencil.focal_point_mm)
        )
        distance = np.linalg.norm(np.array([one.xyz_mm for one in shown]) - focal, axis=1)
        angle = pixel_solid_angle(plane_map, plane, focal, self.residuals.uv_px[used])
        return BallSize.of(np.array([radius_px[one.id] for one in shown]), np.sqrt(angle) * distance, shown)

    def with_balls_measured(self) -> Self:
        """Return the view with the check of its balls' size, where it can be made."""
        if self.ball_size is None:
            return self
        return replace(self, checks=(*self.checks, ball_size_check([self.ball_size])))

    def taken_by(self, c_arm: CArm) -> Self:
        """Return the view with the checks against the C-arm's known dimensions."""
        added = [] if self.focal_length is None else c_arm.checks(self.focal_length)
        return replace(self, c_arm=c_arm, checks=(*self.checks, *added))

    def steady_since(self, before: Sequence["BeadView"]) -> Self:
        """Return the view with a check against earlier images of the same view, frame and size by the same C-arm.

        Flat panels only: an intensifier's own magnification changes by more than the C-arm's flex does.
        """
        if self.focal_length is None or not self.focal_length.is_of_a_panel:
            return self
        comparable = (
            view.focal_length
            for view in before
            if (view.name, view.frame_key, view.image_shape) == (self.name, self.frame_key, self.image_shape)
        )
        known = [length for length in comparable if length is not None]
        return replace(self, checks=(*self.checks, steady_check(self.focal_length, known))) if known else self

    def with_strip_sought(self) -> Self:
        """Return the view with its check of the rows failed where labelling dropped a strip of shifted rows."""
        if self.rejected_px is None or len(self.rejected_px) < MIN_STRIP:
            return self
        shift_px = self._support.strip_shift_px()
        if shift_px is None:
            return self
        torn = strip_check(shift_px)
        return replace(self, checks=(*(check for check in self.checks if check.name != torn.name), torn))

    def checked(self, checks: Iterable[Check]) -> Self:
        """Return the view with `checks` of its image put before its own."""
        return replace(self, checks=(*checks, *self.checks))

    def project(self, xyz_mm: np.ndarray) -> np.ndarray:
        """Return the pixels (N, 2) of points (N, 3), CFCS. Raises OutsideRegionError."""
        xyz = np.asarray(xyz_mm, dtype=np.float64)
        uv = self.plane_map.to_image(self.plane.central_projection(self.focal_point_mm, xyz))
        self.hull.refuse_far(uv, self.name)  # the same region as that of `lines_of_sight`
        return uv

    def project_seen(self, xyz_mm: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the pixels (M, 2) of the points (N, 3), CFCS, that `project` accepts, and which, (N,) bool."""
        xy, seen = self.plane.shadows(self.focal_point_mm, xyz_mm)
        uv, mapped = self.plane_map.find_image(xy)
        seen[seen] = mapped
        near = self.hull.is_near(uv)
        seen[seen] = near
        return uv[near], seen

    @cached_property
    def shadows_px(self) -> dict[str, tuple[float, float, float]]:
        """Centre (u, v) and radius of the shadow of each of the frame's beads that the view projects, by id."""
        fiducials = self.fiducials
        xyz = np.array([f.xyz_mm for f in fiducials], dtype=np.float64)
        places, seen = self.project_seen(xyz)
        # Radius of each shadow: distance between the images of a rim point and of the centre.
        rims, rim_seen = self.project_seen(xyz + np.outer([f.diameter_mm / 2 for f in fiducials], self.plane.axes[0]))
        both = seen & rim_seen
        centres = places[both[seen]]
        radii = np.linalg.norm(rims[both[rim_seen]] - centres, axis=1)
        shown = [f.id for f, is_shown in zip(fiducials, both, strict=True) if is_shown]
        return {i: (u, v, r) for i, (u, v), r in zip(shown, centres.tolist(), radii.tolist(), strict=True)}

    @cached_property
    def _support(self) -> Support:
        used = {i for i, taken in zip(self.residuals.ids, self.residuals.used, strict=True) if taken}
        known = np.array([i in used for i in self.shadows_px], dtype=bool)
        discs = np.array(list(self.shadows_px.values())).reshape(-1, 3)
        # A bead left out as wrong was detected where no bead should be.
        wrong = self.residuals.uv_px[~self.residuals.used]
        stray = None if self.rejected_px is None else np.concatenate([self.rejected_px, wrong])
        return Support.of(discs[:, :2], discs[:, 2], known, stray)

    def lines_of_sight(self, uv_px: np.ndarray) -> LinesOfSight:
        """Return the lines of sight of pixels (N, 2). Raises OutsideRegionError, UnusableInputError."""
        uv = finite_pixels(uv_px)
        self.hull.refuse_far(uv, self.name)
        errors = cache(lambda: self.posterior.line_errors(uv))
        xy, jacobian = self.plane_map.linearised(uv)
        return LinesOfSight(
            view=self.name,
            plane=self.plane,
            focal_point_mm=self.focal_point_mm,
            xy_mm=xy,
            jacobian=jacobian,
            covariance=Deferred(lambda: errors().by_source()),
            shared=Deferred(lambda: errors().shared()),
            frame_key=self.frame_key,
            inside_hull=self.hull.contains(uv),
            upright=self.upright,
            count_beads=None if self.method == SOLID else lambda: self._support.near(uv),  # a solid's map is not local
            adjustment=self.adjustment,
        )


def bead_shadows_px(view: CalibratedView) -> np.ndarray:
    """Return centre (u, v) and radius (K, 3) of the shadows of the frame's beads; none for a view without beads."""
    return np.array(list(view.shadows_px.values()) if isinstance(view, BeadView) else []).reshape(-1, 3)
