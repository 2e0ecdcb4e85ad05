"""What the plant has said of late, and what in it must end motion whatever the robot is doing."""

from collections import deque

import numpy as np

from sightline.robot.control.motion.course import MOVING_LIMIT, STANDING_LIMIT
from sightline.robot.control.states import MOVING, WAITING, State
from sightline.robot.kinematics.manipulator import JOINTS, Manipulator, said_beyond
from sightline.robot.plant import Plant, PlantFlag, Reading

STALE_S = 0.05  # ten cycles without a sample: the plant is gone [ours]
WINDOW = 6  # samples in which a joint that stands changes by a count at most: speed below 1 % of full speed
STILL_COUNTS = 1.5


class Samples:
    """The last few samples of a plant. `latest`: the newest one of numbers; what was last known stays known."""

    def __init__(self, plant: Plant) -> None:
        self._plant = plant
        self.latest: Reading = plant.read()
        self._sound = True  # the last sample was one of numbers
        self._sampled_s: float | None = None  # the controller's own time, so that its pauses are not the plant's
        self._past: deque[Reading] = deque([self.latest], maxlen=WINDOW)

    def take(self, now_s: float) -> None:
        """One more."""
        reading = self._plant.read()
        self._sound = bool(np.isfinite(reading.encoders).all() and np.isfinite(reading.force_n))
        if not self._sound:
            return
        if self._sampled_s is None or reading.time_s > self.latest.time_s:
            self._sampled_s = now_s
            self._past.append(reading)
        self.latest = reading

    def missing(self, now_s: float) -> str | None:
        """Why nothing is known of the plant, if nothing is."""
        if not self._sound:
            return "an encoder or the force sensor gives no number"
        if self._sampled_s is None or now_s - self._sampled_s > STALE_S:
            return f"no sample from the drives for {STALE_S:g} s"
        return None

    def wrong(self, manipulator: Manipulator, state: State, rest: np.ndarray) -> str | None:
        """What must not be while the robot moves or, in its activities, stands at `rest` (5,)."""
        reading = self.latest
        beyond = manipulator.beyond_limits(reading.encoders)
        outside = np.abs(beyond) > MOVING_LIMIT
        if outside.any():
            joint = int(np.argmax(outside))
            return f"outside the workspace: {said_beyond(joint, float(reading.encoders[joint]), float(beyond[joint]))}"
        if reading.flags & PlantFlag.OVERLOAD and state in MOVING:
            return "a drive is at the limit of its force: something blocks the robot"
        if state in WAITING:
            off = np.abs(reading.encoders - rest) > STANDING_LIMIT
            if off.any():
                return f"{JOINTS[int(np.argmax(off))]} was moved while it should stand"
        return None

    @property
    def velocity(self) -> np.ndarray:
        """(5,) of the joints."""
        first, last = self._past[0], self._past[-1]
        elapsed = last.time_s - first.time_s
        return (last.encoders - first.encoders) / elapsed if elapsed > 0 else np.zeros(len(JOINTS))

    def still(self, manipulator: Manipulator) -> bool:
        """Whether all joints stand."""
        moved = np.ptp([reading.encoders for reading in self._past], axis=0)
        return len(self._past) == WINDOW and bool((moved < STILL_COUNTS * manipulator.resolution).all())
