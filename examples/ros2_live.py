"""Print the target and the alarms that `--serve ros2:/NAMESPACE` shows: `python ros2_live.py [/NAMESPACE]`.

Needs ROS 2 (docs/live.md). A target that has not come for half a second no longer holds.
"""

import sys
from contextlib import suppress
from time import monotonic

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped
from rclpy.executors import ExternalShutdownException

HOLDS_S = 0.5
newest: dict[str, tuple[float, object]] = {}  # by topic: when it came, and the message


def keep(topic: str):
    """Return what keeps the newest message of a topic."""
    return lambda message: newest.update({topic: (monotonic(), message)})


def show() -> None:
    """Print the target in mm, and each part that is not OK."""
    held = {topic: message for topic, (came_s, message) in newest.items() if monotonic() - came_s < HOLDS_S}
    place = held["target"].pose.position if "target" in held else None
    parts = held["diagnostics"].status if "diagnostics" in held else ()
    where = "no target" if place is None else f"target {1e3 * place.x:.2f} {1e3 * place.y:.2f} {1e3 * place.z:.2f} mm"
    print(where, *(f"| {part.name}: {part.message}" for part in parts if part.level != b"\0"), flush=True)


rclpy.init()
node = rclpy.create_node("sightline_reader")
node.create_subscription(PoseStamped, f"{(sys.argv[1:] or ['/sightline'])[0]}/target", keep("target"), 1)
node.create_subscription(DiagnosticArray, "/diagnostics", keep("diagnostics"), 1)
node.create_timer(HOLDS_S, show)
with suppress(KeyboardInterrupt, ExternalShutdownException):
    rclpy.spin(node)
