"""What the robot does below MOVE_TO_TARGET while it moves: align, drill, retract. Each is stepped once a cycle."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from sightline.errors import UnusableInputError
from sightline.robot.insertion import STANDOFF_MM, Insertion, retracted
from sightline.robot.manipulator import FEED, JOINTS, TURNS, Manipulator
from sightline.robot.motion import Move
from sightline.robot.plant import Reading
from sightline.robot.states import Cause
from sightline.robot.supervision import Event, Noted, Supervision

ACCELERATION_SHARE = 0.5  # of the manipulator's, so that the drives can still correct [ours]
RETRACT_MM_S = 10.0  # out of bone, the drill off [ours]
APPROACH_MM_S, NEAR_MM = 5.0, 2.0  # towards the entry point, and from where on as in bone: its 95 % error, twice [ours]
DRILL_MM_S = 1.0  # 60 mm/min [physics.md, Drilling]
PAUSE_MM = 10.0  # short of the tip, for the second shot [issue]
# A wire that leaves bone beyond this share of its path has gone through the far side, not the near one [ours].
FAR_SHARE = 0.5
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
    return Course(manipulator, q, (Leg(back, _feeding(speed, RETRACT_MM_S)), Leg(turned, speed), Leg(forward, speed)))


def retract(manipulator: Manipulator, q: np.ndarray) -> Course:
    """The wire back, all else held."""
    return Course(manipulator, q, (Leg(retracted(manipulator, q), _feeding(manipulator.speed, RETRACT_MM_S)),))


class Drilling:
    """One hole, with its pause. `resume` starts it, and starts it again."""

    def __init__(self, manipulator: Manipulator, insertion: Insertion) -> None:
        self.position = insertion.at_depth(-STANDOFF_MM)
        self.noted: list[Noted] = []
        self.insertion = insertion  # a check shot may set its depths anew while the drill stands
        self._manipulator = manipulator
        self._supervision: Supervision
        self._sampled_s = -np.inf
        self._pause_mm = max(insertion.length_mm - PAUSE_MM, 0.0)
        self._paused = self._near = False

    def resume(self) -> None:
        """Go on, from where the wire is."""
        self._supervision = Supervision(self.insertion.length_mm, self.insertion.depth_limit_mm)
        self._begin()

    def step(self, reading: Reading, now_s: float) -> Step:
        """One cycle: PAUSE short of the tip, ARRIVED at it; HALT or FAULT with the reason."""
        stopped = self._watch(reading)
        if stopped is not None:
            return stopped
        if not self._near and any(noted.event is Event.CONTACT for noted in self.noted):
            self._begin()  # slower from here on
        step = self._course.step(reading, now_s)
        self.position = self._course.position
        if step.cause is Cause.ARRIVED and not self._paused:
            self._paused = True
            return Step(step.velocity, cause=Cause.PAUSE)
        return Step(step.velocity, drill_on=step.cause is None, cause=step.cause, text=step.text)

    def _begin(self) -> None:
        goal = self.insertion.length_mm if self._paused else self._pause_mm
        speed = self._manipulator.speed
        legs = [Leg(self.insertion.at_depth(goal), _feeding(speed, DRILL_MM_S))]
        depth = self.position[FEED] - self.insertion.q[FEED]
        touched = any(noted.event is Event.CONTACT for noted in self.noted)
        if depth < -NEAR_MM and not touched:
            legs.insert(0, Leg(self.insertion.at_depth(-NEAR_MM), _feeding(speed, APPROACH_MM_S)))
        self._near = len(legs) == 1
        self._course = Course(self._manipulator, self.position, legs)

    def _watch(self, reading: Reading) -> Step | None:
        """What the supervision says against going on."""
        if reading.time_s == self._sampled_s:
            return None
        self._sampled_s = reading.time_s
        depth = float(reading.encoders[FEED] - self.insertion.q[FEED])
        try:
            noted = self._supervision.step(reading.time_s, depth, reading.force_n)
        except UnusableInputError as error:
            return _stop(Cause.FAULT, str(error))
        self.noted += noted
        for event in noted:
            said = _SAID.get(event.event)
            if said is not None:
                return _stop(Cause.FAULT, said.format(force=event.force_n, depth=event.depth_mm))
            if event.event is Event.BREAK_THROUGH and depth > FAR_SHARE * self.insertion.length_mm:
                return _stop(
                    Cause.HALT, f"the wire broke through a cortex at {depth:.1f} mm, on the far side: take a check shot"
                )
        return None


_SAID = {
    Event.FORCE_LIMIT: "the thrust of {force:.0f} N at {depth:.1f} mm is above its limit",
    Event.DEPTH_LIMIT: "the wire reached its depth limit at {depth:.1f} mm",
}


def _stop(cause: Cause, text: str) -> Step:
    return Step(np.zeros(len(JOINTS)), cause=cause, text=text)


def _feeding(speed: np.ndarray, feed_mm_s: float) -> np.ndarray:
    out = speed.copy()
    out[FEED] = min(out[FEED], feed_mm_s)
    return out
