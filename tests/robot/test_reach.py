"""Clearances against brute force, and every reason to refuse a path."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import RigidTransform, Rotation

from sightline.common.checks import failed
from sightline.errors import UnusableInputError
from sightline.robot.kinematics.designs import FEED, LIFT, PITCH, TRAVERSE, YAW, nominal_manipulator
from sightline.robot.kinematics.reach import (
    CLEARANCE_MM,
    Obstacle,
    Surroundings,
    between,
    check_reach,
    frame_capsules,
    hip_surroundings,
    segment_to_box_mm,
)

STRAIGHT = np.deg2rad(45.0)
STANDOFF_MM = 20.0
# A typical wire about the frame's origin, CFCS: its ends when the side is right.
WIRE_MM = np.array([[33.5, 34.2, -7.1], [-33.5, -34.2, 7.1]])


def approach(side="right", tilt=0.0, lift=0.0):
    """Robot, path from the imaging pose to stand-off to end, theatre."""
    robot, sign = nominal_manipulator(side), 1 if side == "right" else -1
    imaging = np.array([lift, 0.0, sign * STRAIGHT, 0.0, 0.0])
    T_mcs_cfcs = robot.T_mcs_cfcs(imaging)
    wire = Rotation.from_euler("y", tilt, degrees=True).apply(WIRE_MM) * [1, sign, 1]
    entry, end = T_mcs_cfcs.apply(wire)
    length = np.linalg.norm(end - entry)
    path = np.stack([imaging, robot.inverse(entry, end, -STANDOFF_MM), robot.inverse(entry, end, float(length))])
    return robot, path, hip_surroundings(T_mcs_cfcs)


def names(checks):
    return [check.name for check in failed(checks)]


@settings(deadline=None, max_examples=15)
@given(st.integers(0, 2**32 - 1))
def test_distance_of_a_line_from_a_box_is_the_least_of_its_points(seed):
    rng = np.random.default_rng(seed)
    ends, half = rng.uniform(-30, 30, (20, 2, 3)), rng.uniform(0.1, 20, 3)
    along = np.linspace(0, 1, 2001)[:, None, None]
    points = ends[:, 0] + along * (ends[:, 1] - ends[:, 0])
    brute = np.linalg.norm(points - np.clip(points, -half, half), axis=-1).min(axis=0)
    exact = segment_to_box_mm(ends, half)
    assert (exact <= brute + 1e-9).all()
    assert np.allclose(exact, brute, atol=0.06)  # 2000 steps along at most 104 mm


def test_the_nearest_line_is_found_among_all():
    """What is left out as too far away changes nothing: every line looked at gives the same."""
    robot, path, theatre = approach()
    capsules = (*robot.parts, *frame_capsules(robot))
    for pose in np.random.default_rng(3).uniform(-1, 1, (1, 5)):
        way = np.stack([path[0], path[0] + pose * [40.0, 40.0, 0.2, 0.2, 0.0]])
        whole = []
        for obstacle in theatre.obstacles:
            inside = obstacle.T_mcs_box.inv()
            for part in capsules:
                stages = robot.stages(between(robot, way, capsules))[:, part.joints]
                ends = robot.T_mcs_flange_home.apply(part.ends_mm)
                lines = np.einsum("nab,kb->nka", stages[:, :3, :3], ends) + stages[:, None, :3, 3]
                at = inside.apply(lines.reshape(-1, 3)).reshape(lines.shape)
                left = segment_to_box_mm(at, obstacle.half_mm).min() - part.radius_mm - 1.0
                whole.append((obstacle.name, left))
        for check in check_reach(robot, way, theatre)[1:-1]:
            assert check.figure == pytest.approx(min(left for name, left in whole if f"{name} clearance" == check.name))


def test_a_line_without_length_is_a_point():
    point = np.array([[[5.0, 1.0, 0.0], [5.0, 1.0, 0.0]]])
    assert segment_to_box_mm(point, np.array([2.0, 2.0, 2.0])) == pytest.approx([3.0])


@pytest.mark.parametrize("side", ["right", "left"])
def test_a_typical_wire_is_reached_on_both_sides(side):
    checks = check_reach(*approach(side))
    assert [check.name for check in checks] == [
        "joint limits", "patient clearance", "table clearance", "C-arm clearance", "frame remount"
    ]  # fmt: skip
    assert not failed(checks)


def test_a_path_beyond_a_limit_says_which_joint_and_by_how_much():
    robot, path, theatre = approach()
    path[-1, FEED] = 260.0
    first = check_reach(robot, path, theatre)[0]
    assert not first.passed
    assert "feed would go to 260.0 mm, 10.0 mm beyond its limit of 250.0 mm" in first.sentence


def test_a_path_into_the_table_is_refused():
    robot, path, theatre = approach()
    path[1:, PITCH] = np.deg2rad(-20.0)
    path[1:, LIFT] = -100.0
    checks = check_reach(robot, path, theatre)
    assert "table clearance" in names(checks)


def test_a_drill_fed_into_the_patient_is_refused_though_the_wire_may_enter():
    robot, path, theatre = approach()
    path[-1, FEED] = 245.0
    found = next(check for check in check_reach(robot, path, theatre) if check.name == "patient clearance")
    assert not found.passed
    assert "The chuck leaves" in found.sentence
    assert "100% of the way" in found.sentence


def test_a_wire_too_square_to_the_patient_stands_in_the_swing_of_the_c_arm():
    robot, path, _ = approach()
    square = path[0].copy()
    square[YAW] = np.deg2rad(10.0)
    reached = RigidTransform.from_components(robot.T_mcs_cfcs(square).translation, Rotation.from_euler("z", np.pi))
    checks = check_reach(robot, square[None], hip_surroundings(reached, frame_mounted=False))
    assert "C-arm clearance" in names(checks)


def test_a_frame_that_is_taken_off_cannot_collide():
    robot, path, theatre = approach()
    turned = path[0] - [0.0, 0.0, np.deg2rad(60.0), 0.0, 0.0]  # swings the frame's lateral plates through the patient
    path = np.stack([path[0], turned])
    assert "The frame" in next(c for c in check_reach(robot, path, theatre) if c.name == "patient clearance").sentence
    off = check_reach(robot, path, replace(theatre, frame_mounted=False))
    assert not any("The frame leaves" in check.sentence for check in off)


@pytest.mark.parametrize(("repeat", "passed"), [(None, True), (0.05, True), (0.3, False)])
def test_a_frame_put_back_must_repeat_its_place(repeat, passed):
    robot, path, theatre = approach()
    last = check_reach(robot, path, replace(theatre, remount_mm=repeat))[-1]
    assert (last.name, last.passed, last.figure) == ("frame remount", passed, repeat)


def test_what_stands_between_two_free_places_is_met_on_the_way():
    robot = nominal_manipulator()
    path = np.zeros((2, 5))
    path[:, TRAVERSE] = [-100.0, 100.0]
    chuck_mm = robot.T_mcs_tool(np.zeros(5)).translation - [140.0, 0.0, 0.0]
    thin = Obstacle("table", RigidTransform.from_translation(chuck_mm), np.array([1.0, 1.0, 400.0]))
    theatre = Surroundings((thin,), frame_mounted=False)
    for end in path:
        assert not failed(check_reach(robot, end[None], theatre))
    checks = check_reach(robot, path, theatre)
    assert names(checks) == ["table clearance"]
    assert checks[1].figure is not None
    assert checks[1].figure < 0


def test_the_clearance_stated_is_the_distance_less_half_a_step():
    robot = nominal_manipulator()
    tip = robot.T_mcs_tool(np.zeros(5)).translation
    # A wall ahead of the chuck, whose cap ends 15 mm beyond (0, -40, 55) of the flange.
    wall = Obstacle(
        "table", RigidTransform.from_translation([250.0 + 200.0, 0.0, tip[2]]), np.array([10.0, 500.0, 10.0])
    )
    checks = check_reach(robot, np.zeros((1, 5)), Surroundings((wall,), frame_mounted=False))
    to_slide = 190.0 - 120.0 - 45.0  # the slide reaches further forward than the retracted chuck
    assert checks[1].figure == pytest.approx(to_slide - 1.0, abs=1e-6)
    assert checks[1].limit == CLEARANCE_MM


def test_without_obstacles_only_the_robot_itself_is_judged():
    checks = check_reach(nominal_manipulator(), np.zeros((1, 5)), Surroundings(()))
    assert [check.name for check in checks] == ["joint limits", "frame remount"]


@pytest.mark.parametrize("bad", [np.zeros(5), np.zeros((2, 4)), np.full((1, 5), np.nan)])
def test_a_path_that_is_none_is_refused(bad):
    with pytest.raises(UnusableInputError, match="finite joints"):
        check_reach(nominal_manipulator(), bad, Surroundings(()))
