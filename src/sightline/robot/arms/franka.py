"""A Franka arm through franky, which talks to it a thousand times a second. Needs the extra `franka`.

The arm stops by itself if this process dies: its control box misses the commands of a few milliseconds and ends the
motion [Franka's documentation: communication constraints].
"""

from threading import Event, Lock, Thread
from typing import Any
from xml.etree import ElementTree

import franky  # pyright: ignore[reportMissingImports]
import numpy as np

from sightline.errors import RobotRefusedError
from sightline.robot.arms.adapter import SEND_S, JointTrajectory, checked
from sightline.robot.plant import PlantFlag, Reading

PERIOD_S = 0.002  # between two samples; franky has one in each millisecond [ours]
GAIN_PER_S = 20.0  # of what a joint is short of its trajectory, twice that of the control loop [ours]


class FrankaArm:
    """The arm whose control box is at `host`, in FCI mode. A fault is reported by `state` until `hold`; a lost
    connection for good. Raises RobotRefusedError without one."""

    def __init__(self, host: str) -> None:
        try:
            # A kernel that is not for real time misses a deadline now and then; the arm then stops with a fault.
            self._robot = franky.Robot(host, realtime_config=franky.RealtimeConfig.Ignore)
            self._state = self._robot.state
            joints = ElementTree.fromstring(self._robot.model_urdf).iter("joint")  # noqa: S314 - the arm's own file
        except Exception as error:  # franky's errors share no class
            raise RobotRefusedError(f"no Franka arm at {host}: {error}", str(error)) from error
        self.joints = tuple(joint.attrib["name"] for joint in joints if joint.attrib["type"] == "revolute")
        self._lock, self._closed = Lock(), Event()
        self._fault = self._lost = ""
        self._thread = Thread(target=self._watch, name="franka", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """See ArmAdapter."""
        self._closed.set()
        self._thread.join()
        try:
            self.hold()
            self._robot.join_motion()  # franky ends the program if a motion is left
        except Exception as error:
            self._fault = str(error)

    def state(self) -> Reading:
        """Return the latest sample, at the time of the arm's own clock. Raises RobotRefusedError for a fault."""
        with self._lock:
            mode, fault = self._state.robot_mode, self._lost or self._fault
            if not fault and mode not in (franky.RobotMode.Idle, franky.RobotMode.Move, franky.RobotMode.UserStopped):
                fault = f"mode {mode.name}, errors {self._state.current_errors}"
            if fault:
                raise RobotRefusedError(f"the Franka arm reports: {fault}", fault)
            stopped = mode == franky.RobotMode.UserStopped
            # Its force is estimated at the flange, not along the wire. Its enabling switch ends FCI motion by itself.
            flags = PlantFlag.STOP_PRESSED if stopped else PlantFlag.RUN_HELD
            return Reading(self._state.time.to_sec(), np.array(self._state.q), 0.0, flags)

    def follow(self, trajectory: JointTrajectory) -> None:
        """Begin a trajectory by its velocity at first, until that changes; the arm then decelerates.

        Velocities, not positions: a position servo lags, also when it stops. Raises RobotRefusedError after a fault,
        or if the arm is not as fast."""
        at = self.state().encoders
        path = checked(trajectory, self.joints, at, np.ones(len(self.joints), dtype=bool))
        velocity = path(0.0, 1) + GAIN_PER_S * (path(0.0) - at)
        excess = np.abs(velocity) / self._robot.joint_velocity_limit.get()
        if excess.max() > 1:
            joint = self.joints[int(excess.argmax())]
            raise RobotRefusedError(f"the velocity of {joint} would be {excess.max():.1f} times its limit: move slower")
        # It is reached when the next one comes, and kept for SEND_S more than that: franky begins a motion a few
        # milliseconds late.
        ramp, kept = (franky.Duration(round(1000 * s)) for s in (SEND_S, path.x[-2] - 2 * SEND_S))
        self._move(
            franky.JointVelocityWaypointMotion(
                [
                    franky.JointVelocityWaypoint(velocity, minimum_time=ramp, hold_target_duration=kept),
                    franky.JointVelocityWaypoint(0 * velocity),
                ]
            )
        )

    def hold(self) -> None:
        """Decelerate to rest as fast as franky's limits allow; the arm's controller then holds it. Forgets a fault."""
        with self._lock:
            self._fault = ""
        if self._robot.is_in_control:
            self._move(franky.JointVelocityStopMotion())

    def _move(self, motion: Any) -> None:
        with self._lock:
            self._clear()
            try:
                self._robot.move(motion, asynchronous=True)
            except Exception as error:
                self._fault = str(error)
                raise RobotRefusedError(f"the Franka arm refused a motion: {error}", str(error)) from error

    def _watch(self) -> None:
        try:
            while not self._closed.wait(PERIOD_S):
                state = self._robot.state  # waits for the next sample if nothing moves
                with self._lock:
                    self._state = state
                    self._clear()
        except Exception as error:
            with self._lock:
                self._lost = f"the connection is lost: {error}"

    def _clear(self) -> None:
        """Take the error of a motion that has ended, so that the next one can begin. Under the lock."""
        try:
            self._robot.poll_motion()
        except Exception as error:
            self._fault = str(error)
