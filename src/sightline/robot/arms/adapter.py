"""Interface between the link's machine and an arm whose own controller follows trajectories."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from sightline.robot.plant import Reading


@dataclass(frozen=True, eq=False)
class JointTrajectory:
    """Joint `positions` (N, n) and `velocities` (N, n) at `time_s` (N,) after its start, from rest to rest; rad or mm.

    It begins at the arm's present position. Between two samples the arm interpolates.
    """

    time_s: np.ndarray
    positions: np.ndarray
    velocities: np.ndarray


class ArmAdapter(Protocol):
    """An arm of n joints with a controller of its own. Every method returns at once; what the controller reports later
    appears in `state`. If this process dies the arm must stop by itself within 100 ms."""

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
        """Decelerate to rest and hold the position, stiff."""

    def stop(self) -> None:
        """Stop as fast as the arm can; nothing moves before the next `follow`."""
