"""One hole: approach, contact, the pause for the second shot, the tip. Watched by supervision at every sample."""

import numpy as np

from sightline.errors import RobotRefusedError, UnusableInputError
from sightline.robot.control.insertion import STANDOFF_MM, Insertion
from sightline.robot.control.motion.course import Course, Leg, Step, feeding
from sightline.robot.control.motion.depth import CONTACT_LEAD_MM, CONTACT_SD_MM, LIMIT_MM, DepthZero, before_contact
from sightline.robot.control.motion.supervision import Event, Noted, Supervision
from sightline.robot.control.states import Cause
from sightline.robot.kinematics.manipulator import FEED, JOINTS, Manipulator
from sightline.robot.plant import Reading

APPROACH_MM_S, NEAR_MM = 5.0, 2.0  # towards the entry point, and from where on as in bone: its 95 % error, twice [ours]
DRILL_MM_S = 1.0  # 60 mm/min [physics.md, Drilling]
PAUSE_MM = 10.0  # short of the tip, for the second shot [physics.md, Drilling]
# A wire that leaves bone beyond this share of its path has gone through the far side, not the near one [ours].
FAR_SHARE = 0.5


class Drilling:
    """One hole, with its pause. `resume` starts it, and starts it again. `zero`: where depth is counted from now.
    `into_bone`: bone must be met where it is planned, and its contact sets the zero of depth."""

    def __init__(self, manipulator: Manipulator, insertion: Insertion, into_bone: bool) -> None:
        self.noted: list[Noted] = []
        self.zero = DepthZero(float(insertion.q[FEED]))
        self._manipulator, self._insertion = manipulator, insertion
        self.position = self._at(-STANDOFF_MM)
        self._supervision: Supervision
        self._sampled_s = -np.inf
        self._pause_mm = max(insertion.length_mm - PAUSE_MM, 0.0)
        self._paused = self._near = self._touched = False
        self._seeks_bone = into_bone

    def resume(self) -> None:
        """Go on, from where the wire is."""
        self._supervision = Supervision(
            self._insertion.length_mm, self._insertion.depth_limit_mm, touched=self._touched
        )
        self._begin()

    def told(self, feed_mm: float, depth_mm: float, sd_mm: float) -> None:
        """At this feed the tip was seen at this depth, give or take `sd_mm`: goals are where that puts them. Raises
        RobotRefusedError where it cannot be, or leaves too little feed."""
        zero = self.zero.told(feed_mm, depth_mm, sd_mm)
        end = self._insertion.at_depth(self._insertion.length_mm)
        end[FEED] += zero.feed_mm - self._insertion.q[FEED]
        beyond = float(self._manipulator.beyond_limits(end)[FEED])
        if beyond > 0:
            raise RobotRefusedError(f"the feed would end {beyond:.1f} mm before the end point; plan a shorter wire")
        self.zero = zero

    def step(self, reading: Reading, now_s: float) -> Step:
        """One cycle: PAUSE short of the tip, ARRIVED at it; HALT or FAULT with the reason."""
        stopped = self._watch(reading)
        if stopped is not None:
            return stopped
        step = self._course.step(reading, now_s)
        self.position = self._course.position
        if step.cause is Cause.ARRIVED and not self._paused:
            self._paused = True
            return Step(step.velocity, cause=Cause.PAUSE)
        return Step(step.velocity, drill_on=step.cause is None, cause=step.cause, text=step.text)

    def _at(self, depth_mm: float) -> np.ndarray:
        """(5,): the joints with the tip at a depth."""
        q = self._insertion.q.copy()
        q[FEED] = self.zero.feed_mm + depth_mm
        return q

    def _begin(self) -> None:
        goal = self._insertion.length_mm if self._paused else self._pause_mm
        speed = self._manipulator.speed
        legs = [Leg(self._at(goal), feeding(speed, DRILL_MM_S))]
        if self.zero.depth_mm(self.position[FEED]) < -NEAR_MM and not self._touched:
            legs.insert(0, Leg(self._at(-NEAR_MM), feeding(speed, APPROACH_MM_S)))
        self._course = Course(self._manipulator, self.position, legs)

    def _watch(self, reading: Reading) -> Step | None:
        """What the supervision says against going on."""
        if reading.time_s == self._sampled_s:
            return None
        self._sampled_s = reading.time_s
        feed = float(reading.encoders[FEED])
        depth = self.zero.depth_mm(feed)
        try:
            noted = self._supervision.step(reading.time_s, depth, reading.force_n)
        except UnusableInputError as error:
            return _stop(Cause.FAULT, str(error))
        self.noted += noted
        for event in noted:
            stopped = self._met(feed, depth) if event.event is Event.CONTACT else self._against(event)
            if stopped is not None:
                return stopped
        if self._seeks_bone and not before_contact(depth):
            return _stop(Cause.HALT, f"no bone was met up to {depth:.1f} mm beyond the planned entry point: {_ASTRAY}")
        return None

    def _met(self, feed_mm: float, depth_mm: float) -> Step | None:
        """Contact: slower from here on, and the zero of depth set anew where it is bone that was met."""
        self._touched = True
        if self._seeks_bone:
            self._seeks_bone = False
            if abs(depth_mm + CONTACT_LEAD_MM) > LIMIT_MM:
                where = f"{abs(depth_mm):.1f} mm {'before' if depth_mm < 0 else 'beyond'} the planned entry point"
                return _stop(Cause.HALT, f"the wire met something {where}: {_ASTRAY}")
            try:
                self.told(feed_mm, -CONTACT_LEAD_MM, CONTACT_SD_MM)
            except RobotRefusedError as error:
                return _stop(Cause.HALT, str(error))
        self._begin()
        return None

    def _against(self, noted: Noted) -> Step | None:
        said = _SAID.get(noted.event)
        if said is not None:
            return _stop(Cause.FAULT, said.format(force=noted.force_n, depth=noted.depth_mm))
        if noted.event is Event.BREAK_THROUGH and noted.depth_mm > FAR_SHARE * self._insertion.length_mm:
            where = f"at {noted.depth_mm:.1f} mm, on the far side"
            return _stop(Cause.HALT, f"the wire broke through a cortex {where}: take a check shot")
        return None


_ASTRAY = "the plan is not where this patient's bone is, or something is in the way; take a shot, and plan again"
_SAID = {
    Event.FORCE_LIMIT: "the thrust of {force:.0f} N at {depth:.1f} mm is above its limit",
    Event.DEPTH_LIMIT: "the wire reached its depth limit at {depth:.1f} mm",
}


def _stop(cause: Cause, text: str) -> Step:
    return Step(np.zeros(len(JOINTS)), cause=cause, text=text)
