"""Any arm of ros2_control: joint states in, short joint trajectories out. Needs the extra `ros2`.

A joint_trajectory_controller finishes the trajectory that it has, even when its sender is dead, and refuses an empty
one [ros2_controllers, pull request 902]. So it gets, every 20 ms, no more than the next 40 ms of the path and a
deceleration along the path over 60 ms. Without a further message the arm is at rest 0.1 s after the last one.
"""

from collections.abc import Sequence
from threading import Event, Lock, Thread
from time import monotonic, sleep

import numpy as np
import rclpy  # pyright: ignore[reportMissingImports]
from builtin_interfaces.msg import Duration  # pyright: ignore[reportMissingImports]
from rclpy.executors import SingleThreadedExecutor  # pyright: ignore[reportMissingImports]
from rclpy.qos import QoSProfile, ReliabilityPolicy  # pyright: ignore[reportMissingImports]
from scipy.integrate import cumulative_trapezoid
from scipy.interpolate import CubicHermiteSpline
from sensor_msgs.msg import JointState  # pyright: ignore[reportMissingImports]
from trajectory_msgs import msg  # pyright: ignore[reportMissingImports]

from sightline.errors import RobotRefusedError
from sightline.robot.arms.adapter import START_MM, START_RAD, JointTrajectory, checked
from sightline.robot.contract import STATUS_S
from sightline.robot.plant import PlantFlag, Reading

PERIOD_S = 0.02  # between two messages [ours]
# Greatest age of a sample; periods without one, or without a call of `state` [as long as a stop takes].
LATE_S, MISSED = 0.1, 5
# Times of a message's points, and the pace there, as a share of the trajectory's own, linear in between: of a message
# that goes on, and of one that stops (as a share of the pace before it).
GOING_S, GOING = np.array([0.0, 0.02, 0.04, 0.06, 0.08, 0.1]), np.array([1.0, 1.0, 1.0, 2 / 3, 1 / 3, 0.0])
STOPPING_S, STOPPING = np.array([0.0, 0.02, 0.04, 0.06]), np.array([1.0, 2 / 3, 1 / 3, 0.0])


class _Course:
    """A path of joint positions over its own time, and the time on it over the time since the last message."""

    def __init__(self, path: CubicHermiteSpline) -> None:
        self._path = path
        self._ahead = CubicHermiteSpline([0.0, 1.0], [0.0, 1.0], [1.0, 1.0])
        self._sent_s, self.done = monotonic(), False

    @property
    def position(self) -> np.ndarray:
        """Where the last message has brought the arm by now, (n,): a servo lags behind it."""
        since_s = min(monotonic() - self._sent_s, self._ahead.x[-1])
        return self._path(min(float(self._ahead(since_s)), self._path.x[-1]))

    def message(self, goes_on: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return times (M,), positions and velocities (M, n) of the next message: a late one slows the arm, no jump."""
        now_s = monotonic()
        since_s = min(now_s - self._sent_s, self._ahead.x[-1])
        at_s, pace = float(self._ahead(since_s)), float(self._ahead(since_s, 1))
        times, paces = (GOING_S, np.append(pace, GOING[1:])) if goes_on else (STOPPING_S, pace * STOPPING)
        self._ahead = CubicHermiteSpline(times, at_s + cumulative_trapezoid(paces, times, initial=0.0), paces)
        self._sent_s, self.done = now_s, at_s >= self._path.x[-1]
        path_s = np.minimum(self._ahead(times[1:]), self._path.x[-1])
        return times[1:], self._path(path_s), self._path(path_s, 1) * paces[1:, None]


class Ros2Arm:
    """The arm whose controller listens at `namespace`/joint_trajectory_controller and reports `namespace`/joint_states.

    `joints` are matched by name; `lower`, `upper`: their limits, rad or mm; `rotary`: which rotate. Motion ends if no
    joint states come, or `state` is not called, for LATE_S. `state` reports a fault until `hold` or `stop`.
    """

    def __init__(
        self, namespace: str, joints: Sequence[str], lower: np.ndarray, upper: np.ndarray, rotary: np.ndarray
    ) -> None:
        self.joints = tuple(joints)
        slack = np.where(rotary, START_RAD, START_MM)
        self._lower, self._upper, self._rotary = lower - slack, upper + slack, rotary
        self._scale = np.where(rotary, 1.0, 1000.0)  # from the units of ROS to ours
        self._lock, self._first, self._fault = Lock(), Event(), ""
        self._reading: Reading | None = None
        self._course: _Course | None = None
        self._silent = self._unasked = 0  # periods: a pause of this process is not the arm's silence
        self._states = f"{namespace}/joint_states"
        self._commands = f"{namespace}/joint_trajectory_controller/joint_trajectory"
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
        self._node.create_timer(PERIOD_S, self._tick)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        self._thread = Thread(target=self._executor.spin, name="rclpy", daemon=True)
        self._thread.start()
        ends_s = monotonic() + STATUS_S  # to find the two topics
        while not (self._first.is_set() and self._node.count_subscribers(self._commands)) and monotonic() < ends_s:
            sleep(PERIOD_S)
        try:
            self.state()
        except RobotRefusedError:
            self.close()
            raise

    def close(self) -> None:
        """Stop the arm and leave ROS 2."""
        self.hold()
        self._executor.shutdown()
        self._thread.join()
        self._node.destroy_node()
        self._context.try_shutdown()

    def state(self) -> Reading:
        """Return the latest sample, with the time that its sender gave it. Raises RobotRefusedError for a fault."""
        with self._lock:
            self._unasked = 0
            return self._latest()

    def follow(self, trajectory: JointTrajectory) -> None:
        """Begin a trajectory. Raises RobotRefusedError after a fault, or without a controller of our own."""
        with self._lock:
            at, moving = self._latest().encoders, self._course is not None
            path = checked(trajectory, self.joints, self._course.position if self._course else at, self._rotary)
            if self._node.count_subscribers(self._commands) == 0:
                raise RobotRefusedError(f"no controller listens at {self._commands}")
            if self._node.count_publishers(self._commands) > 1:
                raise RobotRefusedError(f"another program sends trajectories to {self._commands}: end it")
            self._course, self._unasked = _Course(path), 0
            if not moving:
                self._send(self._course, goes_on=True)

    def hold(self) -> None:
        """Decelerate along the path within 60 ms; the controller holds the position. Forgets a fault."""
        with self._lock:
            self._end("")

    stop = hold  # the acceleration that the arm could bear is not known here

    def _heard(self, message: JointState) -> None:
        try:
            reading = self._sample(message)
            with self._lock:
                if self._reading is None or reading.time_s > self._reading.time_s:
                    self._reading, self._silent = reading, 0
        except RobotRefusedError as error:
            with self._lock:
                self._end(str(error))
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

    def _tick(self) -> None:
        with self._lock:
            self._silent, self._unasked = self._silent + 1, self._unasked + 1
            if self._course is None:
                return
            if self._silent >= MISSED:
                self._end(f"no new joint states at {self._states} for {LATE_S:g} s")
            elif self._unasked >= MISSED:
                self._end(f"the arm was stopped: its state was not read for {LATE_S:g} s")
            elif self._course.done:
                self._course = None
            else:
                self._send(self._course, goes_on=True)

    def _latest(self) -> Reading:
        if self._fault or self._reading is None:
            raise RobotRefusedError(self._fault or f"no joint states at {self._states}")
        return self._reading

    def _end(self, fault: str) -> None:
        if self._course is not None:
            self._send(self._course, goes_on=False)
        self._course, self._fault = None, fault

    def _send(self, course: _Course, goes_on: bool) -> None:
        points = [
            msg.JointTrajectoryPoint(
                positions=(q / self._scale).tolist(),
                velocities=(velocity / self._scale).tolist(),
                time_from_start=Duration(nanosec=round(1e9 * time_s)),
            )
            for time_s, q, velocity in zip(*course.message(goes_on), strict=True)
        ]
        self._publisher.publish(msg.JointTrajectory(joint_names=list(self.joints), points=points))  # no stamp: at once
