"""What a program shows, to programs that speak ROS 2: ten times a second. Needs the extra `ros2`."""

from collections.abc import Callable, Mapping
from math import modf
from threading import Event, Thread
from time import monotonic
from typing import Any

import rclpy  # pyright: ignore[reportMissingImports]
from builtin_interfaces.msg import Time  # pyright: ignore[reportMissingImports]
from geometry_msgs.msg import PoseStamped, TransformStamped  # pyright: ignore[reportMissingImports]
from sensor_msgs.msg import CameraInfo, CompressedImage  # pyright: ignore[reportMissingImports]
from std_msgs.msg import Header, String  # pyright: ignore[reportMissingImports]

from sightline.common.closing import Closing
from sightline.robot.ros2_values import FramePose, ImageCamera, Picture, Text, Value
from sightline.robot.transport.broadcast import PERIOD_S


class Ros2Broadcast(Closing):
    """A node `name` that publishes what `snapshot` returns by topic, until it is closed.

    A topic without a leading / is below `namespace`. `snapshot` is called in another thread. A value is sent once to
    each reader: make a new one for whatever is to be sent again.
    """

    def __init__(self, namespace: str, snapshot: Callable[[], Mapping[str, Value]], name: str) -> None:
        self._namespace, self._snapshot, self._ended = namespace, snapshot, Event()
        self._publishers: dict[str, Any] = {}
        self._sent: dict[str, tuple[Value, int]] = {}  # by topic: the value, and to how many readers
        self._context = rclpy.Context()
        self._context.init()
        self._node = rclpy.create_node(name, context=self._context)
        self._thread = Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Leave ROS 2."""
        self._ended.set()
        self._thread.join()
        self._node.destroy_node()
        self._context.try_shutdown()

    def _run(self) -> None:
        due_s = monotonic()
        while not self._ended.wait(max(due_s - monotonic(), 0.0)):
            for topic, value in self._snapshot().items():
                self._publish(topic, value)
            due_s = max(due_s + PERIOD_S, monotonic())

    def _publish(self, topic: str, value: Value) -> None:
        before, reached = self._sent.get(topic, (None, 0))
        publisher = self._publishers.get(topic)
        readers = 0 if publisher is None else publisher.get_subscription_count()
        if before is not value or readers > reached:
            message = _message(value, self._node.get_clock().now().to_msg())
            if publisher is None:
                full = topic if topic.startswith("/") else f"{self._namespace}/{topic}"
                publisher = self._publishers[topic] = self._node.create_publisher(type(message), full, 1)
            publisher.publish(message)
        self._sent[topic] = value, readers


def _message(value: Value, now: Time) -> Any:
    match value:
        case FramePose():
            message = PoseStamped(header=Header(stamp=now, frame_id=value.parent))
            _place(value, message.pose.position, message.pose.orientation)
            return message
        case Text():
            return String(data=value.text)
        case Picture():
            kind = f"{value.encoding}; png compressed"  # [src: image_transport_plugins, compressed_image_transport]
            return CompressedImage(header=_header(value.camera), format=kind, data=value.png)
        case ImageCamera():
            return _camera_info(value)
        case _:
            return _frames(value, now) if isinstance(value[0], FramePose) else _diagnostics(value, now)


def _place(pose: FramePose, position: Any, orientation: Any) -> None:
    position.x, position.y, position.z = pose.position_m.tolist()
    orientation.x, orientation.y, orientation.z, orientation.w = pose.quaternion.tolist()


def _header(camera: ImageCamera) -> Header:
    rest_s, seconds = modf(camera.stamped_s)
    return Header(stamp=Time(sec=int(seconds), nanosec=int(1e9 * rest_s)), frame_id=camera.frame)


def _camera_info(camera: ImageCamera) -> CameraInfo:
    rows, columns = camera.shape
    projection = [*camera.matrix[0], 0.0, *camera.matrix[1], 0.0, *camera.matrix[2], 0.0]
    return CameraInfo(
        header=_header(camera),
        height=rows,
        width=columns,
        distortion_model="plumb_bob",
        d=[0.0] * 5,
        k=camera.matrix.ravel(),
        r=[1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0],
        p=projection,
    )


# Imported where they are used: a served arm has neither frames nor diagnostics, and the wheels have no tf2_msgs.


def _frames(poses: tuple[Any, ...], now: Time) -> Any:
    from tf2_msgs.msg import TFMessage  # pyright: ignore[reportMissingImports]

    message = TFMessage()
    for pose in poses:
        stamped = TransformStamped(header=Header(stamp=now, frame_id=pose.parent), child_frame_id=pose.frame)
        _place(pose, stamped.transform.translation, stamped.transform.rotation)
        message.transforms.append(stamped)
    return message


def _diagnostics(parts: tuple[Any, ...], now: Time) -> Any:
    from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue  # pyright: ignore[reportMissingImports]

    return DiagnosticArray(
        header=Header(stamp=now),
        status=[
            DiagnosticStatus(
                level=bytes([part.level]),
                name=part.name,
                message=part.text,
                values=[KeyValue(key=key, value=value) for key, value in part.values.items()],
            )
            for part in parts
        ],
    )
