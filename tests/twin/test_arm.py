"""One arm in all its views: flex as a function of the orbit, set-ups within what the room allows."""

from dataclasses import replace
from math import radians

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sightline.errors import SetUpError
from sightline.twin import Variation, draw_setup
from sightline.twin.xray.distributions import Arm, OneArm, Pose, draw_arm, orbit_of

STEADY = Arm(repeat_mm=0.0)
AXES = np.eye(3)[:2]


def beam_at(orbit: float) -> np.ndarray:
    return np.array([np.sin(orbit), 0.0, np.cos(orbit)])


def numbers(arm: OneArm, orbit: float) -> np.ndarray:
    sag = arm.sag(np.random.default_rng(0), beam_at(orbit), AXES)
    return np.array([*sag.shift_mm, sag.longer_mm, *sag.rotation])


def test_the_same_orbit_bends_the_arm_alike_and_small_turns_little():
    arm = draw_arm(np.random.default_rng(1), STEADY, Pose())
    assert np.array_equal(numbers(arm, 0.6), numbers(arm, 0.6))
    assert np.abs(numbers(arm, 0.61) - numbers(arm, 0.60)).max() < 0.2
    assert np.abs(numbers(arm, 1.6) - numbers(arm, 0.0)).max() > 1.0


def test_an_arm_upside_down_bends_the_other_way():
    """Its weight pulls the other way: seen by the arm itself, its shift and its distance change sign."""
    arm = draw_arm(np.random.default_rng(2), STEADY, Pose())
    for orbit in (0.3, 1.1):
        one, two = (arm.sag(np.random.default_rng(0), beam_at(o), AXES) for o in (orbit, orbit + np.pi))
        half = Rotation.from_rotvec([0.0, np.pi, 0.0])  # takes the arm's own axes from the one to the other
        assert two.shift_mm == pytest.approx(-half.apply(one.shift_mm))
        assert two.rotation == pytest.approx(-half.apply(one.rotation))
        assert two.longer_mm == pytest.approx(-one.longer_mm)


def test_the_sag_lies_across_the_beam_and_is_as_large_as_measured():
    """Daly 2008: piercing point up to 10-16 mm over the orbit, distance 6-8 mm, tilt up to 2.9°."""
    rng, pose = np.random.default_rng(3), Pose()
    ranges = []
    for _ in range(200):
        arm = draw_arm(rng, STEADY, pose)
        sags = [arm.sag(rng, beam_at(o), AXES) for o in np.radians(np.arange(-40, 101, 10))]
        assert all(
            abs(s.shift_mm @ beam_at(np.radians(o))) < 1e-9 for o, s in zip(range(-40, 101, 10), sags, strict=True)
        )
        body = [s.shift_mm[1] for s in sags]
        ranges.append(
            [np.ptp(body), np.ptp([s.longer_mm for s in sags]), max(np.linalg.norm(s.rotation) for s in sags)]
        )
    piercing, distance, tilt = np.median(ranges, axis=0)
    assert 4.0 < piercing < 16.0
    assert 3.0 < distance < 8.0
    assert radians(0.8) < tilt < radians(2.9)


def test_what_does_not_repeat_is_as_stated():
    arm = OneArm(Arm(), np.zeros((5, 2)))
    rng = np.random.default_rng(4)
    shifts = np.array([arm.sag(rng, beam_at(0.7), AXES).shift_mm for _ in range(2000)])
    assert np.sqrt((shifts**2).sum(axis=1).mean() / 2) == pytest.approx(0.25, rel=0.05)


def test_set_ups_by_one_arm_keep_within_the_room(frame):
    arm, rng, orbits = Arm(), np.random.default_rng(5), []
    variation = Variation(pose=replace(Pose(), frame_tilt=0.0), arm=arm)
    for _ in range(12):
        setup = draw_setup(rng, frame, variation=variation)
        for name, view in setup.views.items():
            to_hip = view.detector.origin_mm - view.focal_point_mm
            off = orbit_of(to_hip / np.linalg.norm(to_hip)) - orbit_of(frame.view(name).axis)
            orbits.append(off)
            assert abs(off) < arm.orbit + arm.swivel + radians(2.0)  # flex: 20 of 1000 mm
    assert np.std(orbits) > radians(2.5)


def test_where_the_machine_does_not_go_there_is_no_set_up(frame):
    short = replace(Arm(), orbit_limits=(radians(-40.0), radians(45.0)))
    with pytest.raises(SetUpError, match="none of"):
        draw_setup(np.random.default_rng(6), frame, variation=Variation(arm=short))
