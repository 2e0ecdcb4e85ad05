"""Courses of the robot: joint moves at limited speed and acceleration, one after another."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from sightline.errors import UnusableInputError
from sightline.robot.control.insertion import Insertion, guide_back, retracted
from sightline.robot.control.states import Trigger
from sightline.robot.kinematics.manipulator import Manipulator
from sightline.robot.plant import Reading

ACCELERATION_SHARE = 0.5  # of the manipulator's acceleration: the rest is left for corrections [ours]
RETRACT_MM_S = 10.0  # [ours] feed out of bone, with the drill off: ten times that into it, half of the joint's speed
POSITION_GAIN_PER_S = 10.0  # of the position error: a time constant of 0.1 s, twenty cycles [ours]
# Limits of a joint's position error, moving and standing (mm, rad) [ours]: a servo lags by less, and a jam exceeds them
# at once.
MOVING_LIMIT_MM, MOVING_LIMIT_RAD, STANDING_SHARE = 1.0, float(np.deg2rad(0.5)), 0.2
SETTLED_COUNTS, SETTLE_S = 2.0, 1.0  # at the end of a leg: position error in encoder counts, and time to reach it


def moving_limit(manipulator: Manipulator) -> np.ndarray:
    """Return the limits (n,) of the joints' position errors during a motion; STANDING_SHARE of them at rest."""
    return np.where(manipulator.rotary, MOVING_LIMIT_RAD, MOVING_LIMIT_MM)


class Move:
    """Motion from `start` to `end` (n,), mm and rad, beginning at `begun_s`, with a trapezoidal velocity profile. No
    joint exceeds `speed` or `acceleration` (n,); the slowest joint sets `duration_s`, from rest to rest."""

    def __init__(
        self, start: np.ndarray, end: np.ndarray, speed: np.ndarray, acceleration: np.ndarray, begun_s: float
    ) -> None:
        if not all(np.isfinite(part).all() for part in (start, end, speed, acceleration)):
            raise UnusableInputError("a motion needs finite positions, speeds and accelerations")
        self.start, self.end, self.begun_s = start, end, begun_s
        self._path = end - start
        moving = self._path != 0
        distance = np.abs(self._path[moving])
        self._rise_s = self.duration_s = 0.0
        if moving.any():
            # Acceleration and speed as shares of the whole path, 1/s² and 1/s.
            self._rate, pace = float((acceleration[moving] / distance).min()), float((speed[moving] / distance).min())
            self._rise_s = float(min(pace / self._rate, 1 / np.sqrt(self._rate)))
            level_s = max(1 / (self._rate * self._rise_s) - self._rise_s, 0.0)
            self.duration_s = 2 * self._rise_s + level_s

    def at(self, time_s: float) -> tuple[np.ndarray, np.ndarray]:
        """Return joint positions (n,) and velocities (n,); at rest before the beginning and after the end."""
        if self._rise_s == 0:
            return self.end, np.zeros_like(self.end)
        t = min(max(time_s - self.begun_s, 0.0), self.duration_s)
        left = self.duration_s - t
        peak = self._rate * self._rise_s
        if t < self._rise_s:
            share, pace = self._rate * t**2 / 2, self._rate * t
        elif left < self._rise_s:
            share, pace = 1 - self._rate * left**2 / 2, self._rate * left
        else:
            share, pace = peak * (t - self._rise_s / 2), peak
        return self.start + share * self._path, pace * self._path


@dataclass(frozen=True, eq=False)
class Step:
    """The command of one cycle: joint velocities (n,) and the drill. `trigger`: the transition that ends the activity,
    with its reason in `text`; None while the activity continues."""

    velocity: np.ndarray
    drill_on: bool = False
    trigger: Trigger | None = None
    text: str = ""


class Activity(Protocol):
    """A motion that lasts many cycles."""

    def step(self, reading: Reading, now_s: float) -> Step:
        """Return the command for one cycle."""
        ...

    @property
    def position(self) -> np.ndarray:
        """(n,): commanded position of the joints."""
        ...


@dataclass(frozen=True, eq=False)
class Leg:
    """A straight segment of a course, to the joints `end` (n,) with at most `speed` (n,)."""

    end: np.ndarray
    speed: np.ndarray


class Course:
    """Legs in sequence, each from rest to rest, with position control. Its time begins with the first step."""

    def __init__(self, manipulator: Manipulator, start: np.ndarray, legs: Sequence[Leg]) -> None:
        self.position = np.array(start, dtype=np.float64)
        self._manipulator, self._left = manipulator, list(legs)
        self._move: Move | None = None

    def step(self, reading: Reading, now_s: float) -> Step:
        """Return one cycle's command: ARRIVED at the end of the last leg, FAULT if a position error is too large."""
        move = self._move or self._next(now_s)
        self.position, velocity = move.at(now_s)
        behind = self.position - reading.encoders
        off = np.abs(behind) > self._limit
        if any(off.tolist()):
            return self._fault(int(np.argmax(off)), behind)
        if now_s >= self._end_s:
            unsettled = np.abs(behind) > SETTLED_COUNTS * self._manipulator.resolution
            if not unsettled.any():
                if not self._left:
                    return Step(np.zeros(self._manipulator.count), trigger=Trigger.ARRIVED)
                self._next(now_s)
            elif now_s > self._end_s + SETTLE_S:
                return self._fault(int(np.argmax(unsettled)), behind)
        return Step(velocity + POSITION_GAIN_PER_S * behind)

    def _next(self, now_s: float) -> Move:
        leg = self._left.pop(0)
        acceleration = ACCELERATION_SHARE * self._manipulator.acceleration
        self._move = Move(self.position, leg.end, leg.speed, acceleration, now_s)
        self._limit = moving_limit(self._manipulator) * np.where(leg.end != self.position, 1.0, STANDING_SHARE)
        self._end_s = now_s + self._move.duration_s
        return self._move

    def _fault(self, joint: int, behind: np.ndarray) -> Step:
        by, arm = float(abs(behind[joint])), self._manipulator
        text = f"{np.rad2deg(by):.2f}°" if arm.rotary[joint] else f"{by:.2f} mm"
        text = f"{arm.joints[joint]} is {text} from where it should be: it is blocked, pushed, or its drive fails"
        return Step(np.zeros(arm.count), trigger=Trigger.FAULT, text=text)


def align(manipulator: Manipulator, insertion: Insertion, q: np.ndarray) -> Course:
    """Return the course from the joints `q` (n,) to the stand-off, through the insertion's waypoints."""
    speed = manipulator.speed
    first, *legs = (Leg(end, speed) for end in insertion.waypoints(manipulator, q)[1:])
    if manipulator.has_feed:
        first = Leg(first.end, limit_feed(manipulator, RETRACT_MM_S))
    return Course(manipulator, q, (first, *legs))


def retract(manipulator: Manipulator, q: np.ndarray) -> Course:
    """Return the course that retracts the wire and holds the other joints, or that draws the guide back."""
    if not manipulator.has_feed:
        return Course(manipulator, q, [Leg(end, manipulator.speed) for end in guide_back(manipulator, q)])
    return Course(manipulator, q, (Leg(retracted(manipulator, q), limit_feed(manipulator, RETRACT_MM_S)),))


def limit_feed(manipulator: Manipulator, feed_mm_s: float) -> np.ndarray:
    """Return the joints' speeds (n,) with the feed's limited to `feed_mm_s`."""
    limited = manipulator.speed.copy()
    limited[manipulator.feed] = min(limited[manipulator.feed], feed_mm_s)
    return limited
