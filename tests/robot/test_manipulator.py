"""Kinematics against themselves: forward, inverse, Jacobians, for nominal and for displaced axes."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import RigidTransform, Rotation

from sightline.errors import RobotRefusedError, UnusableInputError
from sightline.robot.kinematics.designs import FEED, LIFT, PITCH, TRAVERSE, WRIST_MM, YAW, nominal_manipulator

NOMINAL = nominal_manipulator()
TIP_TOLERANCE_MM = 1e-9
seeds = st.integers(0, 2**32 - 1)


def positions(rng, count=None, share=0.99):
    """Joint positions within `share` of the limits' middle."""
    middle, half = (NOMINAL.upper + NOMINAL.lower) / 2, (NOMINAL.upper - NOMINAL.lower) / 2
    return middle + share * half * rng.uniform(-1, 1, 5 if count is None else (count, 5))


def twists(rng, rad=3e-3, mm=1.0):
    """Small twists of the axes and the flange, about the wrist as an assembly errs: about the origin they would be
    far larger there."""
    small = rng.uniform(-1, 1, (6, 6)) * np.repeat([rad, mm], 3)
    small[:, 3:] += np.cross(WRIST_MM, small[:, :3])
    return small


def manipulators(rng):
    """Nominal, with any tool, with displaced axes besides."""
    turn = Rotation.from_rotvec(rng.uniform(-0.3, 0.3, 3))
    tool = RigidTransform.from_components(np.array([0.0, -40.0, 250.0]) + rng.uniform(-60, 60, 3), turn)
    odd = replace(NOMINAL, T_flange_tool=tool)
    return NOMINAL, odd, odd.displaced(twists(rng))


def spatial_twist(after, before):
    return (after * before.inv()).as_exp_coords()


def test_at_home_the_wire_points_from_the_robot_to_the_patient():
    tool = NOMINAL.T_mcs_tool(np.zeros(5))
    assert np.allclose(tool.apply([0.0, 0.0, 1.0]) - tool.translation, [1.0, 0.0, 0.0], atol=1e-12)
    assert np.allclose(tool.translation, [500.0, 0.0, 260.0], atol=1e-9)


@pytest.mark.parametrize(
    ("joint", "towards"),
    [(LIFT, [0, 0, 1]), (TRAVERSE, [0, 1, 0]), (YAW, [0, 1, 0]), (PITCH, [0, 0, 1]), (FEED, [1, 0, 0])],
)
def test_each_joint_moves_the_tip_its_own_way(joint, towards):
    small = np.zeros(5)
    small[joint] = 1e-3
    moved = NOMINAL.T_mcs_tool(small).translation - NOMINAL.T_mcs_tool(np.zeros(5)).translation
    assert moved @ towards > 0.9 * np.linalg.norm(moved) > 0


@pytest.mark.parametrize(("side", "sign"), [("right", 1), ("left", -1)])
def test_the_frame_stands_upright_about_the_wires_line_at_the_yaw_of_a_typical_wire(side, sign):
    robot = nominal_manipulator(side)
    q = np.array([3.0, 5.0, sign * np.deg2rad(45.0), 0.0, 150.0])
    cfcs, tool = robot.T_mcs_cfcs(q), robot.T_mcs_tool(q)
    assert np.allclose(cfcs.rotation.as_matrix(), np.diag([-1.0, -1.0, 1.0]), atol=1e-12)
    assert np.allclose(cfcs.translation, tool.translation, atol=1e-9)
    caudal = cfcs.rotation.apply([0.0, sign, 0.0])
    assert tool.rotation.apply([0.0, 0.0, 1.0]) @ caudal < -0.7  # towards the head


@pytest.mark.parametrize("side", ["right", "left"])
def test_a_frame_beside_the_hip_is_mounted_so_that_the_hip_is_where_that_of_a_gamma_is(side):
    hip_mm, q = np.array([3.1, -76.8, -22.4]), np.array([7.0, -4.0, 0.7, 0.05, 30.0])
    beside, around = nominal_manipulator(side, hip_mm), nominal_manipulator(side)
    assert np.allclose(beside.T_mcs_cfcs(q).apply(hip_mm), around.T_mcs_cfcs(q).translation, atol=1e-9)
    assert np.allclose((beside.T_mcs_cfcs(q).inv() * around.T_mcs_cfcs(q)).rotation.as_rotvec(), 0.0, atol=1e-12)


def test_a_hip_has_two_sides():
    with pytest.raises(UnusableInputError, match="'right' or 'left'"):
        nominal_manipulator("middle")


def test_many_positions_are_many_poses():
    q = positions(np.random.default_rng(1), 7)
    for one in (NOMINAL.T_mcs_tool, NOMINAL.T_mcs_flange, NOMINAL.T_mcs_cfcs):
        assert np.allclose(one(q).as_matrix(), np.stack([one(each).as_matrix() for each in q]), atol=1e-12)
    for one in (NOMINAL.tool_jacobian, NOMINAL.flange_jacobian, NOMINAL.axes_jacobian):
        assert np.allclose(one(q), np.stack([one(each) for each in q]), atol=1e-9)
    with pytest.raises(UnusableInputError, match=r"\(\.\.\., 5\)"):
        NOMINAL.T_mcs_tool(np.zeros(4))


@settings(deadline=None, max_examples=30)
@given(seeds)
def test_the_inverse_undoes_the_forward(seed):
    rng = np.random.default_rng(seed)
    q = positions(rng)
    for robot in manipulators(rng):
        tool = robot.T_mcs_tool(q)
        for depth_mm in (0.0, 30.0):
            joints = robot.inverse(*tool.apply([[0.0, 0.0, -depth_mm], [0.0, 0.0, 50.0]]), depth_mm=depth_mm)
            assert np.allclose(joints, q, atol=1e-8, rtol=0)
            found = robot.T_mcs_tool(joints)
            assert np.abs(found.translation - tool.translation).max() < TIP_TOLERANCE_MM
            assert np.abs(found.rotation.as_matrix()[:, 2] - tool.rotation.as_matrix()[:, 2]).max() < 1e-11


@settings(deadline=None, max_examples=8)
@given(seeds)
def test_jacobians_are_the_derivatives(seed):
    rng = np.random.default_rng(seed)
    q, step = positions(rng), 1e-6
    for robot in manipulators(rng):
        for pose, jacobian in (("T_mcs_tool", "tool_jacobian"), ("T_mcs_flange", "flange_jacobian")):
            at = getattr(robot, pose)
            found = [spatial_twist(at(q + step * e), at(q - step * e)) / (2 * step) for e in np.eye(5)]
            assert np.allclose(getattr(robot, jacobian)(q), np.stack(found, axis=1), atol=1e-5)


@settings(deadline=None, max_examples=5)
@given(seeds)
def test_the_parameter_jacobian_is_the_derivative(seed):
    rng = np.random.default_rng(seed)
    q, step = positions(rng), 1e-6
    robot = manipulators(rng)[2]
    found = []
    for e in np.eye(24):
        after, before = (robot.displaced(sign * step * e).T_mcs_flange(q) for sign in (1, -1))
        found.append(spatial_twist(after, before) / (2 * step))
    assert np.allclose(robot.axes_jacobian(q), np.stack(found, axis=1), atol=1e-5)


def test_an_axis_displaced_along_itself_is_the_same_axis():
    small = np.zeros((6, 6))
    small[YAW] = NOMINAL.axes[YAW] * 0.1
    assert np.allclose(NOMINAL.displaced(small).axes, NOMINAL.axes, atol=1e-12)


REACHABLE = NOMINAL.T_mcs_tool(np.array([10.0, 20.0, 0.7, 0.1, 150.0])).apply([[0.0, 0.0, -50.0], [0.0, 0.0, 40.0]])


@pytest.mark.parametrize(
    ("shift", "said"),
    [
        ([0.0, 0.0, 120.0], "lift would go to 130.0 mm, 30.0 mm beyond its limit of 100.0 mm"),
        ([0.0, -150.0, 0.0], "traverse would go to -130.0 mm, 30.0 mm beyond its limit of -100.0 mm"),
        ([-300.0, 0.0, 0.0], "feed would go to -"),
    ],
)
def test_a_line_out_of_reach_names_the_joint_and_by_how_much(shift, said):
    with pytest.raises(RobotRefusedError, match=said):
        NOMINAL.inverse(*(REACHABLE + shift), depth_mm=50.0)


@pytest.mark.parametrize(
    ("direction", "said"),
    [
        ([0.3, 0.954, 0.0], r"yaw would go to 72\.5°, 12\.5° beyond its limit of 60\.0°"),
        ([-1.0, 0.0, 0.0], "points back"),
        ([0.6, 0.0, -0.8], r"pitch would go to -53\.1°, 8\.1° beyond its limit of -45\.0°"),
        ([0.0, 0.0, 1.0], "out of reach"),
        ([0.0, 1.0, 0.0], "out of reach"),
    ],
)
def test_a_direction_out_of_reach_is_refused(direction, said):
    for robot in (NOMINAL, NOMINAL.displaced(1e-9 * np.ones((6, 6)))):
        with pytest.raises(RobotRefusedError, match=said):
            robot.inverse(REACHABLE[0], REACHABLE[0] + 50 * np.array(direction))


def test_limits_are_reached_but_not_passed():
    for q in (NOMINAL.lower, NOMINAL.upper):
        tool = NOMINAL.T_mcs_tool(q)
        assert np.allclose(NOMINAL.inverse(tool.translation, tool.apply([0.0, 0.0, 10.0])), q, atol=1e-9)
        assert (NOMINAL.beyond_limits(q) == 0).all()
    assert np.allclose(NOMINAL.beyond_limits(NOMINAL.upper + 0.5), 0.5)
    assert np.allclose(NOMINAL.beyond_limits(NOMINAL.lower - 0.5), -0.5)


def test_points_that_give_no_line_are_refused():
    with pytest.raises(RobotRefusedError, match="the same"):
        NOMINAL.inverse(REACHABLE[0], REACHABLE[0])
    with pytest.raises(UnusableInputError, match="finite"):
        NOMINAL.inverse(REACHABLE[0], [np.nan, 0.0, 0.0])
    with pytest.raises(UnusableInputError, match="finite"):
        NOMINAL.inverse(REACHABLE[0], REACHABLE[1], np.nan)


def test_what_is_no_number_is_within_no_limits():
    assert np.isnan(NOMINAL.beyond_limits(np.full(5, np.nan))).all()


def test_axes_far_from_the_nominal_ones_are_refused_not_guessed():
    turned = np.zeros((6, 6))
    turned[FEED, 1] = np.pi / 2  # the slide across the wire
    robot = NOMINAL.displaced(turned)
    with pytest.raises(RobotRefusedError):
        robot.inverse(REACHABLE[0], REACHABLE[1])


def test_an_axis_must_be_a_unit_twist_without_pitch():
    for bad in (2 * NOMINAL.axes, NOMINAL.axes + np.eye(5, 6, k=2)):
        with pytest.raises(UnusableInputError, match="unit twists"):
            replace(NOMINAL, axes=bad)


def test_stopping_from_full_speed_takes_25_ms():
    assert np.allclose(NOMINAL.speed / NOMINAL.acceleration, 0.025)
