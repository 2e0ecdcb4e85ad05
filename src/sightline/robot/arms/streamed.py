"""The plant made of an arm that follows trajectories."""

import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from sightline.errors import RobotRefusedError
from sightline.robot.arms.adapter import REST_S, SEND_S, ArmAdapter, JointTrajectory
from sightline.robot.plant import CYCLE_S, Reading

# Each trajectory goes on for AHEAD_S, then decelerates [ours]. A controller that begins it late and elsewhere is on it
# before the next one comes.
AHEAD_S = 0.06
TIMES_S = np.array([0.0, SEND_S, AHEAD_S, REST_S])


class StreamedArm:
    """A `Plant` on an `arm`: velocities become short trajectories that end at rest. It has no drill."""

    def __init__(self, arm: ArmAdapter, clock: Callable[[], float] = time.monotonic) -> None:
        self._arm, self._clock = arm, clock
        self._latest = arm.state()
        self._refused = ""  # why the arm's controller followed no longer
        self._held = False  # since the last trajectory, or fault
        self._commanded: np.ndarray | None = None  # position, while it moves
        self._told_s = self._sent_s = -np.inf

    def read(self) -> Reading:
        """See Plant."""
        try:
            self._latest = replace(self._arm.state(), fault=self._refused)
        except RobotRefusedError as error:
            self._latest, self._held = replace(self._latest, fault=str(error)), False
        self._refused = ""
        return self._latest

    def command(self, joint_velocity: np.ndarray, drill_on: bool) -> None:
        """See Plant. Raises ValueError for a command to drill."""
        if drill_on:
            raise ValueError("this arm has no drill")
        now, velocity = self._clock(), np.asarray(joint_velocity, dtype=np.float64)
        at = self._commanded  # the link's thread may hold the arm meanwhile
        at = self._latest.encoders.copy() if at is None else at + (now - self._told_s) * velocity
        self._commanded, self._told_s, self._held = at, now, False
        if now - self._sent_s >= SEND_S - CYCLE_S / 2:
            self._sent_s = now
            along_s = np.array([0.0, SEND_S, AHEAD_S, (AHEAD_S + REST_S) / 2])
            pace = np.array([1.0, 1.0, 1.0, 0.0])
            try:
                self._arm.follow(JointTrajectory(TIMES_S, at + np.outer(along_s, velocity), np.outer(pace, velocity)))
            except RobotRefusedError as error:
                self._refused = str(error)

    def hold(self) -> None:
        """See Plant."""
        if not self._held:
            self._commanded, self._sent_s, self._held = None, -np.inf, True
            self._arm.hold()
