"""The adapter for ros2_control, alone and behind the link, against a controller of ROS 2 in another process; and what
`--serve` shows, read in another node."""

import os
import re
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any

import cv2
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
from scipy.spatial.transform import RigidTransform, Rotation
from tests.case.test_live import FAILED
from tests.case.test_live_ros2 import BAD, GO, GOOD, bone, live, pose
from tests.case.test_watch import ENTRY_END_MM, planned_view, shown
from tests.robot.test_franka import going

from sightline.calibration.maps.undistort import undistort
from sightline.case.live import LIVE, LiveState
from sightline.case.live_ros2 import LiveTopics
from sightline.cli.base import Output, serving
from sightline.errors import RobotRefusedError
from sightline.robot.igtl import Status

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


@contextmanager
def heard(kinds: dict[str, Any]) -> Iterator[tuple[Any, dict[str, list[Any]]]]:
    """Another node, which reads topics: `until(condition)` reads on into the lists of messages, by topic."""
    import rclpy

    context = rclpy.Context()
    context.init()
    node = rclpy.create_node("listener", context=context)
    executor = rclpy.executors.SingleThreadedExecutor(context=context)
    executor.add_node(node)
    received: dict[str, list[Any]] = {topic: [] for topic in kinds}
    for topic, kind in kinds.items():
        node.create_subscription(kind, topic, received[topic].append, 1)

    def until(condition: Any) -> None:
        ends_s = time.monotonic() + arm_peers.PATIENCE_S
        while not condition():
            assert time.monotonic() < ends_s, {topic: len(messages) for topic, messages in received.items()}
            executor.spin_once(timeout_sec=1.0)

    try:
        yield until, received
    finally:
        executor.shutdown()
        node.destroy_node()
        context.try_shutdown()


def test_guide_target_and_verdict_are_published_in_metres() -> None:
    from geometry_msgs.msg import PoseStamped
    from std_msgs.msg import String

    from sightline.cli.robot.commands import published_poses
    from sightline.robot.transport.ros2 import Ros2Broadcast

    below = f"{NAMESPACE}/sightline"
    kinds = {f"{below}/tool": PoseStamped, f"{below}/target": PoseStamped, f"{below}/status": String}
    with patient(), ros2_linked() as (_, linked):
        poses = partial(published_poses, linked.machine)
        with Ros2Broadcast(below, poses, "sightline_poses"), heard(kinds) as (until, received):
            until(lambda: all(received.values()))
        manipulator, q = linked.robot.manipulator, linked.machine.q
    T_mcs_cfcs = manipulator.T_mcs_cfcs(linked.home)
    expected = {"tool": manipulator.T_mcs_tool(q).translation, "target": T_mcs_cfcs.apply(arm_peers.END_MM)}
    for name, at_mm in expected.items():
        message = received[f"{below}/{name}"][-1]
        header, pose = message.header, message.pose
        assert header.frame_id == "base_link"
        place = pose.position
        # Of the arm at rest, or as the inverse finds it.
        np.testing.assert_allclose(1000 * np.array([place.x, place.y, place.z]), at_mm, atol=0.01)
    turn = received[f"{below}/target"][-1].pose.orientation
    along = Rotation.from_quat([turn.x, turn.y, turn.z, turn.w]).apply([0.0, 0.0, 1.0])
    np.testing.assert_allclose(along, T_mcs_cfcs.rotation.apply(linked.along), atol=1e-6)
    assert received[f"{below}/status"][-1].data == "TARGETING; no plan"


def pose_of(place: Any, turn: Any) -> RigidTransform:
    """Return a pose of ROS 2, mm."""
    at_mm = 1000 * np.array([place.x, place.y, place.z])
    return RigidTransform.from_components(at_mm, Rotation.from_quat([turn.x, turn.y, turn.z, turn.w]))


SHOWN = f"/{NAMESPACE}"  # of --serve


@contextmanager
def served(states: list[LiveState]) -> Iterator[None]:
    """Show the last of `states`."""
    del os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"]
    with serving([f"ros2:{SHOWN}"], lambda: states[-1], Output(json=False, quiet=True)):
        assert os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] == "LOCALHOST"
        yield


def test_a_procedure_in_progress_is_read_in_another_node() -> None:
    from diagnostic_msgs.msg import DiagnosticArray
    from geometry_msgs.msg import PoseStamped
    from sensor_msgs.msg import CameraInfo, CompressedImage
    from tf2_msgs.msg import TFMessage

    kinds = {"/tf": TFMessage, "/diagnostics": DiagnosticArray, f"{SHOWN}/target": PoseStamped}
    kinds |= {f"{SHOWN}/tool": PoseStamped, f"{SHOWN}/live/camera_info": CameraInfo}
    kinds |= {f"{SHOWN}/live/image/compressed": CompressedImage}
    state = LiveState(images={LIVE: live()}, bone=bone(), T_cfcs_tool=pose(2).as_matrix(), side="right", **GO)
    with served([state]), heard(kinds) as (until, received):
        until(lambda: all(received.values()))
    newest = {topic.removeprefix(f"{SHOWN}/"): messages[-1] for topic, messages in received.items()}
    places = {each.child_frame_id: each for each in newest["/tf"].transforms}
    parents = {name: each.header.frame_id for name, each in places.items()}
    assert parents == dict.fromkeys(("live_optical_frame", "ct", "tool", "wire"), "cfcs") | {"cfcs": "patient_ras"}
    assert all(abs(each.header.stamp.sec - time.time()) < arm_peers.PATIENCE_S for each in places.values())
    found = {name: pose_of(each.transform.translation, each.transform.rotation) for name, each in places.items()}
    for name, true in (("ct", pose(1)), ("tool", pose(2))):
        np.testing.assert_allclose(found[name].as_matrix(), true.as_matrix(), atol=1e-9)
    np.testing.assert_allclose(found["cfcs"].apply(np.eye(3)), [[1, 0, 0], [0, 0, -1], [0, 1, 0]], atol=1e-9)
    np.testing.assert_allclose(found["live_optical_frame"].translation, planned_view().focal_point_mm, atol=1e-9)
    for name, frame in (("target", "wire"), ("tool", "tool")):
        stamped = newest[name]
        assert stamped.header.frame_id == "cfcs"
        assert abs(stamped.header.stamp.sec - time.time()) < arm_peers.PATIENCE_S
        at = pose_of(stamped.pose.position, stamped.pose.orientation)
        np.testing.assert_allclose(at.as_matrix(), found[frame].as_matrix(), atol=1e-9)
    length = np.linalg.norm(ENTRY_END_MM[1] - ENTRY_END_MM[0])
    np.testing.assert_allclose(found["wire"].apply([[0, 0, -length], [0, 0, 0]]), ENTRY_END_MM, atol=1e-9)

    picture, camera = newest["live/image/compressed"], newest["live/camera_info"]
    plain = LiveTopics(lambda: state)()["live/camera_info"]
    assert (picture.format, picture.header) == ("mono16; png compressed", camera.header)
    stamp = picture.header.stamp
    assert (picture.header.frame_id, stamp.sec, stamp.nanosec) == ("live_optical_frame", 1_700_000_000, 250_000_000)
    pixels = cv2.imdecode(np.frombuffer(picture.data, np.uint8), cv2.IMREAD_UNCHANGED)
    view = planned_view()
    np.testing.assert_array_equal(pixels, undistort(shown().pixels, view.plane_map, view.hull).pixels)
    assert (camera.height, camera.width) == pixels.shape
    np.testing.assert_array_equal(np.reshape(camera.k, (3, 3)), plain.matrix)
    np.testing.assert_array_equal(np.reshape(camera.p, (3, 4)), np.column_stack([plain.matrix, np.zeros(3)]))
    levels = {part.name: (part.level, part.message) for part in newest["/diagnostics"].status}
    assert levels["sightline: plan"] == (b"\0", "GO")
    assert next(part.values for part in newest["/diagnostics"].status if part.name == "sightline: view live")


def test_a_wire_that_is_not_go_is_not_published_and_a_late_reader_gets_the_image() -> None:
    from diagnostic_msgs.msg import DiagnosticArray
    from geometry_msgs.msg import PoseStamped
    from sensor_msgs.msg import CompressedImage
    from tf2_msgs.msg import TFMessage

    image, target = f"{SHOWN}/live/image/compressed", f"{SHOWN}/target"
    kinds = {"/tf": TFMessage, "/diagnostics": DiagnosticArray, target: PoseStamped, image: CompressedImage}
    states = [LiveState(images={LIVE: live()}, **GO)]
    with served(states), heard(kinds) as (until, received):
        frames, parts = received["/tf"], received["/diagnostics"]

        def more(count: int) -> None:
            end = len(frames) + count
            until(lambda: len(frames) >= end)

        until(lambda: all(received.values()))
        states.append(LiveState(images=states[0].images, verdict="NO-GO (gap)", bone=bone(FAILED)))
        until(lambda: parts[-1].status[0].level == b"\2")
        more(3)  # what was on its way
        received[target].clear()
        frames.clear()
        more(5)
        assert not received[target]
        assert {each.child_frame_id for message in frames for each in message.transforms} == {"live_optical_frame"}
        assert parts[-1].status[0].message == "NO-GO (gap)"
        sent = len(received[image])
        with heard({image: CompressedImage}) as (late_until, late):
            late_until(lambda: late[image])
        more(5)
        assert late[image][0].data == received[image][0].data
        assert len(received[image]) <= sent + 1  # once to each reader, and not ten times a second


@pytest.mark.parametrize("namespace", [name for name in (*GOOD, *BAD) if name != "/"])
def test_ros_2_takes_the_same_namespaces(namespace: str) -> None:
    from rclpy.exceptions import InvalidNamespaceException
    from rclpy.validate_namespace import validate_namespace

    try:
        validate_namespace(namespace)
    except InvalidNamespaceException:
        assert namespace in BAD
    else:
        assert namespace in GOOD


def test_the_example_prints_the_target_and_what_is_not_ok() -> None:
    command = [sys.executable, "examples/ros2_live.py", SHOWN]
    state = LiveState(statuses={"robot": Status(18, "FAULT", "the drill is hot")}, **GO)
    pipes: dict[str, Any] = {"stdout": subprocess.PIPE, "text": True}
    with served([state]), subprocess.Popen(command, cwd=arm_peers.ROOT, **pipes) as reader:  # noqa: S603 - our own file
        line = next(line for line in reader.stdout if line.startswith("target"))
        reader.kill()
    x, y, z = ENTRY_END_MM[1]
    assert line == f"target {x:.2f} {y:.2f} {z:.2f} mm | sightline: robot: FAULT: the drill is hot\n"


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
