"""The robot's controller: what clients ask, what the plant says, what is commanded. No input or output, no clock.

One thread calls it: `submit` for each request, `cycle` every `CYCLE_S`.
"""

from collections import deque
from dataclasses import dataclass

import numpy as np

from sightline.errors import RobotRefusedError
from sightline.robot.activities import MOVING_LIMIT, STANDING_LIMIT, Activity, Drilling, align, retract
from sightline.robot.calibrated import CalibratedRobot
from sightline.robot.contract import SILENCE_S, Code
from sightline.robot.igtl import Message
from sightline.robot.insertion import Insertion, LinkRegistration, Setup, read_registration, read_target
from sightline.robot.manipulator import FEED, JOINTS, said_beyond
from sightline.robot.panel import Panel
from sightline.robot.plant import Plant, PlantFlag, Reading
from sightline.robot.states import ACTIVITIES, COMMANDS, MOVING, TRANSITIONS, WAITING, Cause, State

STALE_S = 0.05  # ten cycles without a sample: the plant is gone [ours]
WINDOW = 6  # samples in which a joint that stands changes by a count at most: speed below 1 % of full speed
STILL_COUNTS = 1.5
SHOT_LIMIT_MM = 3.0  # between shot and encoders: registration, bending and the shot together do not err so much [ours]
STOP_S = 1.0  # ten times what a stop takes at most
_MOTION = (Cause.MOVE_TO_TARGET, Cause.DRILL, Cause.GUIDE, Cause.RETRACT)


@dataclass(frozen=True)
class Command:
    """A command by its name, known or not."""

    name: str


@dataclass(frozen=True)
class Register:
    """A registration, as it came."""

    message: Message


@dataclass(frozen=True)
class Aim:
    """A target, as it came."""

    message: Message


@dataclass(frozen=True)
class Reset:
    """A person's reset from afar, after they read this fault."""

    fault: int


@dataclass(frozen=True)
class ShotDepth:
    """How far beyond the entry point the second shot shows the tip, mm: the zero of depth set anew."""

    depth_mm: float


Request = Command | Register | Aim | Reset | ShotDepth


@dataclass(frozen=True)
class Answer:
    """To a request, at once. Where it is not yet `done`, an Outcome follows."""

    code: Code
    text: str = ""
    done: bool = True


@dataclass(frozen=True)
class Outcome:
    """How a command ended, for the client that sent it; None: something all must know."""

    client: int | None
    name: str
    code: Code
    text: str


@dataclass(frozen=True)
class Fault:
    """Why the robot is in EMERGENCY."""

    number: int
    code: Code
    text: str


@dataclass(frozen=True, eq=False)
class Snapshot:
    """What there is to know now. `depth_mm` beyond the entry point, None without a target; `wanted` (5,): where the
    joints should be."""

    state: State
    reading: Reading
    velocity: np.ndarray
    wanted: np.ndarray
    commanded: np.ndarray
    depth_mm: float | None
    fault: Fault | None
    registration: LinkRegistration | None
    insertion: Insertion | None


class _No(Exception):  # noqa: N818 - an answer, not an error
    def __init__(self, code: Code, text: str) -> None:
        super().__init__(text)
        self.code, self.text = code, text


class Controller:
    """See the module. `first_fault`: the number of its first fault; one that differs with every start keeps a reset
    meant for an earlier fault from clearing a later one."""

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
        self._plant = plant
        self._activity: Activity | None = None
        self._next_fault = first_fault
        self._reading = plant.read()
        self._begun_s = 0.0  # an activity's first cycle: what was asked before it may have taken long
        self._acted_s: float | None = None  # when the activity that goes on had its last cycle
        self._sound = True  # the last sample was one of numbers
        self._sampled_s: float | None = None  # by the controller's clock
        self._past: deque[Reading] = deque([self._reading], maxlen=WINDOW)
        self._commanded = np.zeros(len(JOINTS))
        self._rest = self._reading.encoders  # where the joints stand while the robot waits
        self._surveyed_from = self._reading.encoders
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
                case Command(name):
                    return self._command(client, name, now_s)
                case Register(message):
                    return self._register(client, message)
                case Aim(message):
                    return self._aim(client, message, now_s)
                case Reset(fault):
                    return self._reset_from_afar(fault)
                case ShotDepth(depth_mm):
                    return self._shot_depth(client, depth_mm)
        except _No as no:
            return Answer(no.code, no.text)

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
        self.lease = None
        self._moving_for = None
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
        self._read(now_s)
        self._watch(now_s)
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
        """Whether something moves, or has yet to be seen to stand."""
        return self._activity is not None or bool(self._stopping)

    def snapshot(self) -> Snapshot:
        """For telemetry."""
        q = self._reading.encoders
        return Snapshot(
            self.state,
            self._reading,
            self._velocity(),
            q if self._activity is None else self._activity.position,
            self._commanded,
            None if self.insertion is None else float(q[FEED] - self.insertion.q[FEED]),
            self.fault,
            self.registration,
            self.insertion,
        )

    # Requests.

    def _command(self, client: int, name: str, now_s: float) -> Answer:
        cause = next((cause for cause in COMMANDS if cause.value == name), None)
        if cause is None:
            known = ", ".join(command.value for command in COMMANDS)
            raise _No(Code.UNKNOWN, f"there is no command {name[:40]!r}; there are {known}")
        if cause is Cause.STOP:
            return self._stop(client, now_s)
        if cause is Cause.EMERGENCY:
            self._fail(Code.EMERGENCY, "a client sent EMERGENCY", now_s)
            return Answer(Code.OK, done=False)  # what all are told is its status, too
        self._hold_lease(client)
        if (self.state, cause) not in TRANSITIONS:
            raise self._illegal(cause)
        self._guard(cause, now_s)
        return self._start(client, cause)

    def _start(self, client: int, cause: Cause) -> Answer:
        was = self.state
        self._enter(cause)
        manipulator, insertion, q = self.robot.manipulator, self.insertion, self._reading.encoders
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
        if cause is Cause.START_UP and self._reading.flags & PlantFlag.STOP_PRESSED:
            raise _No(Code.NOT_READY, "the stop button is pressed; release it at the robot")
        if cause is Cause.TARGETING and self.registration is None:
            raise _No(Code.NOT_READY, "there is no registration; send CALIBRATION and CLB_ first")
        if cause not in _MOTION:
            return
        if self._reading.flags & PlantFlag.STOP_PRESSED or not self._reading.flags & PlantFlag.RUN_HELD:
            raise _No(Code.NOT_READY, "the hold-to-run switch is not held, or the stop button is pressed")
        if self._stopping:
            raise _No(Code.NOT_READY, "the robot is still stopping")
        if TRANSITIONS[self.state, cause] is State.RETRACT:
            return
        if self.insertion is None:
            raise _No(Code.NOT_READY, "there is no target; send TARGETING and TGT_ first")
        if not now_s <= self.insertion.expires_s:
            raise _No(Code.CONFIGURATION, "the plan has expired; take new images and plan again")
        moved = np.abs(self._reading.encoders - self._surveyed_from)
        if TRANSITIONS[self.state, cause] is State.ALIGN and (moved > STANDING_LIMIT).any():
            try:
                self._survey(self.insertion)
            except RobotRefusedError as error:
                raise _No(Code.CONFIGURATION, str(error)) from error

    def _survey(self, insertion: Insertion) -> None:
        """Look for collisions from here on. It takes a quarter of a second, in which the robot stands."""
        self._surveyed_from = self._reading.encoders
        insertion.refuse_collision(self.robot.manipulator, self._surveyed_from, self.setup)

    def _register(self, client: int, message: Message) -> Answer:
        self._hold_lease(client)
        if self.state is not State.CALIBRATION:
            raise _No(Code.NOT_READY, f"a registration is taken in CALIBRATION; the robot is in {self.state.value}")
        self.registration = self.insertion = None  # whatever comes, the old one is no longer meant
        try:
            self.registration = read_registration(message)
        except RobotRefusedError as error:
            raise _No(Code.CONFIGURATION, str(error)) from error
        return Answer(Code.OK)

    def _aim(self, client: int, message: Message, now_s: float) -> Answer:
        self._hold_lease(client)
        if self.registration is None:
            raise _No(Code.NOT_READY, "there is no registration; send CALIBRATION and CLB_ first")
        if self.state is not State.TARGETING:
            raise _No(Code.NOT_READY, f"a target is taken in TARGETING; the robot is in {self.state.value}")
        self.insertion = None  # whatever comes, the old one is no longer meant
        try:
            insertion = read_target(message, self.registration, self.robot, self.setup, now_s)
            self._survey(insertion)
            self.insertion = insertion
        except RobotRefusedError as error:
            raise _No(Code.CONFIGURATION, str(error)) from error
        return Answer(Code.OK)

    def _shot_depth(self, client: int, depth_mm: float) -> Answer:
        self._hold_lease(client)
        if self.state is not State.PAUSED or self.insertion is None or self.drilling is None:
            raise _No(Code.NOT_READY, f"a shot's depth is taken in PAUSED; the robot is in {self.state.value}")
        own_mm = float(self._reading.encoders[FEED] - self.insertion.q[FEED])
        if not abs(depth_mm - own_mm) <= SHOT_LIMIT_MM:
            text = f"the shot shows the tip at {depth_mm:.1f} mm, the encoders at {own_mm:.1f} mm: more than "
            raise _No(
                Code.CONFIGURATION, text + f"{SHOT_LIMIT_MM:g} mm apart, something has moved; retract and plan again"
            )
        self.insertion = self.insertion.shifted(own_mm - depth_mm)
        self.drilling.insertion = self.insertion
        return Answer(Code.OK)

    def _stop(self, client: int, now_s: float) -> Answer:
        self._halt(now_s)
        self._end_motion(Code.NOT_READY, "stopped by a client's STOP")
        self._stopping.append((client, Cause.STOP.value))
        self._enter(Cause.STOP)
        if self.lease is not None and client != self.lease:
            self._outcomes.append(Outcome(self.lease, Cause.STOP.value, Code.OK, "stopped by another client"))
        return Answer(Code.OK, done=False)

    def _reset_from_afar(self, fault: int) -> Answer:
        if self.panel.key_switch:
            raise _No(Code.DENIED, "this robot is reset with the key at its panel")
        if self.fault is None:
            raise _No(Code.NOT_READY, "there is no fault to reset")
        if fault != self.fault.number:
            raise _No(Code.NOT_READY, f"the fault is number {self.fault.number}, not {fault}: read it first")
        self._reset()
        return Answer(Code.OK)

    def _hold_lease(self, client: int) -> None:
        """Take the lease if it is free. Whoever does not hold it may stop the robot and ask, nothing else."""
        if self.lease is None:
            self.lease = client
        if self.lease != client:
            raise _No(Code.DENIED, "another client holds the command lease; it ends with that client's connection")

    def _illegal(self, cause: Cause) -> _No:
        if self.state is State.MANUAL:
            return _No(Code.MANUAL, "the robot is in MANUAL; send PLANNING or START_UP first")
        if self.state is State.EMERGENCY:
            number = "" if self.fault is None else f" {self.fault.number}: {self.fault.text}"
            return _No(Code.EMERGENCY, f"fault{number}; a person must reset the robot")
        legal = ", ".join(command.value for command in COMMANDS if (self.state, command) in TRANSITIONS)
        return _No(Code.NOT_READY, f"not {cause.value} in {self.state.value}; possible are {legal}")

    # A cycle's parts.

    def _read(self, now_s: float) -> None:
        reading = self._plant.read()
        self._sound = bool(np.isfinite(reading.encoders).all() and np.isfinite(reading.force_n))
        if not self._sound:
            return  # what was last known stays known
        if self._sampled_s is None or reading.time_s > self._reading.time_s:
            self._sampled_s = now_s
            self._past.append(reading)
        self._reading = reading

    def _watch(self, now_s: float) -> None:
        """What must end motion whatever the activity."""
        if self.state is State.EMERGENCY:
            if self.panel.take_reset():
                self._reset_at_panel()
            return
        self.panel.take_reset()  # pressed too early
        reading, sampled_s = self._reading, self._sampled_s
        if not self._sound:
            self._fail(Code.HARDWARE, "an encoder or the force sensor gives no number", now_s)
        elif sampled_s is None or now_s - sampled_s > STALE_S:
            self._fail(Code.HARDWARE, f"no sample from the drives for {STALE_S:g} s", now_s)
        elif reading.flags & PlantFlag.STOP_PRESSED and self.state is not State.UNDEFINED:
            self._fail(Code.EMERGENCY, "the stop button was pressed", now_s)
        elif self.state in ACTIVITIES:
            self._watch_activity(now_s)

    def _watch_activity(self, now_s: float) -> None:
        reading = self._reading
        beyond = self.robot.manipulator.beyond_limits(reading.encoders)
        outside = np.abs(beyond) > MOVING_LIMIT
        if outside.any():
            joint = int(np.argmax(outside))
            said = said_beyond(joint, float(reading.encoders[joint]), float(beyond[joint]))
            self._fail(Code.HARDWARE, f"outside the workspace: {said}", now_s)
        elif reading.flags & PlantFlag.OVERLOAD and self.state in MOVING:
            self._fail(Code.HARDWARE, "a drive is at the limit of its force: something blocks the robot", now_s)
        elif self.state in WAITING:
            off = np.abs(reading.encoders - self._rest) > STANDING_LIMIT
            if off.any():
                joint = JOINTS[int(np.argmax(off))]
                self._fail(Code.HARDWARE, f"{joint} was moved while it should stand", now_s)
        else:
            reason = self._reason_to_halt(now_s)
            if reason:
                self._halt_by_itself(reason, now_s)

    def _reason_to_halt(self, now_s: float) -> str | None:
        if not self._reading.flags & PlantFlag.RUN_HELD:
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
        step = self._activity.step(self._reading, now_s)
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
        self._end_motion(code, text)
        self._outcomes.append(Outcome(None, State.EMERGENCY.value, Code.EMERGENCY, text))

    def _reset_at_panel(self) -> None:
        try:
            self._reset()
        except _No as no:
            self._outcomes.append(Outcome(None, State.EMERGENCY.value, no.code, no.text))

    def _reset(self) -> None:
        if self._reading.flags & PlantFlag.STOP_PRESSED:
            raise _No(Code.NOT_READY, "the stop button is pressed; release it at the robot")
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
        moved = np.ptp([reading.encoders for reading in self._past], axis=0)
        if len(self._past) == WINDOW and (moved < STILL_COUNTS * self.robot.manipulator.resolution).all():
            self._outcomes += [Outcome(*due, Code.OK, "stands still") for due in self._stopping]
            self._stopping = []
        elif now_s - self._stopped_s > STOP_S:
            due, self._stopping = self._stopping, []
            self._outcomes += [Outcome(*one, Code.HARDWARE, "the joints still move") for one in due]
            self._fail(Code.HARDWARE, f"the joints still move {STOP_S:g} s after a stop", now_s)

    def _velocity(self) -> np.ndarray:
        first, last = self._past[0], self._past[-1]
        elapsed = last.time_s - first.time_s
        return (last.encoders - first.encoders) / elapsed if elapsed > 0 else np.zeros(len(JOINTS))
