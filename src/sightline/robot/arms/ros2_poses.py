"""Where a served arm's guide and target are, for programs that speak ROS 2. Needs the extra `ros2`."""

from collections.abc import Callable
from threading import Event, Thread
from typing import NamedTuple

import rclpy  # pyright: ignore[reportMissingImports]
from geometry_msgs.msg import PoseStamped  # pyright: ignore[reportMissingImports]
from scipy.spatial.transform import RigidTransform
from std_msgs.msg import String  # pyright: ignore[reportMissingImports]

from sightline.common.closing import Closing

PERIOD_S = 0.1  # as displays need it [ours]
BASE = "base_link"  # [src: REP-105's name of a robot's own frame, and UR's and Franka's drivers]


class PublishedPoses(NamedTuple):
    """`tool`: pose of the guide's mouth, `target`: of the wire's tip at the plan's end; MCS, +z along the wire."""

    tool: RigidTransform
    target: RigidTransform | None
    status: str


class Ros2Poses(Closing):
    """Publishes what `read` returns, ten times a second until it is closed: `namespace`/sightline/tool, target, status;
    poses in m, in the arm's base (BASE)."""

    def __init__(self, namespace: str, read: Callable[[], PublishedPoses]) -> None:
        self._read, self._ended = read, Event()
        self._context = rclpy.Context()
        self._context.init()
        self._node = rclpy.create_node("sightline_poses", context=self._context)
        topics = (("tool", PoseStamped), ("target", PoseStamped), ("status", String))
        self._publishers = {
            name: self._node.create_publisher(kind, f"{namespace}/sightline/{name}", 1) for name, kind in topics
        }
        self._thread = Thread(target=self._run, name="poses", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Leave ROS 2."""
        self._ended.set()
        self._thread.join()
        self._node.destroy_node()
        self._context.try_shutdown()

    def _run(self) -> None:
        while not self._ended.wait(PERIOD_S):
            poses = self._read()
            self._publishers["tool"].publish(self._pose(poses.tool))
            if poses.target is not None:
                self._publishers["target"].publish(self._pose(poses.target))
            self._publishers["status"].publish(String(data=poses.status))

    def _pose(self, pose: RigidTransform) -> PoseStamped:
        message = PoseStamped()
        message.header.frame_id, message.header.stamp = BASE, self._node.get_clock().now().to_msg()
        at, turn = message.pose.position, message.pose.orientation
        at.x, at.y, at.z = (1e-3 * pose.translation).tolist()
        turn.x, turn.y, turn.z, turn.w = pose.rotation.as_quat().tolist()
        return message
