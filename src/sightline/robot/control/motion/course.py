"""What the robot does below MOVE_TO_TARGET while it moves: courses of its joints, to align and to retract. Drilling is
in robot/control/motion/drilling.py. Each is stepped once a cycle."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from sightline.robot.control.insertion import Insertion, retracted
from sightline.robot.control.motion.move import Move
from sightline.robot.control.states import Cause
from sightline.robot.kinematics.manipulator import FEED, JOINTS, TURNS, Manipulator
from sightline.robot.plant import Reading

ACCELERATION_SHARE = 0.5  # of the manipulator's, so that the drives can still correct [ours]
RETRACT_MM_S = 10.0  # out of bone, the drill off [ours]
PULL_PER_S = 10.0  # of what a joint is behind: a time constant of 0.1 s, twenty cycles [ours]
# How far a joint may be from where it should be: while it moves, and while it should stand (mm, rad) [ours].
MOVING_LIMIT = np.where(TURNS, np.deg2rad(0.5), 1.0)
STANDING_LIMIT = MOVING_LIMIT / 5
SETTLED_COUNTS, SETTLE_S = 2.0, 1.0  # at the end: so near, within this time


@dataclass(frozen=True, eq=False)
class Step:
    """What to command now. `cause`: what this leads to, and why in `text`; None while the activity goes on."""

    velocity: np.ndarray
    drill_on: bool = False
    cause: Cause | None = None
    text: str = ""


class Activity(Protocol):
    """Something the robot does for a while."""

    def step(self, reading: Reading, now_s: float) -> Step:
        """One cycle."""
        ...

    @property
    def position(self) -> np.ndarray:
        """(5,): where the joints should be."""
        ...


@dataclass(frozen=True, eq=False)
class Leg:
    """A straight piece of a course: to the joints `end` (5,), at most at `speed` (5,)."""

    end: np.ndarray
    speed: np.ndarray


class Course:
    """One leg after the other, each from rest to rest, the joints kept on it. Its time begins with the first step."""

    def __init__(self, manipulator: Manipulator, start: np.ndarray, legs: Sequence[Leg]) -> None:
        self.position = np.array(start, dtype=np.float64)
        self._manipulator, self._left = manipulator, list(legs)
        self._move: Move | None = None

    def step(self, reading: Reading, now_s: float) -> Step:
        """One cycle: ARRIVED at the end of the last leg, FAULT where a joint is not where it should be."""
        move = self._move or self._next(now_s)
        self.position, velocity = move.at(now_s)
        behind = self.position - reading.encoders
        off = np.abs(behind) > np.where(self._moves, MOVING_LIMIT, STANDING_LIMIT)
        if off.any():
            return self._fault(int(np.argmax(off)), behind)
        if now_s >= self._end_s:
            unsettled = np.abs(behind) > SETTLED_COUNTS * self._manipulator.resolution
            if not unsettled.any():
                if not self._left:
                    return Step(np.zeros(len(JOINTS)), cause=Cause.ARRIVED)
                self._next(now_s)
            elif now_s > self._end_s + SETTLE_S:
                return self._fault(int(np.argmax(unsettled)), behind)
        return Step(velocity + PULL_PER_S * behind)

    def _next(self, now_s: float) -> Move:
        leg = self._left.pop(0)
        acceleration = ACCELERATION_SHARE * self._manipulator.acceleration
        self._move = Move(self.position, leg.end, leg.speed, acceleration, now_s)
        self._moves = leg.end != self.position
        self._end_s = now_s + self._move.duration_s
        return self._move

    def _fault(self, joint: int, behind: np.ndarray) -> Step:
        by = f"{np.rad2deg(abs(behind[joint])):.2f}°" if TURNS[joint] else f"{abs(behind[joint]):.2f} mm"
        text = f"{JOINTS[joint]} is {by} from where it should be: it is blocked, pushed, or its drive fails"
        return Step(np.zeros(len(JOINTS)), cause=Cause.FAULT, text=text)


def align(manipulator: Manipulator, insertion: Insertion, q: np.ndarray) -> Course:
    """From the joints `q` (5,): the wire back, the arm turned, the wire forward to its stand-off."""
    _, back, turned, forward = insertion.course(manipulator, q)
    speed = manipulator.speed
    return Course(manipulator, q, (Leg(back, feeding(speed, RETRACT_MM_S)), Leg(turned, speed), Leg(forward, speed)))


def retract(manipulator: Manipulator, q: np.ndarray) -> Course:
    """The wire back, all else held."""
    return Course(manipulator, q, (Leg(retracted(manipulator, q), feeding(manipulator.speed, RETRACT_MM_S)),))


def feeding(speed: np.ndarray, feed_mm_s: float) -> np.ndarray:
    """(5,): the joints' speeds, the feed's no more than this."""
    out = speed.copy()
    out[FEED] = min(out[FEED], feed_mm_s)
    return out
