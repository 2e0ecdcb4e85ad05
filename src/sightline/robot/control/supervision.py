"""Supervision of drilling: contact, cortex, break-through, depth and force limits, from depth and force alone.

Forces are noisy and bone is uneven, so events are detected in filtered values: a Kalman filter estimates the force and
its rate, as the paper's group did for break-through [Mechatronics 9:565 1999].
"""

from dataclasses import dataclass
from enum import Enum
from math import exp, isfinite, sqrt

from sightline.errors import RobotRefusedError, UnusableInputError
from sightline.robot.contract import OPEN_HOLE
from sightline.robot.plant import WATCHDOG_S

# Noise of a force sample, 1 s.d.: proportional to the force, with a floor in N [physics.md, Drilling].
NOISE_SHARE, NOISE_FLOOR_N = 0.1, 0.3
FORCE_LIMIT_N = 80.0  # [physics.md, Drilling]
# Process noise of the force rate (random walk), N/s per root second: a 2.5 mm wire fed at 1 mm/s leaves a cortex in
# about a second, 30 N/s [ours].
RATE_WALK = 25.0
# Contact threshold: cancellous bone gives 1 to 1.5 N, skin and muscle less [physics.md, Drilling].
CONTACT_N = 1.0
CORTEX_N = 6.0  # above cancellous bone of any density, a sixth of a common cortex [ours]
# Break-through: the force has fallen to this share of its peak in the cortex, and its rate is this many standard
# deviations below zero [ours; benchmarks/supervision.py has delay and false alarms over 1,000 holes].
FALLEN_SHARE, FALLING_SIGMA = 0.6, 2.0
# Decay length of the stored peak force, so that the ramp of an oblique entry does not stay the peak for ever [ours].
MEMORY_MM = 1.0
MAX_GAP_S = WATCHDOG_S  # between samples; a longer gap was not supervised


class EventKind(Enum):
    """Kinds of events in drilling."""

    OPEN_HOLE = OPEN_HOLE
    CONTACT = "contact"
    CORTEX = "cortex"
    BREAK_THROUGH = "break-through"
    DEPTH = "planned depth"
    DEPTH_LIMIT = "depth limit"
    FORCE_LIMIT = "force limit"


@dataclass(frozen=True)
class SupervisionEvent:
    """An event with its time, its depth beyond the zero of depth, and the filtered force."""

    event: EventKind
    time_s: float
    depth_mm: float
    force_n: float


def depth_limit(distance_mm: float, depth_error_95_mm: float) -> float:
    """Return the depth limit, mm, for a bone surface `distance_mm` beyond the zero of depth along the wire.

    It is the distance less the 95 % error of depth, so that the surface stays intact in 97.5 % of the cases. Raises
    RobotRefusedError if nothing is left to drill.
    """
    limit = distance_mm - depth_error_95_mm
    if not (isfinite(limit) and depth_error_95_mm >= 0 and limit > 0):
        raise RobotRefusedError(
            "fix the zero of depth by a second shot, or plan a shorter wire: no depth is safe, since the surface lies "
            f"{distance_mm:.1f} mm beyond the zero and the 95 % error of depth is {depth_error_95_mm:.1f} mm"
        )
    return limit


class ForceFilter:
    """Kalman filter of a force and its rate, for samples at irregular times."""

    def __init__(self) -> None:
        self.force_n = self.rate_n_s = 0.0
        self._var = (NOISE_FLOOR_N**2, 0.0, RATE_WALK**2)  # force, both, rate
        self._time_s: float | None = None

    def add(self, time_s: float, force_n: float) -> None:
        """Add a sample. Raises UnusableInputError if it is not finite, or not later than the last."""
        if not (isfinite(time_s) and isfinite(force_n)):
            raise UnusableInputError("a force sample must be finite: the sensor or its link has failed")
        dt = 0.0 if self._time_s is None else time_s - self._time_s
        if self._time_s is not None and not dt > 0:
            raise UnusableInputError("force samples must follow each other in time: the sensor's clock has failed")
        self._time_s = time_s
        ff, fr, rr = self._var
        walk = RATE_WALK**2
        force = self.force_n + dt * self.rate_n_s
        ff, fr, rr = (
            ff + 2 * dt * fr + dt**2 * rr + walk * dt**3 / 3,
            fr + dt * rr + walk * dt**2 / 2,
            rr + walk * dt,
        )
        noise = (NOISE_SHARE * force) ** 2 + NOISE_FLOOR_N**2
        gain_f, gain_r = ff / (ff + noise), fr / (ff + noise)
        off = force_n - force
        self.force_n, self.rate_n_s = force + gain_f * off, self.rate_n_s + gain_r * off
        self._var = ((1 - gain_f) * ff, (1 - gain_f) * fr, rr - gain_r * fr)

    @property
    def rate_sigma(self) -> float:
        """The rate divided by its standard deviation."""
        return self.rate_n_s / sqrt(self._var[2])


class Supervision:
    """Supervision of one hole. Depths are mm of feed beyond the zero of depth, which may be corrected (depth.py).
    `touched`: the wire is already in bone."""

    def __init__(self, planned_mm: float, limit_mm: float, *, touched: bool = False) -> None:
        if not 0 < planned_mm <= limit_mm:
            raise RobotRefusedError(
                f"the planned depth of {planned_mm:.1f} mm lies beyond the depth limit of {limit_mm:.1f} mm; plan a "
                "shorter wire, or take a check shot to fix the zero of depth"
            )
        self._planned_mm, self._limit_mm = planned_mm, limit_mm
        self._filter = ForceFilter()
        self._cortex_n = 0.0  # decaying peak force while in a cortex, otherwise 0
        self._left = False  # a cortex was left and its force is still falling
        self._touched, self._arrived = touched, False
        self._last: tuple[float, float] | None = None

    @property
    def force_n(self) -> float:
        """The filtered force."""
        return self._filter.force_n

    def step(self, time_s: float, depth_mm: float, force_n: float) -> tuple[SupervisionEvent, ...]:
        """Return the events of this sample. Raises UnusableInputError if the sample is not finite or came too late:
        drilling was then unsupervised and must stop."""
        if not isfinite(depth_mm):
            raise UnusableInputError("the depth must be a finite number: an encoder or its link has failed")
        if self._last is not None and time_s - self._last[0] > MAX_GAP_S:
            raise UnusableInputError(f"no force for {time_s - self._last[0]:.2f} s: nothing was watched meanwhile")
        fed = 0.0 if self._last is None else max(depth_mm - self._last[1], 0.0)
        self._filter.add(time_s, force_n)
        self._last = (time_s, depth_mm)
        events = [*self._limits(depth_mm), *self._bone(fed)]
        return tuple(SupervisionEvent(event, time_s, depth_mm, self.force_n) for event in events)

    def _limits(self, depth_mm: float) -> list[EventKind]:
        events = []
        if self.force_n > FORCE_LIMIT_N:
            events.append(EventKind.FORCE_LIMIT)
        if depth_mm >= self._limit_mm:
            events.append(EventKind.DEPTH_LIMIT)
        if depth_mm >= self._planned_mm and not self._arrived:
            self._arrived = True
            events.append(EventKind.DEPTH)
        return events

    def _bone(self, fed_mm: float) -> list[EventKind]:
        events = []
        if not self._touched and self.force_n > CONTACT_N:
            self._touched = True
            events.append(EventKind.CONTACT)
        if self.force_n < CORTEX_N / 2:
            self._left = False
        elif self.force_n > CORTEX_N and self._cortex_n == 0.0 and not self._left:
            self._cortex_n = self.force_n
            events.append(EventKind.CORTEX)
        if self._cortex_n > 0.0:
            self._cortex_n = max(self.force_n, self._cortex_n * exp(-fed_mm / MEMORY_MM))
            if self.force_n < FALLEN_SHARE * self._cortex_n and self._filter.rate_sigma < -FALLING_SIGMA:
                self._cortex_n, self._left = 0.0, True
                events.append(EventKind.BREAK_THROUGH)
        return events
