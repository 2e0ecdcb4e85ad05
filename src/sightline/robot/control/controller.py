"""The robot's controller: the machine, and what clients ask of it. No input or output, no clock.

One thread calls it: `submit` for each request, `cycle` every `CYCLE_S`.
"""

from functools import partial

import numpy as np

from sightline.errors import RobotRefusedError
from sightline.robot import contract
from sightline.robot.contract import Code
from sightline.robot.control.insertion import Insertion, Setup, read_registration, read_target
from sightline.robot.control.lifetimes import Lifetimes
from sightline.robot.control.look import LONGEST_S, Look, Surveyor, at_once
from sightline.robot.control.machine import Machine
from sightline.robot.control.motion.course import STANDING_LIMIT
from sightline.robot.control.panel import Panel
from sightline.robot.control.requests import (
    Aim,
    Answer,
    Command,
    Outcome,
    Register,
    Request,
    RequestRefusedError,
    Reset,
    ShotDepth,
)
from sightline.robot.control.states import COMMANDS, TRANSITIONS, Cause, State
from sightline.robot.igtl import Message
from sightline.robot.kinematics.calibrated import CalibratedRobot
from sightline.robot.kinematics.manipulator import FEED
from sightline.robot.plant import Plant

_MOTION = (Cause.MOVE_TO_TARGET, Cause.DRILL, Cause.GUIDE, Cause.RETRACT)


class Controller:
    """See the module. `first_fault`: the number of its first fault; one that differs with every start keeps a reset
    meant for an earlier fault from clearing a later one. `machine`: what it commands, for others to read. `surveyor`:
    where it looks for collisions; a loop that must keep its time has that done beside it."""

    def __init__(
        self, robot: CalibratedRobot, plant: Plant, setup: Setup, panel: Panel | None = None, first_fault: int = 1
    ) -> None:
        self.machine = Machine(robot, plant, setup, panel or Panel(), first_fault)
        self.surveyor: Surveyor = at_once
        self._lifetimes = Lifetimes()
        self._surveyed_from = self.machine.q
        self._look: Look | None = None

    # What clients do.

    def submit(self, client: int, request: Request, now_s: float) -> Answer:
        """An answer to every request in every state."""
        try:
            match request:
                case Command():
                    return self._command(client, request, now_s)
                case Register(message):
                    return self._register(client, message, now_s)
                case Aim(message):
                    return self._aim(client, message, now_s)
                case Reset(fault):
                    return self._reset_from_afar(fault)
                case ShotDepth(depth_mm, sd_mm):
                    return self._shot_depth(client, depth_mm, sd_mm)
        except RequestRefusedError as refused:
            return refused.answer

    def heartbeat(self, client: int) -> None:
        """A sign of life, or the promise of more: from now on this client's silence is noticed."""
        self.machine.lease.heartbeat(client, self.machine.own_s)

    def heard(self, client: int) -> None:
        """Any other message; it counts where the client has promised heartbeats."""
        self.machine.lease.heard(client, self.machine.own_s)

    def lost(self, client: int, now_s: float) -> None:
        """The client is gone for good: if it held the lease, the robot stops and forgets what it was told."""
        self.machine.outcomes.drop_stops(client)
        if self.machine.lease.left(client):
            self._look = None
            self.machine.abandon(now_s)

    def cycle(self, now_s: float, unread_s: float = 0.0) -> tuple[Outcome, ...]:
        """Read the plant, watch, decide, command. What has ended since the last cycle. `unread_s`: of its own time for
        how long what clients sent may not have been read yet."""
        self.machine.turn(now_s, unread_s)
        self._see_look(now_s)
        return self.machine.outcomes.take()

    @property
    def lease(self) -> int | None:
        """The client that commands."""
        return self.machine.lease.holder

    @property
    def busy(self) -> bool:
        """Whether something moves, has yet to be seen to stand, or is looked at."""
        return self.machine.moves or self._look is not None

    @property
    def looking_for(self) -> int | None:
        """The client whose target is looked at; it waits for the answer."""
        return None if self._look is None else self._look.client

    # Requests.

    def _command(self, client: int, command: Command, now_s: float) -> Answer:
        name = command.name
        cause = next((cause for cause in COMMANDS if cause.value == name), None)
        if cause is None:
            known = ", ".join(command.value for command in COMMANDS)
            raise _no(Code.UNKNOWN, f"there is no command {name[:40]!r}; there are {known}")
        if cause is Cause.STOP:
            return self._stop(client, now_s)
        if cause is Cause.EMERGENCY:
            self.machine.fail(Code.EMERGENCY, "a client sent EMERGENCY", now_s)
            return Answer(Code.OK, done=False)  # what all are told is its status, too
        self._hold_lease(client)
        if (self.machine.state, cause) not in TRANSITIONS:
            raise self._illegal(cause)
        if command.by_name and cause is Cause.MOVE_TO_TARGET and TRANSITIONS[self.machine.state, cause] is State.DRILL:
            text = f"this client announced {contract.HAS_DRILLING}: it drills by {Cause.DRILL.value} alone"
            raise _no(Code.NOT_READY, text)
        if command.overtaken and cause in _MOTION:
            raise _no(Code.NOT_READY, "a stop came after this command, which is void")
        self._guard(cause, now_s)
        if self.machine.insertion is not None and self._must_look(cause):
            return self._begin_look(client, self.machine.insertion, cause, now_s)
        return self.machine.begin(client, cause)

    def _guard(self, cause: Cause, now_s: float) -> None:
        """What the table cannot know."""
        if cause is Cause.START_UP and self.machine.stop_pressed:
            raise _no(Code.NOT_READY, "the stop button is pressed; release it at the robot")
        if cause is Cause.TARGETING and self.machine.registration is None:
            raise _no(Code.NOT_READY, "there is no registration; send CALIBRATION and CLB_ first")
        if cause not in _MOTION:
            return
        if self.machine.stop_pressed or not self.machine.run_held:
            raise _no(Code.NOT_READY, "the hold-to-run switch is not held, or the stop button is pressed")
        if self.machine.outcomes.stopping:
            raise _no(Code.NOT_READY, "the robot is still stopping")
        if TRANSITIONS[self.machine.state, cause] is State.RETRACT:
            return
        if self.machine.insertion is None:
            raise _no(Code.NOT_READY, "there is no target; send TARGETING and TGT_ first")
        if not now_s <= self.machine.insertion.expires_s:
            raise _no(Code.CONFIGURATION, "the plan has expired; take new images and plan again")

    def _must_look(self, cause: Cause) -> bool:
        """Whether the arm would turn from elsewhere than where its way was looked at from."""
        moved = np.abs(self.machine.q - self._surveyed_from) > STANDING_LIMIT
        return cause in _MOTION and TRANSITIONS[self.machine.state, cause] is State.ALIGN and bool(moved.any())

    # The look for collisions.

    def _begin_look(self, client: int, insertion: Insertion, cause: Cause | None, now_s: float) -> Answer:
        """From here on. The robot stands until it has ended, and what else its client sends must wait."""
        start = self.machine.q
        work = partial(insertion.refuse_collision, self.machine.robot.manipulator, start, self.machine.setup)
        self._look = Look(client, cause, insertion, start, now_s, self.surveyor(work))
        return self._looked(now_s) or Answer(Code.OK, done=False)

    def _see_look(self, now_s: float) -> None:
        if self.machine.fault is not None:
            self._drop_look(self.machine.fault.code, self.machine.fault.text)
        look, answer = self._look, self._looked(now_s)
        if look is not None and answer is not None and answer.done:
            self.machine.outcomes.add(Outcome(look.client, look.name, answer.code, answer.text))

    def _looked(self, now_s: float) -> Answer | None:
        """How the look has ended, and the motion begun that waited for it; None while it goes on."""
        look = self._look
        if look is None or not look.result.done():
            return None
        self._look = None
        try:
            look.result.result()
            self.machine.insertion, self._surveyed_from = look.insertion, look.start
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
        return self.machine.begin(look.client, cause)

    def _drop_look(self, code: Code, text: str) -> None:
        """Whatever it finds now is void."""
        if self._look is not None:
            self._look.result.cancel()
            self.machine.outcomes.conclude(Outcome(self._look.client, self._look.name, code, text))
            self._look = None

    def _register(self, client: int, message: Message, now_s: float) -> Answer:
        self._hold_lease(client)
        if self.machine.state is not State.CALIBRATION:
            where = self.machine.state.value
            raise _no(Code.NOT_READY, f"a registration is taken in CALIBRATION; the robot is in {where}")
        self.machine.forget()  # whatever comes, the old one is no longer meant
        try:
            self.machine.registration = read_registration(message, self.machine.setup)
        except RobotRefusedError as error:
            raise _no(Code.CONFIGURATION, str(error)) from error
        self._lifetimes.registered(now_s)
        return Answer(Code.OK)

    def _aim(self, client: int, message: Message, now_s: float) -> Answer:
        self._hold_lease(client)
        if self.machine.registration is None:
            raise _no(Code.NOT_READY, "there is no registration; send CALIBRATION and CLB_ first")
        if self.machine.state is not State.TARGETING:
            raise _no(Code.NOT_READY, f"a target is taken in TARGETING; the robot is in {self.machine.state.value}")
        self.machine.insertion = self.machine.drilling = None  # whatever comes, the old one is no longer meant
        try:
            read = read_target(message, self.machine.registration, self.machine.robot, self.machine.setup, now_s)
            insertion = self._lifetimes.limit(read, now_s)
        except RobotRefusedError as error:
            raise _no(Code.CONFIGURATION, str(error)) from error
        return self._begin_look(client, insertion, None, now_s)

    def _shot_depth(self, client: int, depth_mm: float, sd_mm: float) -> Answer:
        self._hold_lease(client)
        if self.machine.state is not State.PAUSED or self.machine.drilling is None:
            raise _no(Code.NOT_READY, f"a shot's depth is taken in PAUSED; the robot is in {self.machine.state.value}")
        try:
            self.machine.drilling.told(float(self.machine.q[FEED]), depth_mm, sd_mm)
        except RobotRefusedError as error:
            raise _no(Code.CONFIGURATION, str(error)) from error
        return Answer(Code.OK)

    def _stop(self, client: int, now_s: float) -> Answer:
        told = [Outcome(client, Cause.STOP.value, Code.OK, "stands still")]
        if self.lease is not None and client != self.lease:
            told.append(Outcome(self.lease, Cause.STOP.value, Code.OK, "stopped by another client"))
        self.machine.stop(told, now_s)
        self._drop_look(Code.NOT_READY, "stopped by a client's STOP")
        return Answer(Code.OK, done=False)

    def _reset_from_afar(self, fault: int) -> Answer:
        if self.machine.panel.key_switch:
            raise _no(Code.DENIED, "this robot is reset with the key at its panel")
        if self.machine.fault is None:
            raise _no(Code.NOT_READY, "there is no fault to reset")
        if fault != self.machine.fault.number:
            raise _no(Code.NOT_READY, f"the fault is number {self.machine.fault.number}, not {fault}: read it first")
        self.machine.reset()
        return Answer(Code.OK)

    def _hold_lease(self, client: int) -> None:
        """Take the lease if it is free. Whoever does not hold it may stop the robot and ask, nothing else."""
        if not self.machine.lease.take(client):
            raise _no(Code.DENIED, "another client holds the command lease; it ends with that client's connection")
        if self._look is not None:
            raise _no(Code.NOT_READY, "the way to the target is still looked at; wait for the answer")

    def _illegal(self, cause: Cause) -> RequestRefusedError:
        if self.machine.state is State.MANUAL:
            return _no(Code.MANUAL, "the robot is in MANUAL; send PLANNING or START_UP first")
        if self.machine.state is State.EMERGENCY:
            number = "" if self.machine.fault is None else f" {self.machine.fault.number}: {self.machine.fault.text}"
            return _no(Code.EMERGENCY, f"fault{number}; a person must reset the robot")
        legal = ", ".join(command.value for command in COMMANDS if (self.machine.state, command) in TRANSITIONS)
        return _no(Code.NOT_READY, f"not {cause.value} in {self.machine.state.value}; possible are {legal}")


def _no(code: Code, text: str) -> RequestRefusedError:
    return RequestRefusedError(code, text)
