"""Recent samples of the plant, and the faults in them that must end any motion."""

from collections import deque
from math import isfinite

import numpy as np

from sightline.robot.control.motion.course import MOVING_LIMIT, STANDING_LIMIT
from sightline.robot.control.states import MOVING, WAITING, State
from sightline.robot.kinematics.manipulator import JOINTS, Manipulator, describe_excess
from sightline.robot.plant import Plant, PlantFlag, Reading

STALE_S = 0.05  # after ten cycles without a sample the plant counts as lost [ours]
WINDOW = 6  # samples over which a joint at rest changes by at most one count: below 1 % of full speed
STILL_COUNTS = 1.5


class Samples:
    """The last few samples of a plant. `latest`: the newest sample with finite values."""

    def __init__(self, plant: Plant) -> None:
        self._plant = plant
        self.latest: Reading = plant.read()
        self._sound = True  # the last sample was finite
        self._sampled_s: float | None = None  # LoopClock time: a pause of the controller is not the plant's silence
        self._past: deque[Reading] = deque([self.latest], maxlen=WINDOW)

    def take(self, now_s: float) -> None:
        """Read one sample."""
        reading = self._plant.read()
        self._sound = isfinite(reading.force_n) and all(map(isfinite, reading.encoders.tolist()))
        if not self._sound:
            return
        if self._sampled_s is None or reading.time_s > self.latest.time_s:
            self._sampled_s = now_s
            self._past.append(reading)
        self.latest = reading

    def missing(self, now_s: float) -> str | None:
        """Return why there is no valid sample of the plant; None if there is one."""
        if not self._sound:
            return "an encoder or the force sensor gives no number"
        if self._sampled_s is None or now_s - self._sampled_s > STALE_S:
            return f"no sample from the drives for {STALE_S:g} s"
        return None

    def wrong(self, manipulator: Manipulator, state: State, rest: np.ndarray) -> str | None:
        """Return the fault in the latest sample for a robot that moves, or that should stand at `rest` (5,); else
        None."""
        reading = self.latest
        beyond = manipulator.beyond_limits(reading.encoders)
        outside = np.abs(beyond) > MOVING_LIMIT
        if any(outside.tolist()):
            joint = int(np.argmax(outside))
            at, excess = float(reading.encoders[joint]), float(beyond[joint])
            return f"outside the workspace: {describe_excess(joint, at, excess, 'is at')}"
        if PlantFlag.OVERLOAD in reading.flags and state in MOVING:
            return "a drive is at the limit of its force: something blocks the robot"
        if state in WAITING:
            off = np.abs(reading.encoders - rest) > STANDING_LIMIT
            if off.any():
                return f"{JOINTS[int(np.argmax(off))]} was moved while it should stand"
        return None

    @property
    def velocity(self) -> np.ndarray:
        """(5,): joint velocities over the window, mm/s and rad/s."""
        first, last = self._past[0], self._past[-1]
        elapsed = last.time_s - first.time_s
        return (last.encoders - first.encoders) / elapsed if elapsed > 0 else np.zeros(len(JOINTS))

    def still(self, manipulator: Manipulator) -> bool:
        """Return whether all joints stand still."""
        moved = np.ptp([reading.encoders for reading in self._past], axis=0)
        return len(self._past) == WINDOW and bool((moved < STILL_COUNTS * manipulator.resolution).all())
