"""A Franka arm through franky, which talks to it a thousand times a second. Needs the extra `franka`.

The arm stops by itself if this process dies: its control box misses the commands of a few milliseconds and ends the
motion [Franka's documentation: communication constraints].
"""

from threading import Event, Lock, Thread
from time import monotonic
from typing import Any
from xml.etree import ElementTree

import franky  # pyright: ignore[reportMissingImports]
import numpy as np
from scipy.interpolate import CubicHermiteSpline

from sightline.errors import RobotRefusedError
from sightline.robot.arms.adapter import START_RAD, JointTrajectory, checked
from sightline.robot.plant import PlantFlag, Reading

PERIOD_S = 0.002  # between two samples; franky has one in each millisecond [ours]
UNASKED_S = 0.1  # without a call of `state`, motion ends [as long as a stop takes]
# Between the waypoints of a trajectory with many samples. Each takes up to a millisecond more than it should; between
# two of them a joint is off its course by 0.2 mrad [ours: franky-sim, 0.05 to 0.2 s].
STEP_S = 0.1
# Friction leaves the servo short of what is commanded, by 1.7 mrad at the last joint [ours: franky-sim]. Standing, it
# is corrected by the difference.
CORRECTIONS, CORRECTED_RAD = 5, 2e-5
# The joints stand if their means over such windows differ by less; a joint may swing by 0.1 mrad [ours: franky-sim].
WINDOW_S, REST_RAD = 0.25, 5e-5


class FrankaArm:
    """The arm whose control box is at `host`, in FCI mode. Motion ends if `state` is not called for UNASKED_S. A fault
    is reported by `state` until `hold` or `stop`; a lost connection for good. Raises RobotRefusedError without one."""

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
        self._stopped = False  # by us: franky reports that as an error
        self._target: np.ndarray | None = None  # of the trajectory in progress
        self._commanded = np.array(self._state.q)
        self._corrections = 0
        self._window, self._begun_s, self._mean = [self._commanded], 0.0, self._commanded
        self._asked_s = monotonic()
        self._thread = Thread(target=self._watch, name="franka", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop the arm and its supervision."""
        self._closed.set()
        self._thread.join()
        self._stopped = True
        self._stop()
        self._clear()  # franky ends the program if a motion is left

    def state(self) -> Reading:
        """Return the latest sample, at the time of the arm's own clock. Raises RobotRefusedError for a fault."""
        with self._lock:
            self._asked_s = monotonic()
            return self._latest()

    def follow(self, trajectory: JointTrajectory) -> None:
        """Begin a trajectory. Raises RobotRefusedError after a fault, or if the arm is not as fast."""
        with self._lock:
            at = self._latest().encoders
            if self._robot.is_in_control:  # the servo lags behind what is commanded
                at = np.array(self._state.q_d)
            path = checked(trajectory, self.joints, at, np.ones(len(self.joints), dtype=bool))
            end_s = float(path.x[-1])
            times = (
                path.x
                if np.diff(path.x).min() > STEP_S / 4
                else np.linspace(0.0, end_s, int(np.ceil(end_s / STEP_S)) + 1)
            )
            self._refuse_fast(path, np.union1d(times, path.x))
            milliseconds = np.diff(np.round(1000 * times)).astype(int)
            waypoints = [
                franky.JointWaypoint(franky.JointState(path(t), path(t, 1)), minimum_time=franky.Duration(int(ms)))
                for t, ms in zip(times[1:], milliseconds, strict=True)
            ]
            self._asked_s, self._corrections, self._target = monotonic(), 0, path(end_s)
            self._move(waypoints)

    def hold(self) -> None:
        """Decelerate to rest as fast as franky's limits allow; the arm's controller then holds it. Forgets a fault."""
        with self._lock:
            self._end("")

    def stop(self) -> None:
        """Have the control box end the motion at once, as fast as it can. Forgets a fault."""
        with self._lock:
            self._stopped, self._target, self._fault = True, None, ""
        Thread(target=self._stop, daemon=True).start()  # it answers once the arm has stopped

    def _stop(self) -> None:
        try:
            self._robot.stop()
        except Exception as error:
            with self._lock:
                self._fault = f"STOP was not acknowledged: {error}"

    def _watch(self) -> None:
        try:
            while not self._closed.wait(PERIOD_S):
                state = self._robot.state  # waits for the next sample if nothing moves
                with self._lock:
                    self._state = state
                    self._supervise()
        except Exception as error:
            with self._lock:
                self._lost = f"the connection is lost: {error}"

    # Under the lock.

    def _latest(self) -> Reading:
        mode, fault = self._state.robot_mode, self._lost or self._fault
        if not fault and mode not in (franky.RobotMode.Idle, franky.RobotMode.Move, franky.RobotMode.UserStopped):
            fault = f"mode {mode.name}, errors {self._state.current_errors}"
        if fault:
            raise RobotRefusedError(f"the Franka arm reports: {fault}", fault)
        stopped = mode == franky.RobotMode.UserStopped
        # The arm estimates a force at its flange, not along the wire. Its enabling switch ends FCI motion by itself.
        flags = PlantFlag.STOP_PRESSED if stopped else PlantFlag.RUN_HELD
        return Reading(self._state.time.to_sec(), np.array(self._state.q), 0.0, flags)

    def _refuse_fast(self, path: CubicHermiteSpline, times: np.ndarray) -> None:
        velocities = path(times, 1)
        accelerations = np.diff(velocities, axis=0) / np.diff(times)[:, None]
        for name, values, limit in (
            ("velocity", velocities, self._robot.joint_velocity_limit.get()),
            ("acceleration", accelerations, self._robot.joint_acceleration_limit.get()),
        ):
            excess = np.abs(values).max(axis=0) / limit
            if excess.max() > 1:
                joint = self.joints[int(excess.argmax())]
                raise RobotRefusedError(
                    f"the {name} of {joint} would be {excess.max():.1f} times its limit: move slower"
                )

    def _move(self, waypoints: list[Any]) -> None:
        self._clear()
        self._commanded = np.array(waypoints[-1].target.position)
        self._stopped = False
        try:
            self._robot.move(franky.JointWaypointMotion(waypoints), asynchronous=True)
        except Exception as error:
            self._target, self._fault = None, str(error)
            raise RobotRefusedError(f"the Franka arm refused the trajectory: {error}", str(error)) from error

    def _clear(self) -> None:
        """Take the error of a motion that has ended, so that the next one can begin."""
        try:
            self._robot.poll_motion()
        except Exception as error:
            if not self._stopped:
                self._target, self._fault = None, str(error)

    def _end(self, fault: str) -> None:
        self._target, self._fault = None, fault
        if self._robot.is_in_control:
            self._robot.move(franky.JointStopMotion(), asynchronous=True)

    def _supervise(self) -> None:
        self._clear()
        if self._target is None:
            return
        if monotonic() - self._asked_s > UNASKED_S:
            self._end(f"the arm was stopped: its state was not read for {UNASKED_S:g} s")
            return
        if self._robot.is_in_control:
            self._window.clear()
            return
        now_s = self._state.time.to_sec()
        if not self._window:
            self._begun_s = now_s
        self._window.append(np.array(self._state.q))
        if now_s - self._begun_s >= WINDOW_S:
            before, self._mean = self._mean, np.mean(self._window, axis=0)
            self._window.clear()
            if np.abs(self._mean - before).max() < REST_RAD:
                self._correct(self._target - self._mean)

    def _correct(self, off: np.ndarray) -> None:
        worst = int(np.abs(off).argmax())
        if abs(off[worst]) > START_RAD:
            self._target, self._fault = None, f"{self.joints[worst]} stands {off[worst]:.4f} rad short of its target"
        elif abs(off[worst]) < CORRECTED_RAD or self._corrections == CORRECTIONS:
            self._target = None
        else:
            self._corrections += 1
            self._move([franky.JointWaypoint(self._commanded + off, relative_dynamics_factor=0.1)])
