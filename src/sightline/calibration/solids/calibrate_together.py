"""Calibration of all views of a solid together, whose images share the errors of its balls.

On flat panels the solid suffices; on image intensifiers a plate on the detector shows the distortion.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from hashlib import sha256
from pathlib import Path

import numpy as np
from scipy.special import chdtri

from sightline.calibration.bead_checks import (
    beyond_misfit,
    chi_square_check,
    count_check,
    leave_one_out_check,
    tolerance_checks,
    wrong_beads_check,
)
from sightline.calibration.bead_view import SOLID, BeadView, CalibrationInputs
from sightline.calibration.lengths import CArm
from sightline.calibration.maps.hull import well_conditioned
from sightline.calibration.plates.beads import at_centres
from sightline.calibration.plates.joint import MAX_WRONG_SHARE
from sightline.calibration.solids.adjustment import (
    SolidAdjustment,
    adjust,
    first_camera,
    image_of,
    noise_px2,
    rows_of,
    solid_of,
)
from sightline.calibration.solids.images import MIN_BALLS, DetectorPlateImage, SolidBalls, SolidImage
from sightline.calibration.solids.panel_camera import CENTRE, FOCAL, PanelCamera
from sightline.calibration.view import CalibratedView, Residuals
from sightline.common.checks import FALSE_ALARM, Check, at_most
from sightline.common.fitting import variance_ratio
from sightline.common.geometry.covariance import TWO_SIDED_999
from sightline.common.geometry.planes import Plane
from sightline.common.threads import one_blas_thread
from sightline.detection.results import Observations
from sightline.errors import CalibrationRefusedError, ObservationsError, UnusableInputError
from sightline.frame import Frame

# Smallest range of the pixel's size over a plate, beyond that of a tilt: intensifiers have 6 to 18 % over their field,
# flat panels 0.3 % by their noise [measured on the twin].
MIN_DISTORTION = 0.01


def checks_of_image(fit: SolidAdjustment, image: int, c_arm: CArm | None) -> list[Check]:
    """Return the checks of one image: its balls, that its kind is that of the frame, and what is known of the C-arm."""
    own = fit.images[image]
    needed = f"balls of the solid are used; {MIN_BALLS} are needed, 9 or more are good"
    count = count_check(int((own.rows < fit.solid.count).sum()), MIN_BALLS, needed, "")
    return [count, *checks_of_camera(fit, [image], c_arm)]


def checks_of_camera(fit: SolidAdjustment, images: Sequence[int], c_arm: CArm | None) -> list[Check]:
    """Return the checks of the camera of images: that its kind is that of the frame, and what is known of the C-arm."""
    first = fit.images[images[0]]
    kind = _is_distorted(first) if isinstance(first, DetectorPlateImage) else _distortion(fit, images)
    return [kind, *_panel_checks(fit, images[0], c_arm)]


def _distortion(fit: SolidAdjustment, images: Sequence[int]) -> Check:
    """Return the check that images of one camera have no pincushion distortion: that they are a flat panel's."""
    direction = np.zeros(len(fit.residual))
    for image in images:
        own, camera = fit.images[image], fit.cameras[image]
        off = own.uv_px - camera.centre_px
        cubic = off * (off**2).sum(axis=1, keepdims=True) / camera.focal_px**2
        direction[fit.rows_of(image)] = (own.whiten @ cubic[..., None]).ravel()
    sigma, limit = abs(float(fit.score(direction))), float(np.sqrt(chdtri(1, FALSE_ALARM)))
    sigma = beyond_misfit(sigma, fit.chi_square, fit.freedom)
    sentence = (
        "The image shows no distortion, as a flat panel's."
        if sigma <= limit
        else "The image is distorted, as an image intensifier's: a solid alone calibrates flat panels only. Use a "
        "plate on the detector besides (+detector-plate) or a frame with plates."
    )
    return Check("panel distortion", sigma <= limit, sigma, limit, "σ", sentence)


def _is_distorted(image: DetectorPlateImage) -> Check:
    """Return the check that the plate's balls show the distortion of an intensifier."""
    uv = image.uv_px[image.on_plate]
    xy, slopes = image.start.linearised(uv)
    size = np.log(np.abs(np.linalg.det(slopes))) / 2
    tilt = np.column_stack([np.ones(len(xy)), xy])
    spread = float(np.ptp(size - tilt @ np.linalg.lstsq(tilt, size, rcond=None)[0]))
    sentence = f"The size of a pixel changes by {100 * spread:.1f} % over the plate" + (
        ", as an image intensifier's."
        if spread >= MIN_DISTORTION
        else ": the image is a flat panel's, or its distortion was corrected. Take the plate off, and use the solid's "
        "frame alone."
    )
    return Check("intensifier distortion", spread >= MIN_DISTORTION, 100 * spread, 100 * MIN_DISTORTION, "%", sentence)


def _panel_checks(fit: SolidAdjustment, image: int, c_arm: CArm | None) -> list[Check]:
    """Return the checks of focal length and principal point against what is known of the panel."""
    camera, prior = fit.cameras[image], fit.images[image].prior
    own = fit.columns_of(image)
    gain = fit.gain[own]
    sd = np.sqrt(np.maximum(np.einsum("ij,ij->i", gain, gain), 0.0))
    off = np.log(camera.focal_px / prior.focal_px)
    share, sd_share = abs(float(off)), float(np.hypot(prior.focal_share, sd[FOCAL]))
    away = float(np.hypot(*(camera.centre_px - np.array(prior.centre_px))))
    away_limit = TWO_SIDED_999 * float(np.hypot(prior.centre_sd_px, sd[CENTRE].max()))
    unit, on_plate = fit.images[image].unit, isinstance(fit.images[image], DetectorPlateImage)
    known = c_arm is not None and (on_plate or c_arm.pixel_mm is not None)
    stated = "the stated source-detector distance" if known else "that of usual C-arms"
    focal = f"The focal length is {camera.focal_px:.0f} ± {camera.focal_px * sd[FOCAL]:.0f} {unit}"
    not_stated = f", which is not {stated}: check distance and pixel size, and the solid's file."
    where = "plate {:.0f} mm from the detector's middle" if on_plate else "panel {:.0f} px from the image's middle"
    wrong = (
        ": the plate is not in the middle of the detector, or a file is wrong; put it on straight."
        if on_plate
        else ": the image is cropped, or the solid's file is wrong; give the whole image."
    )
    centre = f"The beam's axis meets the {where.format(away)}"
    limit = 100 * TWO_SIDED_999 * sd_share
    return [
        at_most("focal length", 100 * share, limit, "%", focal, otherwise=not_stated),
        at_most("principal point", away, away_limit, unit, centre, otherwise=wrong),
    ]


@one_blas_thread
def calibrate_together(
    observations: Sequence[Observations],
    frame: Frame | str | Path,
    c_arms: Sequence[CArm | None] | None = None,
) -> tuple[BeadView, ...]:
    """Return the calibrated views of images that show one solid of balls at rest, in a single adjustment.

    `observations`: one image or more, each of another view and with its size. `c_arms`: the known dimensions of the
    C-arm for each image. Without a plate on the detector the images must come from flat panels, with one from image
    intensifiers; others fail their checks. Balls that contradict the others are left out and named. Raises
    ObservationsError, FrameError, CalibrationRefusedError.
    """
    frame = Frame.of(frame)
    if frame.solid is None:
        raise CalibrationRefusedError(f"frame {frame.name} has plates: calibrate each of its images by itself")
    if len({seen.view for seen in observations}) < len(observations):
        raise ObservationsError("two images are of the same view; give each image a name of its own")
    known = c_arms or [None] * len(observations)
    solid = solid_of(frame)
    centred = [at_centres(seen, frame) for seen in observations]
    images = [image_of(seen, frame, solid, c_arm) for seen, c_arm in zip(centred, known, strict=True)]
    with well_conditioned():
        cameras = [first_camera(solid, image, seen.view) for image, seen in zip(images, observations, strict=True)]
        fit, left = _robustly(solid, images, cameras, observations)
    adjustment = sha256(b"".join(seen.view.encode() + seen.uv_px.tobytes() for seen in observations)).hexdigest()[:16]
    chi_square = chi_square_check(
        fit.chi_square,
        fit.freedom,
        "All images of the solid agree with its file, the stated noise and tolerances.",
        "The images disagree with the solid's file by more than the stated noise and tolerances explain: the solid "
        "moved between the images, its file is of another one or states too small errors, or an image is distorted.",
    )
    checks = (chi_square, *tolerance_checks(frame))
    return tuple(
        replace(
            _view(_InOne(fit, k, adjustment), centred[k], frame, c_arm, (left[k], checks)),
            inputs=CalibrationInputs(seen, frame),
        ).with_balls_measured()
        for k, (seen, c_arm) in enumerate(zip(observations, known, strict=True))
    )


def adjusted_together(views: Sequence[CalibratedView]) -> tuple[CalibratedView, ...]:
    """Return the views of one solid, calibrated image by image, adjusted together; other views as they are.

    They keep the checks of their images and what a person said of the display. Raises CalibrationRefusedError.
    """
    own = [view for view in views if isinstance(view, BeadView) and view.method == SOLID and view.inputs is not None]
    apart = len({view.adjustment for view in own}) == len({view.name for view in own}) == len(views) > 1
    return _adjusted_together(*own) if apart and len({view.frame_key for view in own}) == 1 else tuple(views)


@lru_cache(maxsize=8)  # a point that is dragged is planned again and again on the same views
def _adjusted_together(*views: BeadView) -> tuple[BeadView, ...]:
    inputs = [view.inputs for view in views if view.inputs is not None]
    made = calibrate_together([view.observations for view in inputs], inputs[0].frame, [view.c_arm for view in views])
    return tuple(_with_checks_of(new, old) for new, old in zip(made, views, strict=True))


def _with_checks_of(new: BeadView, old: BeadView) -> BeadView:
    known = {check.name for check in new.checks}
    kept = [check for check in old.checks if check.name not in known]
    return replace(new, checks=(*new.checks, *kept), mirrored_display=old.mirrored_display)


def adjustment_of(view: BeadView) -> SolidAdjustment:
    """Return the adjustment that a view of `calibrate_together` comes from. Raises UnusableInputError for others."""
    if not isinstance(view.posterior, _InOne):
        raise UnusableInputError(f"view {view.name} was not calibrated from a solid")
    return view.posterior.fit


@dataclass(frozen=True, eq=False)
class SolidErrors:
    """The errors of focal point and lines of sight by source, as responses to errors of unit variance; `own_map`, the
    map's, as a covariance: the rest of it, once all balls' images are given, which no other view shares."""

    responses: dict[str, np.ndarray]
    own_map: np.ndarray

    def by_source(self) -> dict[str, np.ndarray]:
        """Return the covariances for each of `view.SOURCES`."""
        return {"map": self.own_map, **{source: g @ g.T for source, g in self.responses.items()}}

    def shared(self) -> dict[str, np.ndarray]:
        """Return `LinesOfSight.shared`: the views of one adjustment share all errors but the map's."""
        return self.responses


@dataclass(frozen=True, eq=False)
class _InOne:
    """One image of an adjustment, as the `Posterior` of its view. `adjustment`: `LinesOfSight.adjustment`."""

    fit: SolidAdjustment
    image: int
    adjustment: str

    @one_blas_thread
    def line_errors(self, uv_px: np.ndarray) -> SolidErrors:
        """Return the errors of focal point and lines of sight of pixels (N, 2)."""
        return SolidErrors(*self.fit.responses(self.image, self.plane, uv_px))

    @property
    def plane(self) -> Plane:
        """The reference plane: through the solid's middle, across the camera's axis."""
        return Plane.across(self.fit.cameras[self.image].rotation[2], self.fit.solid.middle_mm)


def _robustly(
    solid: SolidBalls, images: list[SolidImage], cameras: list[PanelCamera], seen: Sequence[Observations]
) -> tuple[SolidAdjustment, list[list[str]]]:
    """Return the adjustment without outlying balls, and their names by image. Raises CalibrationRefusedError."""
    left: list[list[str]] = [[] for _ in images]
    names = [list(image.ids) for image in seen]
    total = sum(len(image.rows) for image in images)
    limit = max(1, int(MAX_WRONG_SHARE * total))
    while True:
        fit = adjust(solid, images, cameras)
        squares = [fit.left_out(k)[1] for k in range(len(images))]
        common = max(1.0, variance_ratio(np.concatenate(squares)))
        k = int(np.argmax([square.max() for square in squares]))
        worst = int(np.argmax(squares[k]))
        if squares[k][worst] <= -2 * np.log(FALSE_ALARM / total) * common:
            return fit, left
        left[k].append(names[k].pop(worst))
        images = [image.without(worst) if n == k else image for n, image in enumerate(images)]
        if sum(map(len, left)) > limit or not images[k].enough:
            wrong = ", ".join(
                f"{ball} in {image.view}" for image, balls in zip(seen, left, strict=True) for ball in balls
            )
            raise CalibrationRefusedError(
                f"more than {limit} balls contradict the others ({wrong}); check that the frame file is that of the "
                "solid in the images, that it did not move between them, and that it is undamaged"
            )


def _view(
    own: _InOne, seen: Observations, frame: Frame, c_arm: CArm | None, told: tuple[list[str], tuple[Check, ...]]
) -> BeadView:
    """Return the view of one image. `told`: ids of the balls left out of it, and the checks of the adjustment."""
    fit, camera, plane, image = own.fit, own.fit.cameras[own.image], own.plane, own.fit.images[own.image]
    residuals = _residuals(own, seen, frame, told[0])
    checks = [*checks_of_image(fit, own.image, c_arm), leave_one_out_check(residuals)]
    checks += [wrong_beads_check(residuals)] if residuals.left_out else []
    strays = (
        None if seen.rejected is None else np.array([candidate.uv_px for candidate in seen.rejected]).reshape(-1, 2)
    )
    return BeadView(
        name=seen.view,
        method=SOLID,
        plane=plane,
        plane_map=image.plane_map(camera, fit.solid, fit.e, plane),
        focal_point_mm=camera.focal_point_mm,
        residuals=residuals,
        mirrored=image.is_mirrored(camera),
        hull=image.hull(seen.image_shape),
        checks=(*checks, *told[1]),
        frame_key=frame.fingerprint,
        fiducials=frame.with_beads_at(image.placed_mm(camera, frame.xyz_mm)).fiducials,
        posterior=own,
        image_shape=seen.image_shape,
        rejected_px=strays,
        c_arm=c_arm,
        adjustment=own.adjustment,
    )


def _residuals(own: _InOne, seen: Observations, frame: Frame, left: list[str]) -> Residuals:
    """Return the residuals of an image's balls on the reference plane; those of the adjusted solid."""
    fit, camera, plane = own.fit, own.fit.cameras[own.image], own.plane
    rows = rows_of(seen, frame)
    used = np.array([i not in left for i in seen.ids])
    off_px, sigma = fit.prediction(own.image, seen.uv_px, rows, noise_px2(seen))
    to_mm = camera.plane_map(plane).jacobian(fit.traced(own.image, seen.uv_px).at)
    residual = np.einsum("nab,nb->na", to_mm, off_px)
    alone_px, square = fit.left_out(own.image)
    loo = residual.copy()
    loo[used], sigma[used] = np.einsum("nab,nb->na", to_mm[used], alone_px), np.sqrt(square)
    return Residuals(seen.ids, seen.uv_px, residual, loo, np.ones(len(rows), dtype=bool), sigma, used)
