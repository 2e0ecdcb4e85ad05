"""Check of the ball diameters against the frame file: the only length of the file that a single image can measure.

A wrong scale of the file's coordinates shows in no residual, since it scales the focal point's distance as well. The
shadow of a ball does not scale with it: seen from the focal point, a ball of radius r at the distance L fills the solid
angle pi (r / L)^2, which the area of its shadow in pixels measures.
"""

from functools import lru_cache

import numpy as np

from sightline.calibration.plates.joint import JointFit
from sightline.calibration.view_checks.focal_length import pixel_solid_angle
from sightline.checks import Check
from sightline.fitting.robust import MAD_TO_SD, median
from sightline.frame import Frame
from sightline.geometry.covariance import TWO_SIDED_999

# Systematic error of the fitted log radius where blur or beam hardening differ from the fit's model [twin, ours]: in 17
# images of four image chains, three doses and twice the blur, balls of 3 mm looked 0.4 to 1.8 % too large, those of
# 5 mm 0.9 to 2.6 %; on an unmeasured machine the error may be three times as large.
SYSTEMATIC = 0.06
_MIN_BALLS = 8  # balls [ours]
_MEDIAN = 1.2533  # s.d. of the median over that of the mean (normal distribution)


def ball_size_check(fit: JointFit) -> list[Check]:
    """Return the check for the beads used; none where their radii were not measured or too few are balls."""
    beads = fit.beads
    if beads.radius_px is None:
        return []
    all_balls, radius_mm = _stated(beads.frame, beads.view)
    balls = all_balls[beads.rows]
    if balls.sum() < _MIN_BALLS:
        return []
    larger = np.log(beads.radius_px * _mm_per_px(fit) / radius_mm[beads.rows])[balls]
    usual = median(larger)
    sd = _MEDIAN * MAD_TO_SD * median(np.abs(larger - usual)) / np.sqrt(len(larger))
    limit = float(SYSTEMATIC + TWO_SIDED_999 * sd)
    passed = abs(usual) <= limit
    sentence = (
        f"The balls look {abs(100 * np.expm1(usual)):.1f} % {'larger' if usual > 0 else 'smaller'} than the frame "
        f"file says; up to {100 * np.expm1(limit):.0f} % may be blur"
    )
    sentence += (
        ", so a smaller error of the file's scale does not show here."
        if passed
        else ". The scale of the file's coordinates is wrong, and with it every length, or its diameters are wrong: "
        "measure both, and correct the file."
    )
    return [Check("ball size", passed, 100 * usual, 100 * limit, "%", sentence)]


@lru_cache(maxsize=16)
def _stated(frame: Frame, view: str) -> tuple[np.ndarray, np.ndarray]:
    """Return which fiducials of a view are balls, (M,) bool, and their radii (M,), mm, the same for every image."""
    fiducials = frame.view(view).fiducials
    return np.array([f.shape == "ball" for f in fiducials]), np.array([f.diameter_mm for f in fiducials]) / 2


def _mm_per_px(fit: JointFit) -> np.ndarray:
    """Return (N,) the size of a pixel at each bead, perpendicular to its ray: sqrt(solid angle) times distance."""
    plane, focal = fit.beads.plane, fit.pencil.focal_point_mm
    distance = np.linalg.norm(fit.beads.xyz_mm - focal, axis=1)
    return np.sqrt(pixel_solid_angle(fit.map, plane, focal, fit.beads.uv_px)) * distance
