"""An arm that does exactly what it is told: a rehearsal of the commands of a real one, without physics."""

import time
from collections.abc import Callable

import numpy as np
from scipy.interpolate import CubicHermiteSpline

from sightline.robot.arms.adapter import JointTrajectory, checked, decelerated
from sightline.robot.kinematics.manipulator import Manipulator
from sightline.robot.plant import PlantFlag, Reading


class SimulatedArm:
    """The arm `robot` at the joints `q` (n,) at first. `clock`: in s."""

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
