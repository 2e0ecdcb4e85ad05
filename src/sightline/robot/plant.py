"""Interface between the controller and the plant: a manipulator with drives, drill and sensors, real or simulated."""

from dataclasses import dataclass
from enum import Flag, auto
from typing import Protocol

import numpy as np

CYCLE_S = 0.005  # period of the control loop: 200 Hz [physics.md, Drilling]
WATCHDOG_S = 10 * CYCLE_S  # the drives stop by themselves after this time without a command


class PlantFlag(Flag):
    """State flags that a plant reports with each reading."""

    NONE = 0
    DRILL_ON = auto()
    STOP_PRESSED = auto()  # hardware stop input: the drives stop by themselves and ignore commands
    RUN_HELD = auto()  # the hold-to-run switch is held; otherwise the drives stop and ignore commands
    AT_LIMIT = auto()  # a joint is at a limit and moves no further in that direction
    OVERLOAD = auto()  # a drive is at its force limit and cannot follow


@dataclass(frozen=True, eq=False)
class Reading:
    """One sample of a plant: `time_s` since its start, `encoders` (n,) in mm and rad, and `force_n` along the wire,
    positive when bone pushes back. `fault`: what a controller of its own reports, "" if nothing."""

    time_s: float
    encoders: np.ndarray
    force_n: float
    flags: PlantFlag
    fault: str = ""


class Plant(Protocol):
    """Drives, drill and sensors. A command holds until the next one, at most WATCHDOG_S. After that the controller is
    presumed dead: the drives stop by themselves and the drill goes off, as after `hold`."""

    def read(self) -> Reading:
        """Return the latest sample."""
        ...

    def command(self, joint_velocity: np.ndarray, drill_on: bool) -> None:
        """Set joint velocities (n,), mm/s and rad/s; the plant limits them to its speeds and accelerations."""

    def hold(self) -> None:
        """Stop the joints with the plant's accelerations, switch the drill off, and hold the position."""
