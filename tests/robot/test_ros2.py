"""The adapter for ros2_control, alone and behind the link, against a controller of ROS 2 in another process."""

import re
import time
from collections.abc import Iterator
from functools import partial
from typing import Any

import numpy as np
import pytest
from benchmarks import arm_peers
from benchmarks.arm_peers import (
    NAMESPACE,
    REACHED,
    patient,
    program,
    ros2_arm,
    ros2_commander,
    ros2_fault,
    ros2_follow,
    ros2_linked,
)
from scipy.spatial.transform import Rotation
from tests.robot.test_franka import going

from sightline.errors import RobotRefusedError

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not arm_peers.ROS2, reason="ROS 2 is not installed: make ros2"),
    pytest.mark.filterwarnings("ignore::DeprecationWarning"),  # of the parser of ROS 2's messages
]


@pytest.fixture(autouse=True)
def local(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("ROS_AUTOMATIC_DISCOVERY_RANGE", "ROS_DOMAIN_ID"):
        monkeypatch.setenv(name, "")  # restored afterwards
    arm_peers.ros2_local()


@pytest.fixture
def controller() -> Iterator[Any]:
    with program("ros2_controller", NAMESPACE) as (process, _):
        yield process


def test_trajectories_are_followed_by_messages_that_rest_within_a_tenth_of_a_second() -> None:
    with patient():
        errors, log = ros2_follow(4)
    assert np.abs(errors).max() < REACHED
    assert not len(log["refused"])
    assert (log["rests_s"] - log["came_s"]).max() < 0.1001


def test_an_arm_behind_the_link_brings_its_guide_to_the_plan_and_holds_it() -> None:
    with patient(), ros2_linked() as (_, linked):
        linked.client.align()
        linked.client.guide()
        off_mm, off_deg = linked.off(linked.robot.manipulator.T_mcs_flange(linked.arm.state().encoders))
        assert off_mm < 0.05
        assert off_deg < 0.02
        assert linked.client.status().text.startswith("GUIDE")


def test_guide_target_and_verdict_are_published_in_metres() -> None:
    import rclpy
    from geometry_msgs.msg import PoseStamped
    from std_msgs.msg import String

    from sightline.cli.robot.commands import published_poses
    from sightline.robot.arms.ros2_poses import Ros2Poses

    received: dict[str, Any] = {}
    with patient(), ros2_linked() as (_, linked), Ros2Poses(NAMESPACE, partial(published_poses, linked.machine)):
        context = rclpy.Context()
        context.init()
        node = rclpy.create_node("listener", context=context)
        executor = rclpy.executors.SingleThreadedExecutor(context=context)
        executor.add_node(node)
        for name, kind in (("tool", PoseStamped), ("target", PoseStamped), ("status", String)):
            keep = partial(received.__setitem__, name)
            node.create_subscription(kind, f"{NAMESPACE}/sightline/{name}", keep, 1)
        ends_s = time.monotonic() + arm_peers.PATIENCE_S
        while len(received) < 3 and time.monotonic() < ends_s:
            executor.spin_once(timeout_sec=1.0)
        executor.shutdown()
        node.destroy_node()
        context.try_shutdown()
        manipulator, q = linked.robot.manipulator, linked.machine.q
    T_mcs_cfcs = manipulator.T_mcs_cfcs(linked.home)
    expected = {"tool": manipulator.T_mcs_tool(q).translation, "target": T_mcs_cfcs.apply(arm_peers.END_MM)}
    for name, at_mm in expected.items():
        header, pose = received[name].header, received[name].pose
        assert header.frame_id == "base_link"
        place = pose.position
        # Of the arm at rest, or as the inverse finds it.
        np.testing.assert_allclose(1000 * np.array([place.x, place.y, place.z]), at_mm, atol=0.01)
    turn = received["target"].pose.orientation
    along = Rotation.from_quat([turn.x, turn.y, turn.z, turn.w]).apply([0.0, 0.0, 1.0])
    np.testing.assert_allclose(along, T_mcs_cfcs.rotation.apply(linked.along), atol=1e-6)
    assert received["status"].data == "TARGETING; no plan"


@pytest.mark.parametrize(
    ("fault", "text"),
    [
        ("killed", "no sample from the drives"),
        ("silent", "no sample from the drives"),
        ("late", "no sample from the drives|s old"),
        ("frozen", "no sample from the drives|s old"),
        ("nan", "joint 4 is at nan"),
        ("degrees", "not in rad and m"),
        ("renamed", "reports joint 6, tool0, joint 4"),
        ("fewer", "the arm has joint 1"),
    ],
)
def test_a_fault_is_named_and_nothing_moves_on(fault: str, text: str) -> None:
    found = ros2_fault(fault)
    assert re.search(text, found.text)
    assert found.moved < 0.1  # rad; in a second it would move on by 0.26


def test_the_arm_stops_if_this_program_dies() -> None:
    assert ros2_commander() < 0.1001


def test_what_cannot_be_followed_is_refused(controller: Any) -> None:
    with ros2_arm() as arm:
        q = arm.state().encoders
        with pytest.raises(RobotRefusedError, match=r"and the trajectory begins at"):
            arm.follow(going(np.zeros(7), q + 0.1))
        with ros2_arm(), pytest.raises(RobotRefusedError, match="another program sends trajectories"):
            arm.follow(going(np.zeros(7), q))


def test_without_joint_states_or_a_name_there_is_no_arm(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(RobotRefusedError, match="no joint states at sightline_test/joint_states"), ros2_arm():
        pass
    monkeypatch.setattr(arm_peers, "NAMESPACE", "two words")
    with pytest.raises(RobotRefusedError, match="not usable as a ROS 2 namespace"), ros2_arm():
        pass
