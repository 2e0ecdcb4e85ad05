"""Poses at which images tell where a block is on the flange."""

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from sightline.errors import RobotRefusedError, UnusableInputError
from sightline.robot.kinematics.by_images import propose_poses, refuse_alike

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
