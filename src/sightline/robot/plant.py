"""What the controller commands and reads: a manipulator with its drives, drill and sensors, real or simulated."""

from dataclasses import dataclass
from enum import Flag, auto
from typing import Protocol

import numpy as np

CYCLE_S = 0.005  # of reading and commanding: 200 Hz [ours]
WATCHDOG_S = 0.05  # without a command after which the drives stop by themselves: ten cycles [ours]


class PlantFlag(Flag):
    """What a plant says of itself, beside its figures."""

    NONE = 0
    DRILL_ON = auto()
    STOP_PRESSED = auto()  # the hardware stop input: the drives stop by themselves and obey no command
    RUN_HELD = auto()  # the hold-to-run switch is held; without it the drives stop and obey no command
    AT_LIMIT = auto()  # a joint is at a limit, and moves no further that way
    OVERLOAD = auto()  # a drive cannot follow: its force is at its limit


@dataclass(frozen=True, eq=False)
class Reading:
    """One sample of a plant. `time_s` since its start, `encoders` (5,) mm and rad, `force_n` along the wire, positive
    where bone pushes it back."""

    time_s: float
    encoders: np.ndarray
    force_n: float
    flags: PlantFlag


class Plant(Protocol):
    """What moves. A command holds until the next one, but no longer than WATCHDOG_S: then whoever gave it is gone, and
    the drives stop by themselves, the drill off, as after `hold`."""

    def read(self) -> Reading:
        """The latest sample."""
        ...

    def command(self, joint_velocity: np.ndarray, drill_on: bool) -> None:
        """Joint velocities (5,), mm/s and rad/s, cut to the plant's speeds and reached by its accelerations."""
        ...

    def hold(self) -> None:
        """Stop with the plant's accelerations, drill off, and stay there."""
        ...
