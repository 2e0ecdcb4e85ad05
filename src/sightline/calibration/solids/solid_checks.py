"""Checks of the views of a solid, calibrated together."""

import numpy as np
from scipy.special import chdtri

from sightline.calibration.solids.adjustment import SolidAdjustment
from sightline.calibration.solids.images import MIN_BALLS
from sightline.calibration.solids.panel_camera import CENTRE, FOCAL
from sightline.calibration.solids.plate_image import DetectorPlateImage
from sightline.calibration.view_checks.bead_checks import CHI_SQUARE_FALSE_ALARM
from sightline.calibration.view_checks.lengths import CArm
from sightline.common.checks import Check
from sightline.common.geometry.covariance import TWO_SIDED_999

# Smallest range of the pixel's size over a plate, beyond that of a tilt: intensifiers have 6 to 18 % over their field,
# flat panels 0.3 % by their noise [measured on the twin].
MIN_DISTORTION = 0.01


def adjustment_check(fit: SolidAdjustment) -> Check:
    """Return the chi-square of all images of one adjustment."""
    reduced, limit = fit.chi_square / fit.freedom, float(chdtri(fit.freedom, CHI_SQUARE_FALSE_ALARM)) / fit.freedom
    sentence = (
        "All images of the solid agree with its file, the stated noise and tolerances."
        if reduced <= limit
        else "The images disagree with the solid's file by more than the stated noise and tolerances explain: the "
        "solid moved between the images, its file is of another one or states too small errors, or an image is "
        "distorted."
    )
    return Check("chi-square", reduced <= limit, reduced, limit, "", sentence)


def checks_of_image(fit: SolidAdjustment, image: int, c_arm: CArm | None) -> list[Check]:
    """Return the checks of one image: its balls, that its kind is that of the frame, and what is known of the C-arm."""
    own = fit.images[image]
    kind = _is_distorted(own) if isinstance(own, DetectorPlateImage) else _distortion(fit, image)
    return [_count(int((own.rows < fit.solid.count).sum())), kind, *_panel_checks(fit, image, c_arm)]


def _count(balls: int) -> Check:
    sentence = f"{balls} balls of the solid are used; {MIN_BALLS} are needed, 9 or more are good."
    return Check("bead count", True, float(balls), float(MIN_BALLS), "beads", sentence)


def _distortion(fit: SolidAdjustment, image: int) -> Check:
    """Return the check that an image has no pincushion distortion: that it is a flat panel's."""
    own, camera = fit.images[image], fit.cameras[image]
    off = own.uv_px - camera.centre_px
    direction = np.zeros(len(fit.residual))
    cubic = off * (off**2).sum(axis=1, keepdims=True) / camera.focal_px**2
    direction[fit.rows_of(image)] = (own.whiten @ cubic[..., None]).ravel()
    sigma, limit = abs(fit.score(direction)), float(np.sqrt(chdtri(1, CHI_SQUARE_FALSE_ALARM)))
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
    sentence = f"The focal length is {camera.focal_px:.0f} ± {camera.focal_px * sd[FOCAL]:.0f} {unit}"
    limit = TWO_SIDED_999 * sd_share
    passed = share <= limit
    sentence += "." if passed else f", which is not {stated}: check distance and pixel size, and the solid's file."
    inside = away <= away_limit
    where = "plate {:.0f} mm from the detector's middle" if on_plate else "panel {:.0f} px from the image's middle"
    wrong = (
        "the plate is not in the middle of the detector, or a file is wrong; put it on straight."
        if on_plate
        else "the image is cropped, or the solid's file is wrong; give the whole image."
    )
    centre = f"The beam's axis meets the {where.format(away)}" + ("." if inside else f": {wrong}")
    return [
        Check("focal length", passed, 100 * share, 100 * limit, "%", sentence),
        Check("principal point", inside, away, away_limit, unit, centre),
    ]
