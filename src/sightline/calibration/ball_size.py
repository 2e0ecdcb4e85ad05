"""Whether the balls have the size that the frame file says: the one length of it that an image shows by itself.

Coordinates of one wrong scale give images that no residual contradicts: the focal point is then as much too far or too
near. The shadow of a ball does not take part in that: seen from the focal point, a ball of radius r at the distance L
fills the solid angle pi (r / L)^2, which its shadow's pixels count.
"""

import numpy as np

from sightline.calibration.focal_length import pixel_solid_angle
from sightline.calibration.joint import JointFit
from sightline.checks import Check
from sightline.fitting.robust import MAD_TO_SD
from sightline.geometry.covariance import TWO_SIDED_999

# By so much, in log radius, the fitted radius may be wrong where blur or hardening are not what the fit takes them for
# [twin, ours]: in 17 images of four image chains, three doses and twice the blur the balls of 3 mm looked 0.4 to 1.8 %
# too large, those of 5 mm 0.9 to 2.6 %; a machine that nobody measured may be three times as far off.
SYSTEMATIC = 0.06
_MIN_BALLS = 8  # balls [ours]
_MEDIAN = 1.2533  # s.d. of the median over that of the mean (normal distribution)


def ball_size_check(fit: JointFit) -> list[Check]:
    """Of the beads used; none where their radii were not measured, or too few are balls."""
    beads = fit.beads
    if beads.radius_px is None:
        return []
    fiducials = [beads.frame.view(beads.view).fiducials[row] for row in beads.rows]
    balls = np.array([f.shape == "ball" for f in fiducials])
    if balls.sum() < _MIN_BALLS:
        return []
    stated_mm = np.array([f.diameter_mm for f in fiducials]) / 2
    larger = np.log(beads.radius_px * _mm_per_px(fit) / stated_mm)[balls]
    figure = float(np.median(larger))
    sd = _MEDIAN * MAD_TO_SD * float(np.median(np.abs(larger - figure))) / np.sqrt(len(larger))
    limit = float(SYSTEMATIC + TWO_SIDED_999 * sd)
    passed = abs(figure) <= limit
    sentence = (
        f"The balls look {abs(100 * np.expm1(figure)):.1f} % {'larger' if figure > 0 else 'smaller'} than the frame "
        f"file says; up to {100 * np.expm1(limit):.0f} % may be blur"
    )
    sentence += (
        ", so a scale of the file that is wrong by less does not show here."
        if passed
        else ". The file's coordinates are of another scale, and every length is wrong by as much, or its diameters "
        "are wrong: measure both, and correct the file."
    )
    return [Check("ball size", passed, 100 * figure, 100 * limit, "%", sentence)]


def _mm_per_px(fit: JointFit) -> np.ndarray:
    """(N,) size of a pixel at each bead, across its ray: the root of the pixel's solid angle, times the distance."""
    plane, focal = fit.beads.plane, fit.pencil.focal_point_mm
    distance = np.linalg.norm(fit.beads.xyz_mm - focal, axis=1)
    return np.sqrt(pixel_solid_angle(fit.map, plane, focal, fit.beads.uv_px)) * distance
