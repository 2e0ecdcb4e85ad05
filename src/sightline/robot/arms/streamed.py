"""The plant made of an arm that follows trajectories."""

import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from sightline.errors import RobotRefusedError
from sightline.robot.arms.adapter import ArmAdapter, JointTrajectory
from sightline.robot.plant import CYCLE_S, Reading

# Each trajectory goes on for AHEAD_S and is at rest after REST_S: an arm whose commander dies stops within 100 ms by
# itself, without a watchdog of its own. A new one comes every SEND_S, as ros2_control's servo does [ours].
SEND_S, AHEAD_S, REST_S = 4 * CYCLE_S, 0.06, 0.1


class StreamedArm:
    """A `Plant` on an `arm`: velocities become short trajectories that end at rest. It has no drill."""

    def __init__(self, arm: ArmAdapter, clock: Callable[[], float] = time.monotonic) -> None:
        self._arm, self._clock = arm, clock
        self._latest = arm.state()
        self._refused = ""  # why the arm's controller followed no longer
        self._commanded: np.ndarray | None = None  # position, while it moves
        self._told_s = self._sent_s = -np.inf

    def read(self) -> Reading:
        """See Plant."""
        try:
            self._latest = replace(self._arm.state(), fault=self._refused)
        except RobotRefusedError as error:
            self._latest = replace(self._latest, fault=str(error))
        self._refused = ""
        return self._latest

    def command(self, joint_velocity: np.ndarray, drill_on: bool) -> None:
        """See Plant. Raises ValueError for a command to drill."""
        if drill_on:
            raise ValueError("this arm has no drill")
        now, velocity = self._clock(), np.asarray(joint_velocity, dtype=np.float64)
        if self._commanded is None:
            self._commanded = self._latest.encoders.copy()
        else:
            self._commanded = self._commanded + (now - self._told_s) * velocity
        self._told_s = now
        if now - self._sent_s >= SEND_S - CYCLE_S / 2:
            self._sent_s = now
            at = self._commanded
            ahead = at + AHEAD_S * velocity
            rest = ahead + (REST_S - AHEAD_S) / 2 * velocity
            positions, velocities = np.stack([at, ahead, rest]), np.stack([velocity, velocity, 0 * velocity])
            try:
                self._arm.follow(JointTrajectory(np.array([0.0, AHEAD_S, REST_S]), positions, velocities))
            except RobotRefusedError as error:
                self._refused = str(error)

    def hold(self) -> None:
        """See Plant."""
        if self._commanded is not None:
            self._commanded, self._sent_s = None, -np.inf
            self._arm.hold()
