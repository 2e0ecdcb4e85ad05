"""The robot's controller: what clients ask, what the plant says, what is commanded. No input or output, no clock.

One thread calls it: `submit` for each request, `cycle` every `CYCLE_S`.
"""

from functools import partial

import numpy as np

from sightline.errors import RobotRefusedError
from sightline.robot.activities import STANDING_LIMIT, Activity, Drilling, align, retract
from sightline.robot.calibrated import CalibratedRobot
from sightline.robot.contract import SILENCE_S, Code
from sightline.robot.igtl import Message
from sightline.robot.insertion import Insertion, LinkRegistration, Setup, read_registration, read_target
from sightline.robot.look import LONGEST_S, Look, Surveyor, at_once
from sightline.robot.manipulator import FEED, JOINTS
from sightline.robot.panel import Panel
from sightline.robot.plant import Plant, PlantFlag
from sightline.robot.requests import (
    Aim,
    Answer,
    Command,
    Fault,
    Outcome,
    Register,
    Request,
    RequestRefusedError,
    Reset,
    ShotDepth,
    Snapshot,
)
from sightline.robot.samples import STALE_S, Samples
from sightline.robot.states import ACTIVITIES, COMMANDS, MOVING, TRANSITIONS, Cause, State

SHOT_LIMIT_MM = 3.0  # between shot and encoders: registration, bending and the shot together do not err so much [ours]
STOP_S = 1.0  # ten times what a stop takes at most
_MOTION = (Cause.MOVE_TO_TARGET, Cause.DRILL, Cause.GUIDE, Cause.RETRACT)


class Controller:
    """See the module. `first_fault`: the number of its first fault; one that differs with every start keeps a reset
    meant for an earlier fault from clearing a later one. `surveyor`: where it looks for collisions; a loop that must
    keep its time has that done beside it."""

    def __init__(
        self, robot: CalibratedRobot, plant: Plant, setup: Setup, panel: Panel | None = None, first_fault: int = 1
    ) -> None:
        self.robot, self.setup = robot, setup
        self.panel = panel or Panel()
        self.state = State.UNDEFINED
        self.fault: Fault | None = None
        self.lease: int | None = None
        self.registration: LinkRegistration | None = None
        self.insertion: Insertion | None = None
        self.drilling: Drilling | None = None
        self.surveyor: Surveyor = at_once
        self._plant, self._samples = plant, Samples(plant)
        self._activity: Activity | None = None
        self._next_fault = first_fault
        self._begun_s = 0.0  # an activity's first cycle: what was asked before it may have taken long
        self._acted_s: float | None = None  # when the activity that goes on had its last cycle
        self._commanded = np.zeros(len(JOINTS))
        self._rest = self._surveyed_from = self._q  # where the joints stand while the robot waits
        self._look: Look | None = None
        self._moving_for: tuple[int, str] | None = None
        self._stopping: list[tuple[int, str]] = []
        self._stopped_s = 0.0
        self._outcomes: list[Outcome] = []
        self._heartbeats: dict[int, float] = {}

    # What clients do.

    def submit(self, client: int, request: Request, now_s: float) -> Answer:
        """An answer to every request in every state."""
        try:
            match request:
                case Command(name, overtaken):
                    return self._command(client, name, overtaken, now_s)
                case Register(message):
                    return self._register(client, message)
                case Aim(message):
                    return self._aim(client, message, now_s)
                case Reset(fault):
                    return self._reset_from_afar(fault)
                case ShotDepth(depth_mm):
                    return self._shot_depth(client, depth_mm)
        except RequestRefusedError as refused:
            return refused.answer

    def heartbeat(self, client: int, now_s: float) -> None:
        """A sign of life, or the promise of more: from now on this client's silence is noticed."""
        self._heartbeats[client] = now_s

    def heard(self, client: int, now_s: float) -> None:
        """Any other message; it counts where the client has promised heartbeats."""
        if client in self._heartbeats:
            self._heartbeats[client] = now_s

    def lost(self, client: int, now_s: float) -> None:
        """The client is gone for good: if it held the lease, the robot stops and forgets what it was told."""
        self._heartbeats.pop(client, None)
        self._stopping = [due for due in self._stopping if due[0] != client]
        if client != self.lease:
            return
        self.lease = self._moving_for = self._look = None
        self._halt(now_s)
        self._enter(Cause.LOST)
        self._forget()

    # What happens by itself.

    def cycle(self, now_s: float) -> tuple[Outcome, ...]:
        """Read the plant, watch, decide, command. What has ended since the last cycle."""
        if self._acted_s is not None and now_s - self._acted_s > STALE_S:
            self._halt_by_itself(f"the control loop was {now_s - self._acted_s:.2f} s late", now_s)
        if self._acted_s is None:
            self._begun_s = now_s
        self._samples.take(now_s)
        self._watch(now_s)
        self._see_look(now_s)
        if self._activity is not None:
            self._act(now_s)
        if self._activity is None:
            self._commanded = np.zeros(len(JOINTS))
            self._plant.hold()
        self._report_stops(now_s)
        ended, self._outcomes = tuple(self._outcomes), []
        return ended

    def fail(self, text: str, now_s: float) -> None:
        """Something went wrong that no rule foresaw: stop, and wait for a person."""
        self._fail(Code.HARDWARE, text, now_s)

    @property
    def busy(self) -> bool:
        """Whether something moves, has yet to be seen to stand, or is looked at."""
        return self._activity is not None or bool(self._stopping) or self._look is not None

    @property
    def looking_for(self) -> int | None:
        """The client whose target is looked at; it waits for the answer."""
        return None if self._look is None else self._look.client

    def snapshot(self) -> Snapshot:
        """For telemetry."""
        return Snapshot(
            self.state,
            self._samples.latest,
            self._samples.velocity,
            self._q if self._activity is None else self._activity.position,
            self._commanded,
            None if self.insertion is None else float(self._q[FEED] - self.insertion.q[FEED]),
            self.fault,
            self.registration,
            self.insertion,
        )

    @property
    def _q(self) -> np.ndarray:
        """(5,): the joints."""
        return self._samples.latest.encoders

    # Requests.

    def _command(self, client: int, name: str, overtaken: bool, now_s: float) -> Answer:
        cause = next((cause for cause in COMMANDS if cause.value == name), None)
        if cause is None:
            known = ", ".join(command.value for command in COMMANDS)
            raise _no(Code.UNKNOWN, f"there is no command {name[:40]!r}; there are {known}")
        if cause is Cause.STOP:
            return self._stop(client, now_s)
        if cause is Cause.EMERGENCY:
            self._fail(Code.EMERGENCY, "a client sent EMERGENCY", now_s)
            return Answer(Code.OK, done=False)  # what all are told is its status, too
        self._hold_lease(client)
        if (self.state, cause) not in TRANSITIONS:
            raise self._illegal(cause)
        if overtaken and cause in _MOTION:
            raise _no(Code.NOT_READY, "a stop came after this command, which is void")
        self._guard(cause, now_s)
        if self.insertion is not None and self._must_look(cause):
            return self._begin_look(client, self.insertion, cause, now_s)
        return self._start(client, cause)

    def _start(self, client: int, cause: Cause) -> Answer:
        was = self.state
        self._enter(cause)
        manipulator, insertion, q = self.robot.manipulator, self.insertion, self._q
        if cause is Cause.START_UP:
            self._forget()
        elif cause is Cause.MANUAL:
            self.insertion = None
        elif self.state is State.RETRACT:
            self._activity = retract(manipulator, q)
        elif self.state is State.ALIGN and insertion is not None:
            self._activity, self.drilling = align(manipulator, insertion, q), Drilling(manipulator, insertion)
        elif self.state is State.DRILL and self.drilling is not None:
            self.drilling.resume()
            self._activity = self.drilling
        if self._activity is None:
            return Answer(Code.OK)
        self._moving_for = (client, cause.value)
        return Answer(Code.OK, f"from {was.value} to {self.state.value}", done=False)

    def _guard(self, cause: Cause, now_s: float) -> None:
        """What the table cannot know."""
        if cause is Cause.START_UP and self._stop_pressed:
            raise _no(Code.NOT_READY, "the stop button is pressed; release it at the robot")
        if cause is Cause.TARGETING and self.registration is None:
            raise _no(Code.NOT_READY, "there is no registration; send CALIBRATION and CLB_ first")
        if cause not in _MOTION:
            return
        if self._stop_pressed or not self._run_held:
            raise _no(Code.NOT_READY, "the hold-to-run switch is not held, or the stop button is pressed")
        if self._stopping:
            raise _no(Code.NOT_READY, "the robot is still stopping")
        if TRANSITIONS[self.state, cause] is State.RETRACT:
            return
        if self.insertion is None:
            raise _no(Code.NOT_READY, "there is no target; send TARGETING and TGT_ first")
        if not now_s <= self.insertion.expires_s:
            raise _no(Code.CONFIGURATION, "the plan has expired; take new images and plan again")

    def _must_look(self, cause: Cause) -> bool:
        """Whether the arm would turn from elsewhere than where its way was looked at from."""
        moved = np.abs(self._q - self._surveyed_from) > STANDING_LIMIT
        return cause in _MOTION and TRANSITIONS[self.state, cause] is State.ALIGN and bool(moved.any())

    # The look for collisions.

    def _begin_look(self, client: int, insertion: Insertion, cause: Cause | None, now_s: float) -> Answer:
        """From here on. The robot stands until it has ended, and what else its client sends must wait."""
        start = self._q
        work = partial(insertion.refuse_collision, self.robot.manipulator, start, self.setup)
        self._look = Look(client, cause, insertion, start, now_s, self.surveyor(work))
        return self._looked(now_s) or Answer(Code.OK, done=False)

    def _see_look(self, now_s: float) -> None:
        look, answer = self._look, self._looked(now_s)
        if look is not None and answer is not None and answer.done:
            self._outcomes.append(Outcome(look.client, look.name, answer.code, answer.text))

    def _looked(self, now_s: float) -> Answer | None:
        """How the look has ended, and the motion begun that waited for it; None while it goes on."""
        look = self._look
        if look is None or not look.result.done():
            return None
        self._look = None
        try:
            look.result.result()
            self.insertion, self._surveyed_from = look.insertion, look.start
            return Answer(Code.OK) if look.cause is None else self._go_after_look(look, look.cause, now_s)
        except RobotRefusedError as error:
            return Answer(Code.CONFIGURATION, str(error))
        except RequestRefusedError as refused:
            return refused.answer

    def _go_after_look(self, look: Look, cause: Cause, now_s: float) -> Answer:
        if now_s - look.begun_s > LONGEST_S or self._must_look(cause):
            text = f"looking for collisions took {now_s - look.begun_s:.1f} s, or the robot was moved meanwhile"
            raise _no(Code.NOT_READY, f"{text}; command it again")
        self._guard(cause, now_s)
        return self._start(look.client, cause)

    def _drop_look(self, code: Code, text: str) -> None:
        """Whatever it finds now is void."""
        if self._look is not None:
            self._look.result.cancel()
            self._outcomes.append(Outcome(self._look.client, self._look.name, code, text))
            self._look = None

    def _register(self, client: int, message: Message) -> Answer:
        self._hold_lease(client)
        if self.state is not State.CALIBRATION:
            raise _no(Code.NOT_READY, f"a registration is taken in CALIBRATION; the robot is in {self.state.value}")
        self.registration = self.insertion = None  # whatever comes, the old one is no longer meant
        try:
            self.registration = read_registration(message)
        except RobotRefusedError as error:
            raise _no(Code.CONFIGURATION, str(error)) from error
        return Answer(Code.OK)

    def _aim(self, client: int, message: Message, now_s: float) -> Answer:
        self._hold_lease(client)
        if self.registration is None:
            raise _no(Code.NOT_READY, "there is no registration; send CALIBRATION and CLB_ first")
        if self.state is not State.TARGETING:
            raise _no(Code.NOT_READY, f"a target is taken in TARGETING; the robot is in {self.state.value}")
        self.insertion = None  # whatever comes, the old one is no longer meant
        try:
            insertion = read_target(message, self.registration, self.robot, self.setup, now_s)
        except RobotRefusedError as error:
            raise _no(Code.CONFIGURATION, str(error)) from error
        return self._begin_look(client, insertion, None, now_s)

    def _shot_depth(self, client: int, depth_mm: float) -> Answer:
        self._hold_lease(client)
        if self.state is not State.PAUSED or self.insertion is None or self.drilling is None:
            raise _no(Code.NOT_READY, f"a shot's depth is taken in PAUSED; the robot is in {self.state.value}")
        own_mm = float(self._q[FEED] - self.insertion.q[FEED])
        if not abs(depth_mm - own_mm) <= SHOT_LIMIT_MM:
            text = f"the shot shows the tip at {depth_mm:.1f} mm, the encoders at {own_mm:.1f} mm: more than "
            raise _no(
                Code.CONFIGURATION, text + f"{SHOT_LIMIT_MM:g} mm apart, something has moved; retract and plan again"
            )
        self.insertion = self.insertion.shifted(own_mm - depth_mm)
        self.drilling.insertion = self.insertion
        return Answer(Code.OK)

    def _stop(self, client: int, now_s: float) -> Answer:
        self._halt(now_s)
        self._drop_look(Code.NOT_READY, "stopped by a client's STOP")
        self._end_motion(Code.NOT_READY, "stopped by a client's STOP")
        self._stopping.append((client, Cause.STOP.value))
        self._enter(Cause.STOP)
        if self.lease is not None and client != self.lease:
            self._outcomes.append(Outcome(self.lease, Cause.STOP.value, Code.OK, "stopped by another client"))
        return Answer(Code.OK, done=False)

    def _reset_from_afar(self, fault: int) -> Answer:
        if self.panel.key_switch:
            raise _no(Code.DENIED, "this robot is reset with the key at its panel")
        if self.fault is None:
            raise _no(Code.NOT_READY, "there is no fault to reset")
        if fault != self.fault.number:
            raise _no(Code.NOT_READY, f"the fault is number {self.fault.number}, not {fault}: read it first")
        self._reset()
        return Answer(Code.OK)

    def _hold_lease(self, client: int) -> None:
        """Take the lease if it is free. Whoever does not hold it may stop the robot and ask, nothing else."""
        if self.lease is None:
            self.lease = client
        if self.lease != client:
            raise _no(Code.DENIED, "another client holds the command lease; it ends with that client's connection")
        if self._look is not None:
            raise _no(Code.NOT_READY, "the way to the target is still looked at; wait for the answer")

    def _illegal(self, cause: Cause) -> RequestRefusedError:
        if self.state is State.MANUAL:
            return _no(Code.MANUAL, "the robot is in MANUAL; send PLANNING or START_UP first")
        if self.state is State.EMERGENCY:
            number = "" if self.fault is None else f" {self.fault.number}: {self.fault.text}"
            return _no(Code.EMERGENCY, f"fault{number}; a person must reset the robot")
        legal = ", ".join(command.value for command in COMMANDS if (self.state, command) in TRANSITIONS)
        return _no(Code.NOT_READY, f"not {cause.value} in {self.state.value}; possible are {legal}")

    # A cycle's parts.

    def _watch(self, now_s: float) -> None:
        """What must end motion whatever the activity."""
        if self.state is State.EMERGENCY:
            if self.panel.take_reset():
                self._reset_at_panel()
            return
        self.panel.take_reset()  # pressed too early
        missing = self._samples.missing(now_s)
        if missing:
            self._fail(Code.HARDWARE, missing, now_s)
        elif self._stop_pressed and self.state is not State.UNDEFINED:
            self._fail(Code.EMERGENCY, "the stop button was pressed", now_s)
        elif self.state in ACTIVITIES:
            wrong = self._samples.wrong(self.robot.manipulator, self.state, self._rest)
            reason = self._reason_to_halt(now_s) if self.state in MOVING else None
            if wrong:
                self._fail(Code.HARDWARE, wrong, now_s)
            elif reason:
                self._halt_by_itself(reason, now_s)

    @property
    def _stop_pressed(self) -> bool:
        return bool(self._samples.latest.flags & PlantFlag.STOP_PRESSED)

    @property
    def _run_held(self) -> bool:
        return bool(self._samples.latest.flags & PlantFlag.RUN_HELD)

    def _reason_to_halt(self, now_s: float) -> str | None:
        if not self._run_held:
            return "the hold-to-run switch was released"
        heard_s = self._heartbeats.get(-1 if self.lease is None else self.lease)
        if heard_s is not None and now_s - max(heard_s, self._begun_s) > SILENCE_S:
            return f"the client was silent for {SILENCE_S:g} s"
        if self.state is not State.RETRACT and self.insertion is not None and now_s > self.insertion.expires_s:
            return "the plan has expired"
        return None

    def _act(self, now_s: float) -> None:
        if self._activity is None:
            return
        step = self._activity.step(self._samples.latest, now_s)
        if step.cause is None:
            self._acted_s = now_s
            self._commanded = step.velocity
            self._plant.command(step.velocity, step.drill_on)
        elif step.cause is Cause.FAULT:
            self._fail(Code.HARDWARE, step.text, now_s)
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

    def _fail(self, code: Code, text: str, now_s: float) -> None:
        """Stop; only a person goes on."""
        self._halt(now_s)
        if self.state is not State.EMERGENCY:
            self.fault = Fault(self._next_fault, code, text)
            self._next_fault += 1
        self._enter(Cause.FAULT)
        self._forget()
        self._drop_look(code, text)
        self._end_motion(code, text)
        self._outcomes.append(Outcome(None, State.EMERGENCY.value, Code.EMERGENCY, text))

    def _reset_at_panel(self) -> None:
        try:
            self._reset()
        except RequestRefusedError as refused:
            self._outcomes.append(Outcome(None, State.EMERGENCY.value, refused.answer.code, refused.answer.text))

    def _reset(self) -> None:
        if self._stop_pressed:
            raise _no(Code.NOT_READY, "the stop button is pressed; release it at the robot")
        self.fault = None
        self._enter(Cause.RESET)

    def _enter(self, cause: Cause) -> None:
        self.state = TRANSITIONS[self.state, cause]

    def _halt(self, now_s: float) -> None:
        """Stop the joints and the drill."""
        self._plant.hold()
        self._activity = self._acted_s = None
        self._commanded = np.zeros(len(JOINTS))
        self._stopped_s = now_s

    def _forget(self) -> None:
        self.registration = self.insertion = self.drilling = None

    def _end_motion(self, code: Code, text: str) -> None:
        if self._moving_for is not None:
            self._outcomes.append(Outcome(*self._moving_for, code, text))
            self._moving_for = None

    def _report_stops(self, now_s: float) -> None:
        """A stop is reported as done when the joints stand, and not before."""
        if not self._stopping:
            return
        if self._samples.still(self.robot.manipulator):
            self._outcomes += [Outcome(*due, Code.OK, "stands still") for due in self._stopping]
            self._stopping = []
        elif now_s - self._stopped_s > STOP_S:
            due, self._stopping = self._stopping, []
            self._outcomes += [Outcome(*one, Code.HARDWARE, "the joints still move") for one in due]
            self._fail(Code.HARDWARE, f"the joints still move {STOP_S:g} s after a stop", now_s)


def _no(code: Code, text: str) -> RequestRefusedError:
    return RequestRefusedError(code, text)
