"""Courses of the robot: joint moves at limited speed and acceleration, one after another."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from sightline.errors import UnusableInputError
from sightline.robot.control.insertion import Insertion, retracted
from sightline.robot.control.states import Trigger
from sightline.robot.kinematics.manipulator import FEED, JOINTS, ROTARY, Manipulator
from sightline.robot.plant import Reading

ACCELERATION_SHARE = 0.5  # of the manipulator's acceleration: the rest is left for corrections [ours]
RETRACT_MM_S = 10.0  # [ours] feed out of bone, with the drill off: ten times that into it, half of the joint's speed
POSITION_GAIN_PER_S = 10.0  # of the position error: a time constant of 0.1 s, twenty cycles [ours]
# Limits of a joint's position error, moving and standing (mm, rad) [ours]: a servo lags by less, and a jam exceeds them
# at once.
MOVING_LIMIT = np.where(ROTARY, np.deg2rad(0.5), 1.0)
STANDING_LIMIT = MOVING_LIMIT / 5
SETTLED_COUNTS, SETTLE_S = 2.0, 1.0  # at the end of a leg: position error in encoder counts, and time to reach it


class Move:
    """Motion from `start` to `end` (5,), mm and rad, beginning at `begun_s`, with a trapezoidal velocity profile. No
    joint exceeds `speed` or `acceleration` (5,); the slowest joint sets `duration_s`, from rest to rest."""

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
        """Return joint positions (5,) and velocities (5,); at rest before the beginning and after the end."""
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
    """The command of one cycle: joint velocities (5,) and the drill. `trigger`: the transition that ends the activity,
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
        """(5,): commanded position of the joints."""
        ...


@dataclass(frozen=True, eq=False)
class Leg:
    """A straight segment of a course, to the joints `end` (5,) with at most `speed` (5,)."""

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
                    return Step(np.zeros(len(JOINTS)), trigger=Trigger.ARRIVED)
                self._next(now_s)
            elif now_s > self._end_s + SETTLE_S:
                return self._fault(int(np.argmax(unsettled)), behind)
        return Step(velocity + POSITION_GAIN_PER_S * behind)

    def _next(self, now_s: float) -> Move:
        leg = self._left.pop(0)
        acceleration = ACCELERATION_SHARE * self._manipulator.acceleration
        self._move = Move(self.position, leg.end, leg.speed, acceleration, now_s)
        self._limit = np.where(leg.end != self.position, MOVING_LIMIT, STANDING_LIMIT)
        self._end_s = now_s + self._move.duration_s
        return self._move

    def _fault(self, joint: int, behind: np.ndarray) -> Step:
        by = f"{np.rad2deg(abs(behind[joint])):.2f}°" if ROTARY[joint] else f"{abs(behind[joint]):.2f} mm"
        text = f"{JOINTS[joint]} is {by} from where it should be: it is blocked, pushed, or its drive fails"
        return Step(np.zeros(len(JOINTS)), trigger=Trigger.FAULT, text=text)


def align(manipulator: Manipulator, insertion: Insertion, q: np.ndarray) -> Course:
    """Return the course from the joints `q` (5,) to the stand-off: wire back, arm to its line, wire forward."""
    _, back, on_line, forward = insertion.waypoints(manipulator, q)
    speed = manipulator.speed
    return Course(
        manipulator, q, (Leg(back, limit_feed(speed, RETRACT_MM_S)), Leg(on_line, speed), Leg(forward, speed))
    )


def retract(manipulator: Manipulator, q: np.ndarray) -> Course:
    """Return the course that retracts the wire and holds the other joints."""
    return Course(manipulator, q, (Leg(retracted(manipulator, q), limit_feed(manipulator.speed, RETRACT_MM_S)),))


def limit_feed(speed: np.ndarray, feed_mm_s: float) -> np.ndarray:
    """Return the joints' speeds (5,) with the feed's limited to `feed_mm_s`."""
    limited = speed.copy()
    limited[FEED] = min(limited[FEED], feed_mm_s)
    return limited
