"""Movements of the lines of sight at a target: right in size, and within what is stated of their noise."""

from dataclasses import replace

import numpy as np
import pytest
from calibration_scenes import GAMMA, TARGETS_MM, Camera, choose, displaced
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from sightline.calibration import calibrate
from sightline.calibration.displacement import Rest
from sightline.errors import CalibrationRefusedError, UnusableInputError

CAMERA = Camera.pa(tilt_rad=0.1, bend=0.02)
TARGETS = TARGETS_MM[:2]


def arm(shift_mm=(0.0, 0.0, 0.0), turn_rad=(0.0, 0.0, 0.0), flex_mm=(0.0, 0.0, 0.0)) -> Camera:
    """The C-arm moved as a whole, about the origin, and its source by `flex_mm` besides."""
    turn, detector = Rotation.from_rotvec(turn_rad).as_matrix(), CAMERA.detector
    return replace(
        CAMERA,
        focal_point_mm=turn @ CAMERA.focal_point_mm + shift_mm + flex_mm,
        detector=replace(detector, origin_mm=turn @ detector.origin_mm + shift_mm, axes=detector.axes @ turn.T),
    )


def true_shift_mm(camera: Camera) -> np.ndarray:
    """Distances of the targets from the rays of the pixels that showed them at rest, without any calibration."""
    out = []
    for target in TARGETS:
        pixel = CAMERA.project(target[None])
        at, step = target.copy(), 1e-4
        for _ in range(20):  # the point of the pixel's ray at the target's height
            slope = np.stack(
                [(camera.project((at + step * e)[None]) - camera.project(at[None]))[0] for e in np.eye(3)[:2]]
            )
            at[:2] += np.linalg.solve(slope.T / step, (pixel - camera.project(at[None]))[0])
        ray = camera.focal_point_mm - at
        off = target - at
        out.append(np.linalg.norm(off - (off @ ray) * ray / (ray @ ray)))
    return np.array(out)


@pytest.fixture(scope="module")
def rest() -> Rest:
    seen = CAMERA.observe(GAMMA, np.random.default_rng(1), 1e-3)
    return Rest.of(calibrate(seen, GAMMA), GAMMA, [seen], TARGETS)


@pytest.mark.parametrize(
    "moved",
    [
        arm(shift_mm=(0.21, -0.34, 0.0)),
        arm(turn_rad=(0.4e-3, 0.7e-3, -0.5e-3)),
        arm(flex_mm=(0.5, 0.3, -0.9)),
        arm((0.3, 0.1, -2.0), (-0.3e-3, 0.2e-3, 1e-3), (0.2, -0.4, 0.6)),
    ],
)
def test_the_shift_is_that_of_the_rays(rest: Rest, moved: Camera) -> None:
    found = rest.displacement(moved.observe(GAMMA, np.random.default_rng(2), 1e-3))
    assert np.hypot(*found.shift_mm.T) == pytest.approx(true_shift_mm(moved), abs=0.005)
    assert found.beads > 90


def test_noise_is_of_the_size_stated() -> None:
    rng = np.random.default_rng(3)
    several = [CAMERA.observe(GAMMA, rng) for _ in range(4)]
    squares = []
    for _ in range(40):
        first = [CAMERA.observe(GAMMA, rng) for _ in range(4)]
        rest = Rest.of(calibrate(several[0], GAMMA), GAMMA, first, TARGETS)
        found = rest.displacement(CAMERA.observe(GAMMA, rng))
        assert found.rest_sd_mm == pytest.approx(found.sd_mm / 2, rel=0.1)  # four images at rest, one now
        spread = found.covariance_mm2[0] + found.rest_mm2[0]
        squares.append(found.shift_mm[0] @ np.linalg.solve(spread, found.shift_mm[0]))
    assert chi2.ppf(0.005, 80) < sum(squares) < chi2.ppf(0.995, 80)


def test_an_instrument_in_front_of_some_beads_is_not_a_movement(rest: Rest) -> None:
    seen = displaced(CAMERA.observe(GAMMA, np.random.default_rng(4)), dict.fromkeys((3, 17, 40, 66, 80), (2.0, -1.0)))
    found = rest.displacement(seen)
    assert found.beads <= len(seen) - 5
    assert found.length_mm < 4 * found.sd_mm


def test_beads_that_come_and_go_do_not_matter(rest: Rest) -> None:
    seen = CAMERA.observe(GAMMA, np.random.default_rng(5), 1e-3)
    half = choose(seen, lambda name: sum(map(ord, name)) % 2 == 0)
    assert rest.displacement(half).length_mm < 0.002
    assert rest.displacement(half).beads < 0.7 * len(seen)


def test_what_it_refuses(rest: Rest) -> None:
    seen = CAMERA.observe(GAMMA, np.random.default_rng(6))
    with pytest.raises(UnusableInputError, match="smooth"):
        Rest.of(calibrate(seen, GAMMA, method="polynomial"), GAMMA, [seen], TARGETS)
    with pytest.raises(UnusableInputError, match="covariances"):
        rest.displacement(replace(seen, covariance_px2=None))
    few = [f.id for plate in (GAMMA.view("pa").xrii, GAMMA.view("pa").source) for f in plate.fiducials[:13:3]]
    with pytest.raises(CalibrationRefusedError):
        rest.displacement(choose(seen, lambda name: name in few))
