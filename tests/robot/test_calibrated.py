"""What a robot's calibration leaves open, at the wire: proved by sampling."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform

from sightline.calibration import calibrate
from sightline.common.geometry.covariance import length_quantile, line_direction
from sightline.errors import RobotRefusedError, UnusableInputError
from sightline.frame import Frame
from sightline.planning import reconstruct
from sightline.rehearsal.operation import calibrated_robot, true_manipulator
from sightline.robot.kinematics.calibrated import MACHINED_SD, REMOUNT_SD, SOURCES, CalibratedRobot, calibrate_axes
from sightline.robot.kinematics.designs import nominal_manipulator
from sightline.robot.kinematics.manipulator import Manipulator
from sightline.studies.scenes import VIEWS, measure
from sightline.twin import draw_setup

READY = np.array([5.0, -8.0, 0.7, 0.1, 20.0])
IMAGED = np.array([-12.0, 15.0, 0.75, -0.05, 0.0])
TARGETS_MM = np.array([[40.0, 10.0, -20.0], [-35.0, 25.0, 30.0], [5.0, -50.0, 60.0]])


def test_the_wire_errs_as_stated():
    robot, rng = calibrated_robot(), np.random.default_rng(1)
    manipulator = robot.manipulator
    wire = manipulator.T_mcs_tool(READY).apply([[0.0, 0.0, -95.0], [0.0, 0.0, 0.0]])
    stated = robot.wire_against_frame(IMAGED, READY, wire)
    covariance = np.sum([stated[source] for source in SOURCES], axis=0)
    errors = np.array([_off(robot, true_manipulator(robot, rng), wire, rng) for _ in range(200)])
    values, axes = np.linalg.eigh(covariance)
    ratio = (errors @ axes[:, 1:]).var(axis=0) / values[1:]  # 5: the wire is rigid, its length does not err
    assert np.abs(ratio - 1).max() < 0.4  # 4 s.d. of a variance of 200
    assert values[0] < 1e-3 * values[1]


def _off(robot, true: Manipulator, wire_mm: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """(6,): where the true wire is less where it should be, in the frame as the robot believes it stands."""
    play = robot.joint_sd * np.sqrt(3)  # uniform
    unseen = [RigidTransform.from_exp_coords(robot.compliance_sd * rng.standard_normal(6)) for _ in range(2)]
    imaged, ready = (q + rng.uniform(-play, play) for q in (IMAGED, READY))
    frame = true.T_mcs_flange(imaged) * unseen[0] * true.T_flange_cfcs
    wire = true.T_mcs_flange(ready) * unseen[1] * (true.T_mcs_flange(ready).inv() * true.T_mcs_tool(ready))
    in_frame = (frame.inv() * wire).apply([[0.0, 0.0, -95.0], [0.0, 0.0, 0.0]])
    return (robot.manipulator.T_mcs_cfcs(IMAGED).apply(in_frame) - wire_mm).ravel()


def test_the_frame_moved_as_stated():
    """Rotation and shift of a patient at rest, of which only the encoders' readings are known."""
    robot, rng = calibrated_robot(frame=Frame.load("block60")), np.random.default_rng(2)
    about, errors = np.array([10.0, -20.0, -30.0]), []
    motion, covariance = robot.frame_moved(IMAGED, READY, about)
    play = robot.joint_sd * np.sqrt(3)  # uniform
    for _ in range(200):
        true, stood = true_manipulator(robot, rng), []
        for q in (IMAGED, READY):
            unseen = RigidTransform.from_exp_coords(robot.compliance_sd * rng.standard_normal(6))
            stood.append(true.T_mcs_flange(q + rng.uniform(-play, play)) * unseen * true.T_flange_cfcs)
        remount = RigidTransform.from_exp_coords(REMOUNT_SD * rng.standard_normal(6))
        off = (stood[1] * remount).inv() * stood[0]
        turned = (off.rotation * motion.rotation.inv()).as_rotvec()
        errors.append(np.concatenate([turned, off.apply(about) - motion.apply(about)]))
    values, axes = np.linalg.eigh(covariance)
    ratio = (np.array(errors) @ axes).var(axis=0) / values
    assert np.abs(ratio - 1).max() < 0.4  # 4 s.d. of a variance of 200


def test_a_robot_that_stays_where_it_was_owes_nothing_to_its_axes():
    robot = calibrated_robot()
    wire = robot.manipulator.T_mcs_tool(READY).apply([[0.0, 0.0, -95.0], [0.0, 0.0, 0.0]])
    still, moved = (robot.wire_against_frame(imaged, READY, wire)["kinematics"] for imaged in (READY, IMAGED))
    assert np.abs(still).max() < 1e-20
    assert np.trace(moved) > 1e-4


SEEN_MM = np.array([[0.0, 0.0, -60.0], [0.0, 0.0, 0.0]])  # a point of the wire and its tip, tool coordinates


def wire_in_frame(manipulator: Manipulator, q: np.ndarray) -> np.ndarray:
    """(2, 3), CFCS."""
    return (manipulator.T_mcs_cfcs(q).inv() * manipulator.T_mcs_tool(q)).apply(SEEN_MM)


def _mounts_mm2(robot: CalibratedRobot, q: np.ndarray) -> np.ndarray:
    """(6, 6): of the wire's two points by the mounts of frame and wire."""
    parts = robot.wire_against_frame(q, q, robot.manipulator.T_mcs_tool(q).apply(SEEN_MM))
    return parts["hand_eye"] + parts["drill_axis"]


def test_a_wire_seen_beside_the_frame_covers_as_stated():
    """Frame and wire as images of 0.1 mm correct them, against the truth: 150 robots, each at joints of its own."""
    robot, rng, image_mm = calibrated_robot(), np.random.default_rng(7), 0.1
    covered, bounds, before = [], [], []
    for trial in range(150):
        true, q = true_manipulator(robot, rng), IMAGED + np.array([20.0, 20.0, 0.1, 0.1, 40.0]) * rng.uniform(0, 1, 5)
        fed = q + np.array([0, 0, 0, 0, robot.joint_sd[4]]) * np.sqrt(3) * rng.uniform(-1, 1, 5)
        slid = np.array([0.0, 0.0, rng.uniform(-3.0, 3.0)])  # the point is not known along the wire
        seen = wire_in_frame(true, fed)
        seen[0] += slid[2] * (seen[1] - seen[0]) / np.linalg.norm(seen[1] - seen[0])
        found = robot.with_wire_seen(q, seen + image_mm * rng.standard_normal((2, 3)), image_mm**2 * np.eye(6))
        line, stated = line_direction(*found.manipulator.T_mcs_tool(q).apply(SEEN_MM)), _mounts_mm2(found, q)
        to_mcs = found.manipulator.T_mcs_cfcs(q).rotation
        off = to_mcs.apply(wire_in_frame(found.manipulator, q) - wire_in_frame(true, q)).ravel()
        bound = [length_quantile(c) for c in (stated[3:, 3:], line @ stated @ line.T)]
        covered.append([np.linalg.norm(off[3:]) < bound[0], np.linalg.norm(line @ off) < bound[1]])
        bounds.append([bound[0], np.rad2deg(bound[1])])
        if trial < 10:
            before.append(length_quantile(_mounts_mm2(robot, q)[3:, 3:]))
    assert np.abs(np.mean(covered, axis=0) - 0.95).max() < 0.053  # 3 s.d. of 150
    tip_mm, direction_deg = np.max(bounds, axis=0)
    assert tip_mm < 0.3
    assert direction_deg < 0.2
    assert np.min(before) > 1.1 * tip_mm


@pytest.mark.slow
def test_images_of_a_block_on_the_guide_correct_the_mounts_as_stated():
    """The whole chain: balls of 0.05 px, both views calibrated, mouth and tip picked with 0.5 px, against the truth."""
    robot, q, block = calibrated_robot(), IMAGED + np.array([0.0, 0.0, 0.0, 0.0, 100.0]), Frame.load("block30")
    known = robot.manipulator
    beside_mm = known.T_flange_tool.apply([0.0, 0.0, 100.0]) + np.array([0.0, 60.0, -20.0])
    held = RigidTransform.from_components(beside_mm, known.T_flange_cfcs.rotation)
    robot, rng, covered = replace(robot, manipulator=replace(known, T_flange_cfcs=held)), np.random.default_rng(5), []
    for _ in range(20):
        true, setup = true_manipulator(robot, rng), draw_setup(rng, block)
        wire, balls = wire_in_frame(true, q), measure(rng, setup, 0.05)
        uv = np.stack([setup.views[name].project(wire) for name in VIEWS]) + 0.5 * rng.standard_normal((2, 2, 2))
        views = [calibrate(balls[name], setup.frame, view=name) for name in VIEWS]
        seen = reconstruct(views, uv, np.broadcast_to(0.25 * np.eye(2), (2, 2, 2, 2)))
        assert seen.joint_covariance_mm2 is not None
        found = robot.with_wire_seen(q, seen.xyz_mm, seen.joint_covariance_mm2)
        bound = length_quantile(_mounts_mm2(found, q)[3:, 3:])
        covered.append(np.linalg.norm(wire_in_frame(found.manipulator, q)[1] - wire[1]) < bound)
        assert bound < 0.3
    assert np.mean(covered) > 0.80  # 95 % less 3 s.d. of 20


def test_a_frame_that_was_knocked_on_the_flange_is_refused():
    robot, fine = calibrated_robot(), 0.05**2 * np.eye(6)
    seen = wire_in_frame(robot.manipulator, IMAGED)
    robot.with_wire_seen(IMAGED, seen + 0.1, fine)
    along = (seen[1] - seen[0]) / 60.0
    robot.with_wire_seen(IMAGED, seen - np.outer([30.0, 0.0], along), fine)  # another point of the same wire
    for moved in (np.array([0.0, 1.5, 0.0]), -1.5 * along, np.array([[1.5, 0.0, 0.0], [0.0, 0.0, 0.0]])):
        with pytest.raises(RobotRefusedError, match="images and encoders disagree"):
            robot.with_wire_seen(IMAGED, seen + moved, fine)
    with pytest.raises(UnusableInputError, match="behind the wire's tip"):
        robot.with_wire_seen(IMAGED, seen[::-1], fine)


def measured(true: Manipulator, rng: np.random.Generator, sd: float, n: int = 30) -> tuple[np.ndarray, np.ndarray]:
    q = rng.uniform(0.9 * true.lower, 0.9 * true.upper, (n, 5))
    targets = np.stack([true.T_mcs_flange(q).apply(place) for place in TARGETS_MM], axis=1)
    return q, targets + sd * rng.standard_normal(targets.shape)


def test_calibrated_axes_put_the_flange_where_it_is():
    nominal, rng, sd = nominal_manipulator("right"), np.random.default_rng(2), 0.03
    squares, before, after = [], [], []
    for _ in range(12):
        true = nominal.displaced(np.pad(MACHINED_SD * rng.standard_normal((4, 6)), ((0, 2), (0, 0))))
        found = calibrate_axes(nominal, *measured(true, rng, sd), sd)
        q = rng.uniform(0.8 * true.lower, 0.8 * true.upper)
        # Targets fix the flange but for a turn of all, which mounts measured on it take up: compare two poses.
        off, was = (_between(one, READY, q) - _between(true, READY, q) for one in (found.manipulator, nominal))
        before.append(was)
        after.append(off)
        jacobian = np.stack([_derivative(found.manipulator, q, k) for k in range(24)], axis=1)
        squares.append(off @ np.linalg.solve(jacobian @ found.covariance @ jacobian.T + 1e-12 * np.eye(3), off) / 3)
    assert np.linalg.norm(after, axis=1).mean() < 0.1 * np.linalg.norm(before, axis=1).mean()
    assert abs(np.mean(squares) - 1) < 0.71  # 3 s.d. of 12 trials of 3 numbers


def _between(manipulator: Manipulator, one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """(3,): a place ahead of the flange at one pose, in the flange's coordinates at another."""
    return (manipulator.T_mcs_flange(one).inv() * manipulator.T_mcs_flange(other)).apply([0.0, -40.0, 400.0])


def _derivative(manipulator: Manipulator, q: np.ndarray, number: int) -> np.ndarray:
    twists = np.zeros(36)
    twists[number] = 1e-6
    return (_between(manipulator.displaced(twists.reshape(6, 6)), READY, q) - _between(manipulator, READY, q)) / 1e-6


def test_measurements_that_no_manipulator_made_are_refused():
    nominal, rng = nominal_manipulator("right"), np.random.default_rng(3)
    q, targets = measured(nominal, rng, 0.03)
    with pytest.raises(RobotRefusedError, match=r"measured targets|converge"):
        calibrate_axes(nominal, q, targets[::-1], 0.03)
    with pytest.raises(RobotRefusedError, match=r"measured targets|converge"):
        calibrate_axes(nominal, q, targets / 1000, 0.03)
    with pytest.raises(UnusableInputError, match="more poses"):
        calibrate_axes(nominal, q[:2], targets[:2], 0.03)
    with pytest.raises(UnusableInputError, match="finite"):
        calibrate_axes(nominal, q, np.where(targets > 400, np.nan, targets), 0.03)
