"""An arm calibrated by images: poses that tell where a block is on its flange, and the robot of its mount."""

import json
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest
from benchmarks.scenes.held import SD, c_arm, seen
from scipy.spatial.transform import RigidTransform, Rotation
from tests.robot.arms import SIX, at_images, longer

from sightline.common.checks import Limits
from sightline.errors import CalibrationRefusedError, RobotRefusedError, UnusableInputError
from sightline.from_images.arm import calibrated_on_arm
from sightline.rehearsal.arm_images import BlockOnArm, sample_block
from sightline.robot.kinematics.by_images import propose_poses, refuse_alike
from sightline.robot.kinematics.calibrated import SOURCES
from sightline.robot.kinematics.measured import FlangePose, Measurements, RobotFile
from sightline.robot.kinematics.target import PlanIdentity, RobotTarget, robot_target

START = RigidTransform.from_components([400.0, 10.0, 300.0], Rotation.from_rotvec([2.0, 0.3, -0.1]))
BLOCK_MM = np.array([10.0, 50.0, 70.0])


@pytest.mark.parametrize("count", [8, 12, 15])
def test_the_block_stays_in_the_field_and_rotates_about_all_axes(count):
    poses = propose_poses(START, BLOCK_MM, 20.0, count)
    refuse_alike(poses)
    assert len(poses) == count
    moved = poses.apply(BLOCK_MM) - START.apply(BLOCK_MM)
    assert np.linalg.norm(moved, axis=1) == pytest.approx(20.0)
    turns = (START.rotation.inv() * poses.rotation).as_rotvec()
    assert np.linalg.norm(turns, axis=1) == pytest.approx(np.radians(30.0))
    assert np.linalg.svd(turns, compute_uv=False)[2] / np.sqrt(count) > np.radians(15.0)


def test_where_the_arm_may_not_go_it_rotates_less_or_not():
    def allowed(pose):
        return pose.translation[2] < START.translation[2] + 20.0

    poses = propose_poses(START, BLOCK_MM, 20.0, 15, allowed=allowed)
    assert 8 <= len(poses) <= 15
    assert all(allowed(pose) for pose in poses)
    with pytest.raises(RobotRefusedError, match="0 of 12 poses"):
        propose_poses(START, BLOCK_MM, 20.0, allowed=lambda _: False)


def test_poses_that_leave_the_block_s_place_open_are_refused():
    about_one = [START * RigidTransform.from_rotation(Rotation.from_rotvec([0.0, a, 0.0])) for a in (-0.4, 0.0, 0.4)]
    with pytest.raises(RobotRefusedError, match=r"18\.7° about one axis and by 0\.0°"):
        refuse_alike(RigidTransform.concatenate(about_one))
    with pytest.raises(RobotRefusedError, match="too alike"):
        propose_poses(START, BLOCK_MM, 20.0, rotation=0.05)
    with pytest.raises(UnusableInputError, match="8 to 15"):
        propose_poses(START, BLOCK_MM, 20.0, 6)


MOUNT = RigidTransform.from_exp_coords([0.4, -0.3, 2.1, 20.0, 60.0, 150.0])
# Larger than in use, so that none hides behind the deflection.
MOUNT_SD = np.array([3e-3, 2e-3, 5e-3, 0.3, 0.8, 0.5])
POSE_SD, WIRE_MM, FEED_MM, FEED_SD = np.array([5e-4] * 3 + [0.15] * 3), 0.3, 60.0, 1.0
STATED = np.diag([4e-3, 3e-3, 3e-3, 1.2, 0.7, 0.8]) ** 2
Q = at_images(SIX)
AT = SIX.T_mcs_flange(Q)
IDENTITY = PlanIdentity("plan-1", "right", "SN-7", go=True)
NOW_S = 1.7e9


def mount_file(folder: Path, mount: RigidTransform = MOUNT, *, by_pose: bool = False, **changed) -> None:
    """As `robot calibrate --from-images` writes it, of an error that is larger along one axis than along another."""
    joints = {"q": Q.tolist(), "T_base_flange": AT.as_matrix().tolist()}
    said = {
        "schema": "sightline-mount/1",
        "robot_serial": "R-1",
        "measured_on": "2026-11-20T10:00:00Z",
        "frame": {"name": "block60", "serial": "SN-7", "fingerprint": "block60/SN-7#1"},
        "joints": None if by_pose else joints,
        "pose_sd": {"mm": POSE_SD[3], "rad": POSE_SD[0]},
        "T_flange_cfcs": mount.as_matrix().tolist(),
        "covariance": np.diag(MOUNT_SD**2).tolist(),
        "c_arm": {"focal_px": 5000.0},
    }
    (folder / "mount.json").write_text(json.dumps(said | changed))


def measured(folder: Path, **changed) -> Measurements:
    said = {
        "schema": "sightline-robot-measurements/1",
        "robot_serial": "R-1",
        "frame_serial": "SN-7",
        "side": "right",
        "arm": "six-axis",
        "measured_on": "2026-11-22T10:00:00Z",
        "frame": {"mount": "mount.json"},
        "wire": {"plan": "plan.json", "feed_mm": FEED_MM, "sd_mm": FEED_SD},
    }
    (folder / "measured.json").write_text(json.dumps(said | changed))
    return Measurements.read(folder / "measured.json")


def pose_file(folder: Path, pose: RigidTransform = AT, **changed) -> Path:
    """Where the flange is at the images, as another program tells it."""
    said = {
        "schema": "sightline-flange-pose/1",
        "measured_on": datetime.fromtimestamp(NOW_S, UTC).isoformat(),
        "T_base_flange": pose.as_matrix().tolist(),
        "covariance": STATED.tolist(),
    }
    (folder / "pose.json").write_text(json.dumps(said | changed))
    return folder / "pose.json"


def in_frame(tool: RigidTransform, mount: RigidTransform) -> np.ndarray:
    """(2, 3), CFCS: a point of the wire in the guide, and its tip that stands out of the mouth."""
    return (mount.inv() * tool).apply([[0.0, 0.0, FEED_MM - 45.0], [0.0, 0.0, FEED_MM]])


def moved(rng: np.random.Generator, covariance: np.ndarray) -> RigidTransform:
    return RigidTransform.from_exp_coords(np.linalg.cholesky(covariance) @ rng.standard_normal(6))


def worst_rotation(target: RobotTarget) -> np.ndarray:
    """The joints (6,) of those that the robot may choose whose error the target states."""
    stood, points = target.registration, np.stack([target.entry_mm, target.end_mm])

    def total(q: np.ndarray) -> float:
        return np.trace(sum(stood.robot.wire_against_frame(stood.q, q, points, stood.stated).values()))

    return max((target.q, *stood.robot.manipulator.turned(target.q)), key=total)


@pytest.mark.slow
def test_the_guide_errs_as_the_target_of_an_arm_calibrated_by_images_states(tmp_path):
    """From files to the target: mount, wire in the images, poses and deflection are drawn, the plan itself is right;
    every other arm tells its pose at the images, not its joints. A program that forgets the error of one of them, or
    that guide and block share the mount's, fails."""
    rng, squares = np.random.default_rng(8), []
    for by_pose in 20 * [False, True]:
        mount, tool = (moved(rng, np.diag(MOUNT_SD**2)) * MOUNT, moved(rng, 1e-4 * np.eye(6)) * SIX.T_flange_tool)
        mount_file(tmp_path, by_pose=by_pose)
        seen = in_frame(tool, mount) + WIRE_MM * rng.standard_normal((2, 3))
        told = FEED_MM + FEED_SD * rng.standard_normal()
        wire = {"plan": "plan.json", "feed_mm": told, "sd_mm": FEED_SD}
        robot, _ = RobotFile.calibrated(measured(tmp_path, wire=wire), tmp_path, (seen, WIRE_MM**2 * np.eye(6)))
        unseen = np.diag(np.array(robot.compliance_sd) ** 2)
        stated = STATED if by_pose else np.diag(POSE_SD**2)
        at = FlangePose.read(pose_file(tmp_path))
        for view in ("pa", "lateral"):
            robot = robot.at_image(view, at if by_pose else Q, NOW_S, "image.png")
        robot = RobotFile.model_validate_json(robot.model_dump_json(by_alias=True))
        stood = robot.registration()
        entry = stood.T_mcs_cfcs.inv().apply(stood.robot.manipulator.along(Q, 80.0).translation)
        end = stood.T_mcs_cfcs.inv().apply(stood.robot.manipulator.along(Q, 150.0).translation)
        points = np.stack([entry, end])
        target = robot_target(IDENTITY, points, {"planning": np.zeros((6, 6))}, stood, Limits())
        then = AT * moved(rng, stated) * moved(rng, unseen) * mount
        now = SIX.T_mcs_flange(worst_rotation(target)) * moved(rng, np.diag(POSE_SD**2)) * moved(rng, unseen) * tool
        depths = target.standoff_mm + np.array([0.0, target.length_mm])
        off = (now.apply(np.outer(depths, [0.0, 0.0, 1.0])) - then.apply(points)).ravel()
        covariance = np.sum([target.budget_mm2[source] for source in SOURCES], axis=0)
        values, axes = np.linalg.eigh(covariance)
        squares.append((axes[:, 1:].T @ off) ** 2 / values[1:])  # the wire is rigid: its length has no error
    for half in (squares[::2], squares[1::2]):
        assert np.abs(np.mean(half, axis=0) - 1).max() < 0.89  # 2.8 s.d. of a variance of 20
        assert abs(np.mean(half) - 1) < 0.30  # 2 s.d. of 100 numbers


def test_the_robot_s_file_of_an_arm_calibrated_by_images(tmp_path):
    """Its axes are the model's, it is as old as its images, and knows its block's file and a knock on the block."""
    mount_file(tmp_path, covariance=np.diag(POSE_SD**2 / 10).tolist())
    tips = SIX.T_flange_tool.apply(np.outer([0.0, 50.0], [0.0, 0.0, 1.0])).tolist()
    wire = {"sd_mm": 0.1, "feed_mm": [0, 50], "tip_flange_mm": tips}
    robot, rms = RobotFile.calibrated(measured(tmp_path, wire=wire), tmp_path)
    known = robot.robot()
    assert set(rms) == {"wire"}
    assert np.allclose(known.manipulator.T_mcs_flange(Q).as_matrix(), AT.as_matrix())
    assert np.allclose(known.manipulator.T_flange_cfcs.as_matrix(), MOUNT.as_matrix())
    assert robot.measured_on == datetime(2026, 11, 20, 10, tzinfo=UTC)
    assert robot.of_frame("SN-7", "block60/SN-7#1").frame == "block60/SN-7#1"
    with pytest.raises(RobotRefusedError, match="give the same file"):
        robot.of_frame("SN-7", "block60/SN-7#2")
    seen = in_frame(known.manipulator.T_flange_tool, known.manipulator.T_flange_cfcs)
    with pytest.raises(RobotRefusedError, match="Frame or wire moved"):  # knocked by 1 mm since
        known.with_wire_seen(Q, seen + np.eye(3)[0], 0.05**2 * np.eye(6))
    known.with_wire_seen(Q, seen, 0.05**2 * np.eye(6))
    further = known.with_wire_seen(Q, seen + (seen[1] - seen[0]) / 6, 0.05**2 * np.eye(6))  # how far it stands out
    assert np.allclose(further.manipulator.T_flange_tool.as_matrix(), known.manipulator.T_flange_tool.as_matrix())
    with pytest.raises(RobotRefusedError, match="another arm"):
        RobotFile.calibrated(measured(tmp_path, wire=wire, arm="seven-axis"), tmp_path)
    axes = {"sd_mm": 0.1, "q": [Q.tolist()], "targets_mm": [[[0, 0, 0]]]}
    with pytest.raises(UnusableInputError, match="both measured by a tracker"):
        RobotFile.calibrated(measured(tmp_path, wire=wire, axes=axes), tmp_path)


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"robot_serial": "R-2"}, "frame 'SN-7' on robot 'R-2'"),
        ({"frame": {"name": "block60", "serial": "SN-8", "fingerprint": "x"}}, "frame 'SN-8'"),
        ({"T_flange_cfcs": np.diag([1.0, 1.0, 2.0, 1.0]).tolist()}, "not a rigid motion"),
        ({"covariance": np.tri(6).tolist()}, "not symmetric"),
        ({"pose_sd": {"mm": 0.0, "rad": 1e-4}}, "pose_sd.mm"),
        ({"schema": "sightline-mount/2"}, "schema"),
    ],
)
def test_a_mount_of_something_else_is_refused(tmp_path, changed, said):
    mount_file(tmp_path, **changed)
    with pytest.raises((RobotRefusedError, UnusableInputError), match=said):
        RobotFile.calibrated(measured(tmp_path), tmp_path, (np.eye(2, 3) * 50.0, np.eye(6)))


NOT_A_NUMBER = AT.as_matrix()
NOT_A_NUMBER[0, 3] = np.nan


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"T_base_flange": NOT_A_NUMBER.tolist()}, "finite number"),
        ({"T_base_flange": (1.01 * AT.as_matrix()).tolist()}, "not a rigid motion"),
        ({"T_base_flange": (AT.as_matrix() * [[-1], [1], [1], [1]]).tolist()}, "left-handed"),
        ({"T_base_flange": (AT.as_matrix() * [1, 1, 1, 1e-3] + np.diag([0, 0, 0, 0.999])).tolist()}, "in mm, not in m"),
        ({"covariance": np.diag([1e-8] * 5 + [0.0]).tolist()}, "larger than 0"),
        ({"covariance": np.diag([1e-2] * 3 + [400.0] * 3).tolist()}, "10 mm at most"),
        ({"covariance": (1e-4 * np.tri(6)).tolist()}, "not symmetric"),
        ({"measured_on": None}, "measured_on"),
    ],
)
def test_a_pose_that_is_wrong_is_refused(tmp_path, changed, said):
    with pytest.raises(UnusableInputError, match=said):
        FlangePose.read(pose_file(tmp_path, **changed))


def test_an_arm_is_registered_as_it_was_calibrated(tmp_path):
    """By joints or by poses; a pose puts the frame where it says, and moves no further than a robot at rest."""
    wire = (in_frame(SIX.T_flange_tool, MOUNT), 1e-4 * np.eye(6))
    mount_file(tmp_path)
    by_joints, _ = RobotFile.calibrated(measured(tmp_path), tmp_path, wire)
    mount_file(tmp_path, by_pose=True)
    by_pose, _ = RobotFile.calibrated(measured(tmp_path), tmp_path, wire)
    for robot, at in ((by_joints, FlangePose.read(pose_file(tmp_path))), (by_pose, Q)):
        with pytest.raises(RobotRefusedError, match="register it by"):
            robot.at_image("pa", at, NOW_S, "image.png")
    robot = by_pose.at_image("pa", FlangePose.read(pose_file(tmp_path)), NOW_S, "image.png")
    with pytest.raises(RobotRefusedError, match="moved between the images"):
        further = RigidTransform.from_translation([0.0, 0.2, 0.0]) * AT
        robot.at_image("lateral", FlangePose.read(pose_file(tmp_path, further)), NOW_S, "image.png")
    with pytest.raises(RobotRefusedError, match="out of reach"):
        far = RigidTransform.from_translation([2000.0, 0.0, 0.0]) * AT
        robot.at_image("pa", FlangePose.read(pose_file(tmp_path, far)), NOW_S, "image.png")
    nearly = RigidTransform.from_translation([0.0, 0.02, 0.0]) * AT
    robot = robot.at_image("lateral", FlangePose.read(pose_file(tmp_path, nearly)), NOW_S, "image.png")
    found = robot.registration()
    assert np.allclose(found.of_view["lateral"].as_matrix(), (nearly * MOUNT).as_matrix(), atol=1e-6)
    half = RigidTransform.from_translation([0.0, 0.01, 0.0]) * AT * MOUNT
    assert np.allclose(found.T_mcs_cfcs.translation, half.translation, atol=1e-4)
    assert np.allclose(found.stated, STATED)


@pytest.mark.parametrize("spoil", ["another arm", "order"])
def test_images_at_joints_of_another_arm_or_order_are_refused(tmp_path, spoil):
    """The same images with the right joints are accepted: `test_held` has them."""
    rng = np.random.default_rng(15)
    held = BlockOnArm.draw(rng, sample_block())
    images = seen(held, rng)
    q = np.array([SIX.inverse_pose(pose * SIX.T_flange_tool, Q) for pose in held.stated])
    wrong = longer(SIX).T_mcs_flange(q) if spoil == "another arm" else SIX.T_mcs_flange(q[:, [0, 1, 2, 4, 3, 5]])
    with pytest.raises(CalibrationRefusedError, match=r"contradict the others.*by the model of this arm"):
        calibrated_on_arm(images, sample_block(), wrong, SD, c_arm(held))
