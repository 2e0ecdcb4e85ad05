"""An arm of ros2_control: joint states come in, joint trajectories go out. Needs the extra `ros2`.

A joint_trajectory_controller finishes the trajectory that it has, even when its sender is dead, and refuses an empty
one [ros2_controllers, pull request 902]: the arm is at rest REST_S after the last message that came.
"""

from collections.abc import Sequence
from threading import Event, Lock, Thread
from time import monotonic, sleep

import numpy as np
import rclpy  # pyright: ignore[reportMissingImports]
from builtin_interfaces.msg import Duration  # pyright: ignore[reportMissingImports]
from rclpy.executors import SingleThreadedExecutor  # pyright: ignore[reportMissingImports]
from rclpy.qos import QoSProfile, ReliabilityPolicy  # pyright: ignore[reportMissingImports]
from scipy.interpolate import CubicHermiteSpline
from sensor_msgs.msg import JointState  # pyright: ignore[reportMissingImports]
from trajectory_msgs import msg  # pyright: ignore[reportMissingImports]

from sightline.errors import RobotRefusedError
from sightline.robot.arms.adapter import START_MM, START_RAD, JointTrajectory, checked, decelerated
from sightline.robot.contract import STATUS_S
from sightline.robot.plant import PlantFlag, Reading

POLL_S = 0.02  # while its topics are looked for
LATE_S = 0.1  # greatest age of a sample [as long as a stop takes]


class Ros2Arm:
    """The arm whose controller listens at `namespace`/joint_trajectory_controller and reports `namespace`/joint_states.

    `joints` are matched by name; `lower`, `upper`: their limits, rad or mm; `rotary`: which rotate.
    """

    def __init__(
        self, namespace: str, joints: Sequence[str], lower: np.ndarray, upper: np.ndarray, rotary: np.ndarray
    ) -> None:
        self.joints = tuple(joints)
        slack = np.where(rotary, START_RAD, START_MM)
        self._lower, self._upper, self._rotary = lower - slack, upper + slack, rotary
        self._scale = np.where(rotary, 1.0, 1000.0)  # from the units of ROS to ours
        self._lock, self._first = Lock(), Event()
        self._states = f"{namespace}/joint_states"
        self._commands = f"{namespace}/joint_trajectory_controller/joint_trajectory"
        self._reading: Reading | None = None
        self._fault = f"no joint states at {self._states}"
        self._path: CubicHermiteSpline | None = None  # sent last, and when
        self._sent_s = 0.0
        self._context = rclpy.Context()
        self._context.init()
        try:
            self._node = rclpy.create_node("sightline", context=self._context)
            # The newest sample alone; publishers may be reliable or not.
            newest = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
            self._node.create_subscription(JointState, self._states, self._heard, newest)
            self._publisher = self._node.create_publisher(msg.JointTrajectory, self._commands, 1)
        except Exception as error:
            self._context.try_shutdown()
            raise RobotRefusedError(f"not usable as a ROS 2 namespace: {error}") from error
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        self._thread = Thread(target=self._executor.spin, name="rclpy", daemon=True)
        self._thread.start()
        ends_s = monotonic() + STATUS_S  # to find the two topics
        while not (self._first.is_set() and self._node.count_subscribers(self._commands)) and monotonic() < ends_s:
            sleep(POLL_S)
        try:
            self.state()
        except RobotRefusedError:
            self.close()
            raise

    def close(self) -> None:
        """See ArmAdapter."""
        self.hold()
        self._executor.shutdown()
        self._thread.join()
        self._node.destroy_node()
        self._context.try_shutdown()

    def state(self) -> Reading:
        """Return the latest sample, with the time that its sender gave it. Raises RobotRefusedError for a bad one."""
        with self._lock:
            if self._fault or self._reading is None:
                raise RobotRefusedError(self._fault)
            return self._reading

    def follow(self, trajectory: JointTrajectory) -> None:
        """See ArmAdapter. Raises RobotRefusedError also without a controller of our own."""
        path = checked(trajectory, self.joints, self.state().encoders, self._rotary)
        if self._node.count_subscribers(self._commands) == 0:
            raise RobotRefusedError(f"no controller listens at {self._commands}")
        if self._node.count_publishers(self._commands) > 1:
            raise RobotRefusedError(f"another program sends trajectories to {self._commands}: end it")
        self._send(path)

    def hold(self) -> None:
        """See ArmAdapter: from where the last trajectory has brought the arm by now, since a servo lags behind it."""
        with self._lock:
            path, since_s = self._path, monotonic() - self._sent_s
        if path is not None and since_s < path.x[-1]:
            self._send(decelerated(path, since_s))

    def _heard(self, message: JointState) -> None:
        try:
            reading, fault = self._sample(message), ""
        except RobotRefusedError as error:
            reading, fault = None, str(error)
        with self._lock:
            if reading is None or self._reading is None or reading.time_s > self._reading.time_s:
                self._reading, self._fault = reading or self._reading, fault
        self._first.set()

    def _sample(self, message: JointState) -> Reading:
        names = list(message.name)
        if sorted(names) != sorted(self.joints) or len(message.position) != len(names):
            raise RobotRefusedError(f"{self._states} reports {', '.join(names)}; the arm has {', '.join(self.joints)}")
        q = np.array(message.position)[[names.index(joint) for joint in self.joints]] * self._scale
        for joint, at, lower, upper in zip(self.joints, q, self._lower, self._upper, strict=True):
            if not lower <= at <= upper:  # also if it is not a number
                raise RobotRefusedError(f"{joint} is at {at:g}, outside {lower:g} to {upper:g}: not in rad and m?")
        time_s = message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec
        age_s = 1e-9 * self._node.get_clock().now().nanoseconds - time_s
        if abs(age_s) > LATE_S:
            raise RobotRefusedError(f"{self._states} is {age_s:.2f} s old, or the clocks of two computers differ")
        # ROS 2 has no message for the force along a wire, and none for a switch that a person holds.
        return Reading(time_s, q, 0.0, PlantFlag.RUN_HELD)

    def _send(self, path: CubicHermiteSpline) -> None:
        positions, velocities = path(path.x) / self._scale, path(path.x, 1) / self._scale
        velocities[-1] = 0.0  # without rounding: the controller refuses an end that moves
        points = [
            msg.JointTrajectoryPoint(
                positions=positions[k].tolist(),
                velocities=velocities[k].tolist(),
                time_from_start=Duration(nanosec=round(1e9 * path.x[k])),
            )
            for k in range(1, len(path.x))  # the controller begins where the arm is
        ]
        with self._lock:
            self._path, self._sent_s = path, monotonic()
        self._publisher.publish(msg.JointTrajectory(joint_names=list(self.joints), points=points))  # no stamp: at once
