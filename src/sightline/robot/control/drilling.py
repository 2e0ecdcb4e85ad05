"""Drilling one hole: approach, contact, pause for the check shot, end point. Every sample is supervised."""

import numpy as np

from sightline.errors import RobotRefusedError, UnusableInputError
from sightline.robot.control.course import Course, Leg, Step, limit_feed
from sightline.robot.control.insertion import Insertion
from sightline.robot.control.states import Trigger
from sightline.robot.control.supervision import CORTEX_N, EventKind, Supervision, SupervisionEvent
from sightline.robot.kinematics.manipulator import Manipulator
from sightline.robot.kinematics.target import (
    CONTACT_LEAD_MM,
    CONTACT_SD_MM,
    MAX_ZERO_SHIFT_MM,
    DepthZero,
    contact_range,
    pause_depth,
)
from sightline.robot.plant import Reading

# Feed towards the entry point, and the distance before it at which drilling feed begins: twice its 95 % error [ours].
APPROACH_MM_S, NEAR_MM = 5.0, 2.0
DRILL_MM_S = 1.0  # 60 mm/min [physics.md, Drilling]
# A break-through beyond this share of the path is at the far cortex, not the near one [ours]: each lies near its end.
FAR_SHARE = 0.5
# A drill that goes past its end point goes on by the length of its point once it breaks through the far cortex [ours].
POINT_MM = 3.0


class Drilling:
    """One hole, with its pause. `resume` starts it and continues after the pause. `zero`: the current zero of depth.
    `into_bone`: bone is expected at the planned entry, and contact with it corrects the zero. Where bone begins
    somewhere before the entry (`Limits.before_mm`), a cortex must be met on the way, and the zero stays.

    `before`: the same hole, left unfinished. Its zero and what was met hold on; bone is not sought again, and bone met
    before its bottom shows that the wire is not in it."""

    def __init__(
        self, manipulator: Manipulator, insertion: Insertion, into_bone: bool, before: "Drilling | None" = None
    ) -> None:
        self.noted: list[SupervisionEvent] = []
        self._feed = manipulator.feed
        self.zero = DepthZero(float(insertion.q[self._feed])) if before is None else before.zero
        self._manipulator, self.insertion = manipulator, insertion
        self.position = self._at(-insertion.standoff_mm)
        self._supervision: Supervision
        self._sampled_s = -np.inf
        self._pause_mm = pause_depth(insertion.length_mm, insertion.limits)
        self._end_mm = insertion.length_mm
        self._before_mm = insertion.limits.before_mm
        self._contact_mm = contact_range(self._before_mm)
        self._paused = self._touched = False
        self._seeks_bone = into_bone
        self._bottom_feed_mm: float | None = None  # of the hole; None before bone was met
        self._open_mm: float | None = None
        self._ended_in_cortex = False
        if before is not None:
            self._ended_in_cortex = before._ended_in_cortex or before._supervision.force_n > CORTEX_N
            self._end_mm, self._seeks_bone = before._end_mm, before._seeks_bone
            self._bottom_feed_mm, self._open_mm = before._bottom_feed_mm, before.bottom_mm

    @property
    def bottom_mm(self) -> float | None:
        """Depth of the hole, mm; None while the wire has met nothing."""
        return None if self._bottom_feed_mm is None else self.zero.depth_mm(self._bottom_feed_mm)

    def resume(self) -> None:
        """Start or continue from the wire's current position."""
        self._supervision = Supervision(self.insertion.length_mm, self.insertion.depth_limit_mm, touched=self._touched)
        self._begin()

    def correct_depth(self, feed_mm: float, depth_mm: float, sd_mm: float) -> None:
        """Correct the zero of depth: at `feed_mm` the tip was measured at `depth_mm`, standard deviation `sd_mm`.
        Raises RobotRefusedError if the correction is too large or leaves too little feed."""
        zero = self.zero.corrected(feed_mm, depth_mm, sd_mm)
        further = self.insertion.length_mm + zero.feed_mm - float(self.insertion.q[self._feed])
        end = self._manipulator.fed(self.insertion.q, further)
        beyond = float(self._manipulator.beyond_limits(end)[self._feed])
        if beyond > 0:
            raise RobotRefusedError(f"the feed would end {beyond:.1f} mm before the end point; plan a shorter wire")
        self.zero = zero

    def step(self, reading: Reading, now_s: float) -> Step:
        """Return one cycle's command: PAUSE before the end point, ARRIVED at it; HALT or FAULT with the reason."""
        stopped = self._watch(reading)
        if stopped is not None:
            return stopped
        step = self._course.step(reading, now_s)
        self.position = self._course.position
        if step.trigger is Trigger.ARRIVED and not self._paused:
            self._paused = True
            return Step(step.velocity, trigger=Trigger.PAUSE)
        return Step(step.velocity, drill_on=step.trigger is None, trigger=step.trigger, text=step.text)

    def _at(self, depth_mm: float) -> np.ndarray:
        """Return the joints (n,) with the tip at a depth."""
        q = self.insertion.q.copy()
        q[self._feed] = self.zero.feed_mm + depth_mm
        return q

    def _begin(self) -> None:
        goal = self._end_mm if self._paused else self._pause_mm
        legs = [Leg(self._at(goal), limit_feed(self._manipulator, DRILL_MM_S))]
        near = -self._before_mm - NEAR_MM
        if self.zero.depth_mm(self.position[self._feed]) < near and not self._touched:
            legs.insert(0, Leg(self._at(near), limit_feed(self._manipulator, APPROACH_MM_S)))
        self._course = Course(self._manipulator, self.position, legs)

    def _watch(self, reading: Reading) -> Step | None:
        """Return the step that ends drilling if supervision finds a reason, else None."""
        if reading.time_s == self._sampled_s:
            return None
        self._sampled_s = reading.time_s
        feed = float(reading.encoders[self._feed])
        depth = self.zero.depth_mm(feed)
        try:
            noted = self._supervision.step(reading.time_s, depth, reading.force_n)
        except UnusableInputError as error:
            return _stop(Trigger.FAULT, str(error))
        if self._open_mm is not None and not self.noted:
            noted = (SupervisionEvent(EventKind.OPEN_HOLE, reading.time_s, self._open_mm, 0.0), *noted)
        self.noted += noted
        for event in noted:
            stopped = self._on_contact(feed, depth) if event.event is EventKind.CONTACT else self._on_event(event)
            if stopped is not None:
                return stopped
        if self._seeks_bone and depth > self._contact_mm[1]:
            what = "no cortex" if self._touched else "no bone"
            return _stop(Trigger.HALT, f"{what} was met up to {_place(depth)}: {_NOT_MET}")
        if self._open_mm is not None and depth > self._open_mm + MAX_ZERO_SHIFT_MM and self._ended_in_cortex:
            self._ended_in_cortex = False
            if not self._touched:
                return _stop(
                    Trigger.HALT,
                    f"no bone was met up to {_place(depth)}, and the hole ended in a cortex at {self._open_mm:.1f} mm: "
                    "the wire has moved in its chuck, or bone or robot has moved since; take a shot",
                )
        if self._touched or self._bottom_feed_mm is not None:
            self._bottom_feed_mm = max(feed, self._bottom_feed_mm or feed)
        return None

    def _on_contact(self, feed_mm: float, depth_mm: float) -> Step | None:
        """Contact: continue with drilling feed; if bone was expected at the entry, correct the zero of depth."""
        self._touched = True
        earliest, latest = self._contact_mm
        if self._open_mm is not None and depth_mm < self._open_mm - NEAR_MM:
            return _stop(
                Trigger.HALT,
                f"the wire met something {_place(depth_mm)}, in the hole that it drilled to {self._open_mm:.1f} mm: "
                "bone or robot has moved since; take a shot, and plan again on new images",
            )
        if self._seeks_bone and not earliest <= depth_mm <= latest:
            return _stop(Trigger.HALT, f"the wire met something {_place(depth_mm)}: {_ASTRAY}")
        if self._seeks_bone and self._before_mm == 0:
            self._seeks_bone = False
            try:
                self.correct_depth(feed_mm, -CONTACT_LEAD_MM, CONTACT_SD_MM)
            except RobotRefusedError as error:
                return _stop(Trigger.HALT, str(error))
        self._begin()
        return None

    def _on_event(self, noted: SupervisionEvent) -> Step | None:
        text = _SAID.get(noted.event)
        if text is not None:
            return _stop(Trigger.FAULT, text.format(force=noted.force_n, depth=noted.depth_mm))
        if noted.event is EventKind.CORTEX:
            self._seeks_bone = False
        length, beyond = self.insertion.length_mm, self.insertion.limits.beyond_mm
        if noted.event is EventKind.BREAK_THROUGH and noted.depth_mm > FAR_SHARE * length:
            if beyond > 0 and noted.depth_mm >= length - beyond:  # the far cortex, which is what the drill is to reach
                self._end_mm = min(noted.depth_mm + POINT_MM, length)
                self._begin()
                return None
            where = f"at {noted.depth_mm:.1f} mm, on the far side"
            return _stop(Trigger.HALT, f"the wire broke through a cortex {where}: take a check shot")
        return None


_ASTRAY = "the plan is not where this patient's bone is, or something is in the way; take a shot, and plan again"
_NOT_MET = (
    "the plan is not where this patient's bone is, or the wire went into a hole that this robot does not know, of "
    "another plan or from before it was started. Take a shot, and plan again, or finish that hole by hand"
)


def _place(depth_mm: float) -> str:
    return f"{abs(depth_mm):.1f} mm {'before' if depth_mm < 0 else 'beyond'} the planned entry point"


_SAID = {
    EventKind.FORCE_LIMIT: "the thrust of {force:.0f} N at {depth:.1f} mm is above its limit",
    EventKind.DEPTH_LIMIT: "the wire reached its depth limit at {depth:.1f} mm",
}


def _stop(trigger: Trigger, text: str) -> Step:
    return Step(np.zeros(0), trigger=trigger, text=text)  # a step that ends an activity commands nothing
