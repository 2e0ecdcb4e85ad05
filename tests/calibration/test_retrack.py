"""A view that goes on from the last one is the view that would be calibrated anew."""

from dataclasses import replace

import numpy as np
import pytest
from calibration_scenes import GAMMA, TARGETS_MM, Camera, choose, displaced, line_numbers

from sightline.calibration import calibrate
from sightline.calibration.retrack import recalibrate
from sightline.errors import CalibrationRefusedError, ObservationsError, UnusableInputError

CAMERA = Camera.pa(tilt_rad=0.1, bend=0.02)


def moved(shift_mm: tuple[float, float, float]) -> Camera:
    """The C-arm elsewhere: its source and its detector."""
    shift, detector = np.array(shift_mm), CAMERA.detector
    return replace(
        CAMERA,
        focal_point_mm=CAMERA.focal_point_mm + shift,
        detector=replace(detector, origin_mm=detector.origin_mm + shift),
    )


def numbers_at_targets(view, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """xy of the targets' lines of sight, mm on the plate, and their whole covariance."""
    uv = camera.project(TARGETS_MM)
    lines = view.lines_of_sight(uv)
    return lines.xy_mm, np.sum(list(lines.covariance.values()), axis=0)[3:, 3:]


@pytest.mark.parametrize("shift_mm", [(0.0, 0.0, 0.0), (1.3, -0.7, 0.4), (6.1, 5.3, -8.2)])
def test_it_is_the_view_of_the_cold_path(shift_mm: tuple[float, float, float]) -> None:
    rng = np.random.default_rng(3)
    camera, apart = moved(shift_mm), []
    view = calibrate(CAMERA.observe(GAMMA, rng), GAMMA)
    for _ in range(6):
        seen = camera.observe(GAMMA, rng)
        view, cold = recalibrate(seen, GAMMA, view), calibrate(seen, GAMMA)
        (warm_xy, warm_cov), (cold_xy, cold_cov) = (numbers_at_targets(one, camera) for one in (view, cold))
        apart.append(np.hypot(*(warm_xy - cold_xy).T))
        assert np.diag(warm_cov) == pytest.approx(np.diag(cold_cov), rel=0.05)
    assert np.mean(apart) < 0.01


def test_an_outlier_is_left_out_as_by_the_cold_path() -> None:
    rng = np.random.default_rng(4)
    last = calibrate(CAMERA.observe(GAMMA, rng), GAMMA)
    seen = displaced(CAMERA.observe(GAMMA, rng), {17: (1.5, -1.0)})
    assert recalibrate(seen, GAMMA, last).residuals.left_out == (seen.ids[17],)


def test_other_beads_are_calibrated_anew_to_the_bit() -> None:
    rng = np.random.default_rng(5)
    last = calibrate(CAMERA.observe(GAMMA, rng), GAMMA)
    seen = choose(CAMERA.observe(GAMMA, rng), lambda name: hash_of(name) % 5 > 0)
    uv = CAMERA.project(TARGETS_MM)
    assert np.array_equal(line_numbers(recalibrate(seen, GAMMA, last), uv), line_numbers(calibrate(seen, GAMMA), uv))


def hash_of(name: str) -> int:
    return sum(map(ord, name))


def test_understated_noise_is_calibrated_anew_and_reported() -> None:
    rng = np.random.default_rng(6)
    last = calibrate(CAMERA.observe(GAMMA, rng), GAMMA)
    seen = CAMERA.observe(GAMMA, rng, sd_px=0.5)
    seen = replace(seen, covariance_px2=np.broadcast_to(0.01 * np.eye(2), (len(seen), 2, 2)))
    view = recalibrate(seen, GAMMA, last)
    uv = CAMERA.project(TARGETS_MM)
    assert "chi-square" in [check.name for check in view.checks if not check.passed]
    assert np.array_equal(line_numbers(view, uv), line_numbers(calibrate(seen, GAMMA), uv))


def test_what_it_refuses() -> None:
    rng = np.random.default_rng(7)
    seen = CAMERA.observe(GAMMA, rng)
    last = calibrate(seen, GAMMA)
    with pytest.raises(UnusableInputError, match="smooth"):
        recalibrate(seen, GAMMA, calibrate(seen, GAMMA, method="polynomial"))
    with pytest.raises(ObservationsError, match="swapped"):
        recalibrate(replace(seen, view="lateral"), GAMMA, last)
    with pytest.raises(CalibrationRefusedError):
        recalibrate(choose(seen, lambda name: "-x-" in name), GAMMA, last)
