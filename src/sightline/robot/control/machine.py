"""What the robot does by itself: read the plant, watch, move, stop. It knows states and activities, no requests."""

from collections.abc import Sequence

import numpy as np

from sightline.robot.contract import Code
from sightline.robot.control.insertion import Insertion, LinkRegistration, Setup
from sightline.robot.control.lease import Lease
from sightline.robot.control.motion.course import Activity, align, retract
from sightline.robot.control.motion.depth import DepthZero
from sightline.robot.control.motion.drilling import Drilling
from sightline.robot.control.outcomes import Outcomes
from sightline.robot.control.own_time import OwnTime
from sightline.robot.control.panel import Panel
from sightline.robot.control.requests import Answer, Fault, Outcome, RequestRefusedError, Snapshot
from sightline.robot.control.samples import STALE_S, Samples
from sightline.robot.control.states import ACTIVITIES, MOVING, TRANSITIONS, Cause, State
from sightline.robot.kinematics.calibrated import CalibratedRobot
from sightline.robot.kinematics.manipulator import FEED, JOINTS
from sightline.robot.plant import Plant, PlantFlag

STOP_S = 1.0  # ten times what a stop takes at most


class Machine:
    """A calibrated robot, its plant, and what it was told to drill. `first_fault`: the number of its first fault.

    `state` changes by the table alone. `registration` and `insertion` are what a client sent, `drilling` the hole that
    was begun; each None where there is none. The silence of the client that holds the `lease` ends motion; `outcomes`
    are what clients have yet to be told.
    """

    def __init__(self, robot: CalibratedRobot, plant: Plant, setup: Setup, panel: Panel, first_fault: int) -> None:
        self.robot, self.setup, self.panel = robot, setup, panel
        self.state = State.UNDEFINED
        self.fault: Fault | None = None
        self.registration: LinkRegistration | None = None
        self.insertion: Insertion | None = None
        self.drilling: Drilling | None = None
        self.lease, self.outcomes = Lease(), Outcomes()
        self._own = OwnTime()
        self._unread_s = 0.0
        self._plant, self._samples = plant, Samples(plant)
        self._activity: Activity | None = None
        self._next_fault = first_fault
        self._begun_s = 0.0  # own time of an activity's first cycle: what was asked before it may have taken long
        self._acted_s: float | None = None  # when the activity that goes on had its last cycle
        self._commanded = np.zeros(len(JOINTS))
        self._rest = self.q  # where the joints stand while the robot waits
        self._moving_for: tuple[int, str] | None = None
        self._stopped_s = 0.0

    # What it does and knows.

    @property
    def q(self) -> np.ndarray:
        """(5,): the joints."""
        return self._samples.latest.encoders

    @property
    def own_s(self) -> float:
        """Its own time, s: see own_time.py."""
        return self._own.now_s

    @property
    def stop_pressed(self) -> bool:
        """Whether the stop button is."""
        return bool(self._samples.latest.flags & PlantFlag.STOP_PRESSED)

    @property
    def run_held(self) -> bool:
        """Whether the hold-to-run switch is."""
        return bool(self._samples.latest.flags & PlantFlag.RUN_HELD)

    @property
    def moves(self) -> bool:
        """Whether an activity goes on, or the joints have yet to be seen to stand after a stop."""
        return self._activity is not None or self.outcomes.stopping

    def snapshot(self) -> Snapshot:
        """What there is to know now, for telemetry."""
        zero = self._depth_zero
        return Snapshot(
            self.state,
            self._samples.latest,
            self._samples.velocity,
            self.q if self._activity is None else self._activity.position,
            self._commanded,
            None if zero is None else zero.depth_mm(float(self.q[FEED])),
            None if zero is None else zero.sd_mm,
            self.fault,
        )

    def turn(self, now_s: float, unread_s: float) -> None:
        """One cycle: read the plant, watch, command. `unread_s`: see `Controller.cycle`."""
        self._own.turn(now_s)
        self._unread_s = unread_s
        if self._acted_s is not None and now_s - self._acted_s > STALE_S:
            self._halt_by_itself(f"the control loop was {now_s - self._acted_s:.2f} s late", now_s)
        if self._acted_s is None:
            self._begun_s = self._own.now_s
        self._samples.take(self._own.now_s)
        self._watch(now_s)
        if self._activity is not None:
            self._act(now_s)
        if self._activity is None:
            self._commanded = np.zeros(len(JOINTS))
            self._plant.hold()
        self._report_stops(now_s)

    def begin(self, client: int, cause: Cause) -> Answer:
        """Go where a command leads from here; the caller has seen that it is legal. The answer to its client."""
        was = self.state
        self._enter(cause)
        manipulator, insertion, q = self.robot.manipulator, self.insertion, self.q
        if cause is Cause.START_UP:
            self.forget()
        elif cause is Cause.MANUAL:
            self.insertion = None
        elif self.state is State.RETRACT:
            self._activity = retract(manipulator, q)
        elif self.state is State.ALIGN and insertion is not None:
            self._activity = align(manipulator, insertion, q)
            self.drilling = Drilling(manipulator, insertion, self.setup.into_bone)
        elif self.state is State.DRILL and self.drilling is not None:
            self.drilling.resume()
            self._activity = self.drilling
        if self._activity is None:
            return Answer(Code.OK)
        self._moving_for = (client, cause.value)
        return Answer(Code.OK, f"from {was.value} to {self.state.value}", done=False)

    def stop(self, told: Sequence[Outcome], now_s: float) -> None:
        """Stop. `told`: the outcomes of the stop, once the joints stand."""
        self._halt(now_s)
        for outcome in told:
            self.outcomes.stop(outcome)
        self._end_motion(Code.NOT_READY, "stopped by a client's STOP")
        self._enter(Cause.STOP)

    def abandon(self, now_s: float) -> None:
        """Its client is gone: stop, tell nobody, and forget what it was told."""
        self._moving_for = None
        self._halt(now_s)
        self._enter(Cause.LOST)
        self.forget()

    def fail(self, code: Code, text: str, now_s: float) -> None:
        """Stop, and go to EMERGENCY with a new fault, unless it is there already; only a person goes on."""
        self._halt(now_s)
        if self.state is not State.EMERGENCY:
            self.fault = Fault(self._next_fault, code, text)
            self._next_fault += 1
        self._enter(Cause.FAULT)
        self.forget()
        self.outcomes.add(Outcome(None, State.EMERGENCY.value, Code.EMERGENCY, text))
        self._end_motion(code, text)

    def reset(self) -> None:
        """Leave EMERGENCY. Raises RequestRefusedError while the stop button is pressed."""
        if self.stop_pressed:
            raise RequestRefusedError(Code.NOT_READY, "the stop button is pressed; release it at the robot")
        self.fault = None
        self._enter(Cause.RESET)

    def forget(self) -> None:
        """Nothing that was sent counts any more."""
        self.registration = self.insertion = self.drilling = None

    # What ends its motion.

    def _watch(self, now_s: float) -> None:
        """What must end motion whatever the activity."""
        if self.state is State.EMERGENCY:
            if self.panel.take_reset():
                self._reset_at_panel()
            return
        self.panel.take_reset()  # pressed too early
        missing = self._samples.missing(self._own.now_s)
        if missing:
            self.fail(Code.HARDWARE, missing, now_s)
        elif self.stop_pressed and self.state is not State.UNDEFINED:
            self.fail(Code.EMERGENCY, "the stop button was pressed", now_s)
        elif self.state in ACTIVITIES:
            wrong = self._samples.wrong(self.robot.manipulator, self.state, self._rest)
            reason = self._reason_to_halt(now_s) if self.state in MOVING else None
            if wrong:
                self.fail(Code.HARDWARE, wrong, now_s)
            elif reason:
                self._halt_by_itself(reason, now_s)

    def _reason_to_halt(self, now_s: float) -> str | None:
        if not self.run_held:
            return "the hold-to-run switch was released"
        if self.state is not State.RETRACT and self.insertion is not None and now_s > self.insertion.expires_s:
            return "the plan has expired"
        return self.lease.silence(self._begun_s, self._own.now_s, self._unread_s)

    def _act(self, now_s: float) -> None:
        if self._activity is None:
            return
        step = self._activity.step(self._samples.latest, now_s)
        if step.cause is None:
            self._acted_s = now_s
            self._commanded = step.velocity
            self._plant.command(step.velocity, step.drill_on)
        elif step.cause is Cause.FAULT:
            self.fail(Code.HARDWARE, step.text, now_s)
        elif step.cause is Cause.HALT:
            self._halt_by_itself(step.text, now_s)
        else:
            retracted, self._rest = self.state is State.RETRACT, self._activity.position
            self._halt(now_s)
            self._enter(step.cause)
            if retracted:
                self.insertion = None  # what was drilled, or given up, is not drilled again
            self._end_motion(Code.OK, self.state.value)

    def _halt_by_itself(self, reason: str, now_s: float) -> None:
        self._halt(now_s)
        self._enter(Cause.HALT)
        self._end_motion(Code.NOT_READY, reason)

    def _reset_at_panel(self) -> None:
        try:
            self.reset()
        except RequestRefusedError as refused:
            self.outcomes.add(Outcome(None, State.EMERGENCY.value, refused.answer.code, refused.answer.text))

    def _report_stops(self, now_s: float) -> None:
        """A stop is reported as done when the joints stand, and not before."""
        if self.outcomes.stopping and not self._samples.still(self.robot.manipulator):
            if now_s - self._stopped_s <= STOP_S:
                return
            self.outcomes.still_move("the joints still move")
            self.fail(Code.HARDWARE, f"the joints still move {STOP_S:g} s after a stop", now_s)
        self.outcomes.stand()

    # How.

    def _enter(self, cause: Cause) -> None:
        self.state = TRANSITIONS[self.state, cause]

    def _halt(self, now_s: float) -> None:
        """Stop the joints and the drill."""
        self._plant.hold()
        self._activity = self._acted_s = None
        self._commanded = np.zeros(len(JOINTS))
        self._stopped_s = now_s

    def _end_motion(self, code: Code, text: str) -> None:
        if self._moving_for is not None:
            self.outcomes.conclude(Outcome(*self._moving_for, code, text))
            self._moving_for = None

    @property
    def _depth_zero(self) -> DepthZero | None:
        """Of the hole that was begun, else of the plan."""
        if self.insertion is None:
            return None
        return DepthZero(float(self.insertion.q[FEED])) if self.drilling is None else self.drilling.zero
