"""Interface between the link's machine and an arm whose own controller follows trajectories."""

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from scipy.interpolate import CubicHermiteSpline

from sightline.errors import RobotRefusedError
from sightline.robot.kinematics.manipulator import Manipulator
from sightline.robot.plant import PlantFlag, Reading

# A trajectory is sent every SEND_S, as ros2_control's servo does. None is longer than REST_S: an arm whose commander
# dies is then at rest, without a watchdog of its own. HOLD_S: from the pace of a trajectory to rest [ours].
SEND_S, REST_S, HOLD_S = 0.02, 0.1, 0.06


@dataclass(frozen=True, eq=False)
class JointTrajectory:
    """Joint `positions` (N, n) and `velocities` (N, n) at `time_s` (N,) after its start; rad or mm.

    It begins at the arm's present position and velocity, and ends at rest within REST_S. Between two samples the arm
    interpolates.
    """

    time_s: np.ndarray
    positions: np.ndarray
    velocities: np.ndarray


class ArmAdapter(Protocol):
    """An arm of n joints with a controller of its own. Every method returns at once; what the controller reports later
    appears in `state`. If this process dies the arm ends the last trajectory, or stops earlier."""

    @property
    def joints(self) -> tuple[str, ...]:
        """Names of the joints, in the order of all arrays."""
        ...

    def state(self) -> Reading:
        """Return the latest sample; its `time_s` stands still while the controller sends nothing. Raises
        RobotRefusedError if the controller reports a fault, with its text."""
        ...

    def follow(self, trajectory: JointTrajectory) -> None:
        """Begin a trajectory; it replaces any other. Raises RobotRefusedError if the controller refuses it."""

    def hold(self) -> None:
        """Decelerate to rest within REST_S and hold the position, stiff."""

    def close(self) -> None:
        """Hold, and leave the arm's controller."""


# [ours] How far from the arm's joints a trajectory may begin, rad and mm: servos lag. Twice what a moving joint may be
# off its course.
START_RAD, START_MM = 0.0175, 2.0


def checked(
    trajectory: JointTrajectory, joints: tuple[str, ...], q: np.ndarray, rotary: np.ndarray
) -> CubicHermiteSpline:
    """Return the positions (n,) over time of a trajectory for an arm at `q` (n,), and what is between its samples.

    Raises RobotRefusedError unless it is finite, in order of time, begins at `q` and ends at rest within REST_S.
    `rotary` (n,): which joints rotate.
    """
    time_s, positions, velocities = trajectory.time_s, trajectory.positions, trajectory.velocities
    shape = (len(time_s), len(joints))
    if len(time_s) < 2 or positions.shape != shape or velocities.shape != shape:
        raise RobotRefusedError(f"the trajectory needs positions and velocities of {len(joints)} joints at two times")
    if not (np.isfinite(time_s).all() and np.isfinite(positions).all() and np.isfinite(velocities).all()):
        raise RobotRefusedError("the trajectory has a time, position or velocity that is not a number")
    if time_s[0] != 0 or (np.diff(time_s) <= 0).any():
        raise RobotRefusedError("the times of the trajectory must begin at 0 and increase")
    if np.abs(velocities[-1]).max() > 1e-9 or time_s[-1] > REST_S + 1e-9:  # rounding
        raise RobotRefusedError(f"the trajectory must end at rest within {REST_S:g} s")
    off = np.abs(positions[0] - q) / np.where(rotary, START_RAD, START_MM)
    worst = int(off.argmax())
    if off[worst] > 1:
        begin, at = positions[0, worst], q[worst]
        raise RobotRefusedError(f"{joints[worst]} is at {at:.4f}, and the trajectory begins at {begin:.4f}")
    return CubicHermiteSpline(time_s, positions, velocities)


def decelerated(path: CubicHermiteSpline, since_s: float) -> CubicHermiteSpline:
    """Return the path (n,) over time from where `path` is after `since_s`, at its pace there, to rest after HOLD_S."""
    q, pace = path(since_s), path(since_s, 1)
    return CubicHermiteSpline([0.0, HOLD_S], np.stack([q, q + HOLD_S / 2 * pace]), np.stack([pace, 0 * pace]))


class SimulatedArm:
    """An arm that does exactly what it is told, without physics: `robot` at the joints `q` (n,) at first.

    `clock`: in s.
    """

    def __init__(self, robot: Manipulator, q: np.ndarray, clock: Callable[[], float] = time.monotonic) -> None:
        self.joints, self._rotary, self._clock = robot.joints, robot.rotary, clock
        self._begin(CubicHermiteSpline([0.0, 1.0], np.stack([q, q]), np.zeros((2, robot.count))))

    def state(self) -> Reading:
        """See ArmAdapter."""
        now_s = self._clock()
        return Reading(now_s, self._at(now_s), 0.0, PlantFlag.RUN_HELD)

    def follow(self, trajectory: JointTrajectory) -> None:
        """See ArmAdapter."""
        self._begin(checked(trajectory, self.joints, self._at(self._clock()), self._rotary))

    def hold(self) -> None:
        """See ArmAdapter."""
        self._begin(decelerated(self._path, self._since_s(self._clock())))

    def close(self) -> None:
        """See ArmAdapter."""

    def _begin(self, path: CubicHermiteSpline) -> None:
        self._path, self._begun_s = path, self._clock()

    def _at(self, now_s: float) -> np.ndarray:
        return self._path(self._since_s(now_s))

    def _since_s(self, now_s: float) -> float:
        return min(now_s - self._begun_s, float(self._path.x[-1]))
