"""Calibration of a view from its labelled beads."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from sightline.calibration.bead_checks import noise_checks, row_check, view_checks
from sightline.calibration.bead_view import BeadView, CalibrationInputs
from sightline.calibration.lengths import CArm
from sightline.calibration.maps.fit_map import Method, refuse_unknown_method
from sightline.calibration.maps.hull import Hull
from sightline.calibration.maps.localized import LocalizedMap
from sightline.calibration.maps.polynomial import Affine, PolynomialMap
from sightline.calibration.plates.beads import UNKNOWN_NOISE_PX, Beads, match
from sightline.calibration.plates.classical import Fitter, PlateName, classical_residuals, fit_plates
from sightline.calibration.plates.joint import MIN_BEADS, JointFit, fit_robustly
from sightline.calibration.solids.calibrate_together import calibrate_together
from sightline.common.checks import Check
from sightline.common.threads import one_blas_thread
from sightline.detection.results import Observations
from sightline.errors import UnusableInputError
from sightline.frame import Frame


@one_blas_thread
def calibrate(
    observations: Observations,
    frame: Frame | str | Path,
    view: str | None = None,
    method: Method = "smooth",
    *,
    degree: int = 3,
    plate: PlateName = "xrii",
    mirrored_display: bool | None = None,
    c_arm: CArm | None = None,
) -> BeadView:
    """Return the view calibrated from the beads of one image; `calibrate_together` takes all images of a solid.

    `frame`: a Frame, a frame file or the name of a built-in frame. `view`: where given, must be that of the
    observations. `degree` (1 to 7): of "polynomial". `plate`: the plate that the lines of sight of "localized" and
    "polynomial" go through (the paper's PA/X and PA/S). Beads that contradict the others are left out and named.
    `mirrored_display`: whether the display mirrors the image, judged by a person from writing in it; None where nobody
    looked. Beads that contradict it mean that the frame file describes the mirror image of the frame. `c_arm`: known
    dimensions of the C-arm, against which the calibration is then checked.
    For a frame with a solid `method`, `degree` and `plate` have no meaning.
    Raises ObservationsError, FrameError, UnusableInputError, CalibrationRefusedError.

    >>> beads = sl.detect("out/demo/demo_pa.dcm")
    >>> view = sl.calibrate(sl.label(beads, "gamma"), "gamma")
    >>> view.focal_point_mm.round()
    array([  -7.,  -28., -619.])
    """
    if not isinstance(observations, Observations):
        raise UnusableInputError(
            f"give the Observations of `label` or of a CSV file, not {type(observations).__name__}; "
            "`calibrate_image` takes an image"
        )
    frame = Frame.of(frame)
    if frame.solid is not None:
        (alone,) = calibrate_together([observations], frame, [c_arm])
        return alone.said_to_be(mirrored_display)
    refuse_unknown_method(method)
    if plate not in ("xrii", "source"):
        raise UnusableInputError(f"unknown plate {plate!r}; choose 'xrii' or 'source'")
    beads = match(observations, frame, view)
    if method == "smooth":
        fitted = _smooth(beads)
    elif method == "localized":
        fitted = _classical(beads, method, LocalizedMap.fit, plate)
    else:
        fitted = _classical(beads, method, lambda uv, xy: PolynomialMap.fit(uv, xy, degree), plate)
    rejected = None if observations.rejected is None else [candidate.uv_px for candidate in observations.rejected]
    rejected_px = None if rejected is None else np.reshape(np.array(rejected, dtype=np.float64), (-1, 2))
    inputs = CalibrationInputs(observations, frame, degree, plate)
    fitted = replace(fitted, image_shape=observations.image_shape, rejected_px=rejected_px, inputs=inputs)
    fitted = fitted.said_to_be(mirrored_display).with_strip_sought().with_balls_measured()
    return fitted if c_arm is None else fitted.taken_by(c_arm)


def _smooth(beads: Beads) -> BeadView:
    """Return the view calibrated by the smooth method. Raises CalibrationRefusedError."""
    fit, residuals = fit_robustly(beads)
    return BeadView(
        name=beads.view,
        method="smooth",
        plane=beads.plane,
        plane_map=fit.map,
        focal_point_mm=fit.pencil.focal_point_mm,
        residuals=residuals,
        mirrored=_mirrored(beads, fit.map.unit, fit.pencil.focal_point_mm),
        hull=Hull.of(fit.beads.uv_px),
        checks=(*view_checks(beads, residuals), *_joint_checks(fit)),
        frame_key=beads.frame.fingerprint,
        fiducials=beads.frame.fiducials_of(beads.view),
        posterior=fit,
        joint=fit,
    )


def _classical(beads: Beads, method: Method, fitter: Fitter, plate: PlateName) -> BeadView:
    """Return the view calibrated by a classical method.

    The smooth method finds the wrong beads, where there are enough for it, since it fits both plates at once.
    """
    joint, screened = fit_robustly(beads) if len(beads) >= MIN_BEADS else (None, None)
    used = np.ones(len(beads), dtype=bool) if screened is None else screened.used
    noise_px = None
    if beads.covariance_px2 is None:
        noise_px = UNKNOWN_NOISE_PX if joint is None else joint.learned.noise_scale
    fit = fit_plates(beads.where(used), fitter, plate, noise_px, joint)
    residuals = classical_residuals(fit, beads, used)
    xrii = beads.on_xrii
    to_plane, _ = Affine.fit(beads.uv_px[xrii], beads.plane.to_plane(beads.xyz_mm[xrii]))
    return BeadView(
        name=beads.view,
        method=method,
        plane=fit.plate.plane,
        plane_map=fit.plate.map,
        focal_point_mm=fit.focal_point_mm,
        residuals=residuals,
        mirrored=_mirrored(beads, to_plane, fit.focal_point_mm),
        hull=fit.plate.hull,
        checks=tuple(view_checks(beads, residuals) + _classical_checks(fit.plate.misfit_mm2, joint, noise_px)),
        frame_key=beads.frame.fingerprint,
        fiducials=beads.frame.fiducials_of(beads.view),
        posterior=fit,
        joint=joint,
    )


def _mirrored(beads: Beads, to_plane: Affine, focal_point_mm: np.ndarray) -> bool:
    """Whether the image shows the frame mirrored: u, v and the beam are right-handed (docs/conventions.md)."""
    return to_plane.is_mirrored != bool(beads.plane.height_mm(focal_point_mm) > 0)


def _joint_checks(fit: JointFit) -> list[Check]:
    return [*noise_checks(fit), row_check(fit)]


def _classical_checks(misfit_mm2: float, joint: JointFit | None, noise_px: float | None) -> list[Check]:
    misfit = float(np.sqrt(misfit_mm2))
    sentence = f"This method's own misfit is {misfit:.3f} mm on average over the plate, estimated from "
    sentence += (
        "leave-one-out residuals. Leaving a bead out doubles the spacing there, so the stated bounds are too wide, 1.2 "
        "to 2 times in the twin."
        if joint is None
        else "the difference between its map and the smooth method's beyond the beads' noise. The stated bounds "
        "include it."
    )
    checks = [Check("map misfit", True, misfit, None, "mm", sentence)]
    if joint is not None:
        return [*checks, *_joint_checks(joint)]
    if noise_px is not None:
        sentence = f"The beads' noise is not stated, and they are too few to estimate it; {noise_px} px is assumed."
        checks.append(Check("measurement noise", True, noise_px, None, "px", sentence))
    return checks
