"""What a view's checks do not do: judge it by its focal point."""

import numpy as np
from calibration_scenes import EXACT, TARGETS_MM, Camera

from sightline.calibration import calibrate

CAMERA = Camera.pa(bend=0.03)


def test_a_focal_point_far_off_along_the_beam_is_no_reason_to_fail():
    # Large noise: F is lost by millimetres along the beam, the line at the target is not.
    view = calibrate(CAMERA.observe(rng=np.random.default_rng(4), sd_px=1.0), EXACT)
    lines = view.lines_of_sight(CAMERA.project(TARGETS_MM[:1]))
    total = sum(lines.covariance.values())
    share = 1 - lines.plane.height_mm(TARGETS_MM[0]) / lines.plane.height_mm(view.focal_point_mm)
    at_target = np.hstack([(1 - share) * np.eye(3), share * lines.plane.axes.T])
    across = np.eye(3) - np.outer(lines.directions[0], lines.directions[0])
    spread = across @ at_target @ total @ at_target.T @ across
    assert np.sqrt(total[2, 2]) > 2.0
    assert np.sqrt(np.linalg.eigvalsh(spread)[-1]) < 0.3 * np.sqrt(total[2, 2])
    assert all(check.passed for check in view.checks)
