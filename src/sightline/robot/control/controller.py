"""The robot's controller: it carries out clients' requests on the machine. No input, output or clock.

One thread calls it: a method for each request, which returns its answer in every state, and `cycle` every `CYCLE_S`.
The collision check before a motion takes a quarter of a second and runs on another thread; the control loop does not
wait for it.
"""

from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass
from functools import partial, wraps
from typing import ParamSpec, TypeVar

import numpy as np

from sightline.errors import RobotRefusedError
from sightline.robot import contract
from sightline.robot.contract import Code
from sightline.robot.control.course import STANDING_SHARE, moving_limit
from sightline.robot.control.insertion import Insertion, Setup, read_registration, read_target
from sightline.robot.control.machine import Machine
from sightline.robot.control.requests import Answer, Outcome, Panel, RequestRefusedError
from sightline.robot.control.states import COMMANDS, TRANSITIONS, State, Trigger
from sightline.robot.control.timing import Lifetimes
from sightline.robot.igtl import Message
from sightline.robot.kinematics.calibrated import CalibratedRobot
from sightline.robot.kinematics.target import SHOT_SD_MM
from sightline.robot.plant import Plant

P = ParamSpec("P")
A = TypeVar("A")
_MOTION = (Trigger.MOVE_TO_TARGET, Trigger.DRILL, Trigger.GUIDE, Trigger.RETRACT)


CheckExecutor = Callable[[Callable[[], Insertion]], "Future[Insertion]"]  # submits the work, as Executor.submit does
MAX_CHECK_S = contract.ACK_S  # a motion whose check took longer does not begin
TARGET = "TARGET"  # name of the outcome for a target's check


@dataclass(frozen=True, eq=False)
class CollisionCheck:
    """Collision check of an insertion for a `client`, starting at the joints `start` (n,). `trigger`: the motion that
    waits for it; None for a target just sent. `result`: as of `Insertion.cleared`."""

    client: int
    trigger: Trigger | None
    insertion: Insertion
    start: np.ndarray
    begun_s: float
    result: "Future[Insertion]"

    @property
    def name(self) -> str:
        """Name of the outcome: the command that waits, or TARGET."""
        return TARGET if self.trigger is None else self.trigger.value


def run_at_once(work: Callable[[], Insertion]) -> "Future[Insertion]":
    """Synchronous executor for callers without a control loop."""
    done: Future[Insertion] = Future()
    try:
        done.set_result(work())
    except Exception as error:
        done.set_exception(error)
    return done


def _no(code: Code, text: str) -> RequestRefusedError:
    return RequestRefusedError(code, text)


def _answering(request: Callable[P, A]) -> Callable[P, A | Answer]:
    """Return a request whose refusals become answers."""

    @wraps(request)
    def answer(*args: P.args, **options: P.kwargs) -> A | Answer:
        try:
            return request(*args, **options)
        except RequestRefusedError as refused:
            return refused.answer
        except RobotRefusedError as error:
            return Answer(Code.CONFIGURATION, str(error))

    return answer


class Controller:
    """Controller of one calibrated robot.

    `first_fault`: the number of its first fault. If it differs with every start, a reset meant for an earlier fault
    cannot clear a later one. `machine`: the controlled machine, for others to read. `check_executor`: runs collision
    checks; a real-time loop sets one that runs them on another thread.
    """

    def __init__(
        self, robot: CalibratedRobot, plant: Plant, setup: Setup, panel: Panel | None = None, first_fault: int = 1
    ) -> None:
        self.machine = Machine(robot, plant, setup, panel or Panel(), first_fault)
        self.check_executor: CheckExecutor = run_at_once
        self._lifetimes = Lifetimes()
        self._checked_from = self.machine.q
        self._check: CollisionCheck | None = None

    # Calls on behalf of clients.

    def heard(self, client: int, *, heartbeat: bool = False) -> None:
        """Record a message. `heartbeat`: it is one, or announces them; from now on this client is watched for
        silence."""
        self.machine.lease.heard(client, self.machine.clock_s, heartbeat)

    def lost(self, client: int, now_s: float) -> None:
        """Remove a client that is gone. If it held the lease, the robot stops and clears registration and target."""
        self.machine.outcomes.drop_stops(client)
        if self.machine.lease.left(client):
            self._check = None
            self.machine.abandon(now_s)

    def cycle(self, now_s: float, unread_s: float = 0.0) -> tuple[Outcome, ...]:
        """Run one cycle: read the plant, supervise, command. Returns what has ended since the last cycle.

        `unread_s`: for how long, by the LoopClock, clients' messages may have been waiting unread."""
        self.machine.cycle(now_s, unread_s)
        self._report_check(now_s)
        return self.machine.outcomes.take()

    @property
    def lease(self) -> int | None:
        """The client that holds the command lease; None if it is free."""
        return self.machine.lease.holder

    @property
    def busy(self) -> bool:
        """Whether something moves, has not yet come to rest, or a collision check is running."""
        return self.machine.moves or self._check is not None

    @property
    def checking_for(self) -> int | None:
        """The client that waits for a collision check; None if none is running."""
        return None if self._check is None else self._check.client

    # Requests.

    @_answering
    def command(
        self, client: int, name: str, now_s: float, *, overtaken: bool = False, by_name: bool = False
    ) -> Answer:
        """Carry out a command, known or not. `overtaken`: a stop that was sent later was handled before it. `by_name`:
        its client drills by DRILL only, never by a further MOVE_TO_TARGET."""
        trigger = next((trigger for trigger in COMMANDS if trigger.value == name), None)
        if trigger is None:
            known = ", ".join(command.value for command in COMMANDS)
            raise _no(Code.UNKNOWN, f"there is no command {name[:40]!r}; there are {known}")
        if trigger is Trigger.STOP:
            return self._stop(client, now_s)
        if trigger is Trigger.EMERGENCY:
            self.machine.fail(Code.EMERGENCY, "a client sent EMERGENCY", now_s)
            return Answer(Code.OK, done=False)  # the outcome for all clients is also this client's STATUS
        self._hold_lease(client)
        if (self.machine.state, trigger) not in TRANSITIONS:
            raise self._illegal(trigger)
        if by_name and trigger is Trigger.MOVE_TO_TARGET and TRANSITIONS[self.machine.state, trigger] is State.DRILL:
            text = f"this client announced {contract.HAS_DRILLING}: it drills by {Trigger.DRILL.value} alone"
            raise _no(Code.NOT_READY, text)
        if overtaken and trigger in _MOTION:
            raise _no(Code.NOT_READY, "a stop came after this command, which is void")
        self._guard(trigger, now_s)
        if self.machine.insertion is not None and self._needs_check(trigger):
            return self._begin_check(client, self.machine.insertion, trigger, now_s)
        return self.machine.begin(client, trigger)

    def _guard(self, trigger: Trigger, now_s: float) -> None:
        """Refuse triggers by conditions that are not in the state table."""
        if trigger is Trigger.START_UP and self.machine.stop_pressed:
            raise _no(Code.NOT_READY, "the stop button is pressed; release it at the robot")
        if trigger is Trigger.TARGETING and self.machine.registration is None:
            raise _no(Code.NOT_READY, "there is no registration; send CALIBRATION and CLB_ first")
        if trigger not in _MOTION:
            return
        if self.machine.stop_pressed or not self.machine.run_held:
            raise _no(Code.NOT_READY, "the hold-to-run switch is not held, or the stop button is pressed")
        if self.machine.outcomes.stopping:
            raise _no(Code.NOT_READY, "the robot is still stopping")
        if TRANSITIONS[self.machine.state, trigger] is State.RETRACT:
            return
        if self.machine.insertion is None:
            raise _no(Code.NOT_READY, "there is no target; send TARGETING and TGT_ first")
        drills = TRANSITIONS[self.machine.state, trigger] is State.DRILL
        if drills and not self.machine.robot.manipulator.has_feed:
            raise _no(
                Code.NOT_READY, "this arm has no feed: send GUIDE, and a person drills through the guide it holds"
            )
        if drills and self.machine.lease.unwatched:
            text = f"announce {contract.HAS_HEARTBEAT} and send a heartbeat every {1e3 * contract.HEARTBEAT_S:.0f} ms"
            raise _no(Code.NOT_READY, f"{text}: without it the wire goes on for seconds when the network is lost")
        if not now_s <= self.machine.insertion.expires_s:
            raise _no(Code.CONFIGURATION, "the plan has expired; take new images and plan again")

    def _needs_check(self, trigger: Trigger) -> bool:
        """Return whether the arm would swing from another place than where its path was checked from."""
        limit = STANDING_SHARE * moving_limit(self.machine.robot.manipulator)
        moved = np.abs(self.machine.q - self._checked_from) > limit
        return trigger in _MOTION and TRANSITIONS[self.machine.state, trigger] is State.ALIGN and bool(moved.any())

    # Collision check.

    def _begin_check(self, client: int, insertion: Insertion, trigger: Trigger | None, now_s: float) -> Answer:
        """Check the path from here. The robot stands still and its client's other requests wait until it has ended."""
        start = self.machine.q
        work = partial(insertion.cleared, self.machine.robot.manipulator, start, self.machine.setup)
        self._check = CollisionCheck(client, trigger, insertion, start, now_s, self.check_executor(work))
        return self._finish_check(now_s) or Answer(Code.OK, done=False)

    def _report_check(self, now_s: float) -> None:
        if self.machine.fault is not None:
            self._cancel_check(self.machine.fault.code, self.machine.fault.text)
        check, answer = self._check, self._finish_check(now_s)
        if check is not None and answer is not None and answer.done:
            self.machine.outcomes.add(Outcome(check.client, check.name, answer.code, answer.text))

    @_answering
    def _finish_check(self, now_s: float) -> Answer | None:
        """Return how the check ended, after beginning the motion that waited for it; None while it is running."""
        check = self._check
        if check is None or not check.result.done():
            return None
        self._check = None
        cleared = check.result.result()
        self.machine.insertion, self._checked_from = cleared, check.start
        if check.trigger is None:
            hole = self.machine.open_hole(cleared)
            return Answer(Code.OK, "" if hole is None else f"{contract.OPEN_HOLE}; {hole.bottom_mm:.2f} mm")
        if now_s - check.begun_s > MAX_CHECK_S or self._needs_check(check.trigger):
            text = f"looking for collisions took {now_s - check.begun_s:.1f} s, or the robot was moved meanwhile"
            raise _no(Code.NOT_READY, f"{text}; command it again")
        self._guard(check.trigger, now_s)
        return self.machine.begin(check.client, check.trigger)

    def _cancel_check(self, code: Code, text: str) -> None:
        """Cancel the running check and ignore its result."""
        if self._check is not None:
            self._check.result.cancel()
            self.machine.outcomes.conclude(Outcome(self._check.client, self._check.name, code, text))
            self._check = None

    @_answering
    def register(self, client: int, message: Message, now_s: float) -> Answer:
        """Take the registration in a message."""
        self._hold_lease(client)
        if self.machine.state is not State.CALIBRATION:
            where = self.machine.state.value
            raise _no(Code.NOT_READY, f"a registration is taken in CALIBRATION; the robot is in {where}")
        self.machine.forget()  # the old registration is void even if the new one is refused
        self.machine.registration = read_registration(message, self.machine.setup)
        self._lifetimes.registered(now_s)
        return Answer(Code.OK)

    @_answering
    def set_target(self, client: int, message: Message, now_s: float) -> Answer:
        """Take the target in a message, once its path was checked for collisions."""
        self._hold_lease(client)
        if self.machine.registration is None:
            raise _no(Code.NOT_READY, "there is no registration; send CALIBRATION and CLB_ first")
        if self.machine.state is not State.TARGETING:
            raise _no(Code.NOT_READY, f"a target is taken in TARGETING; the robot is in {self.machine.state.value}")
        self.machine.insertion = self.machine.drilling = None  # the old target is void even if the new one is refused
        read = read_target(
            message, self.machine.registration, self.machine.robot, self.machine.setup, now_s, near=self.machine.q
        )
        return self._begin_check(client, self._lifetimes.limit(read, now_s), None, now_s)

    @_answering
    def shot_depth(self, client: int, depth_mm: float, sd_mm: float = SHOT_SD_MM) -> Answer:
        """Take the depth of the tip beyond the entry point in the check shot, and its standard deviation; mm."""
        self._hold_lease(client)
        if self.machine.state is not State.PAUSED or self.machine.drilling is None:
            raise _no(Code.NOT_READY, f"a shot's depth is taken in PAUSED; the robot is in {self.machine.state.value}")
        self.machine.drilling.correct_depth(self.machine.fed_mm, depth_mm, sd_mm)
        return Answer(Code.OK)

    def _stop(self, client: int, now_s: float) -> Answer:
        outcomes = [Outcome(client, Trigger.STOP.value, Code.OK, "stands still")]
        if self.lease is not None and client != self.lease:
            outcomes.append(Outcome(self.lease, Trigger.STOP.value, Code.OK, "stopped by another client"))
        self.machine.stop(outcomes, now_s)
        self._cancel_check(Code.NOT_READY, "stopped by a client's STOP")
        return Answer(Code.OK, done=False)

    @_answering
    def reset(self, fault: int) -> Answer:
        """Reset over the link: a person has read the fault of this number."""
        if self.machine.panel.key_switch:
            raise _no(Code.DENIED, "this robot is reset with the key at its panel")
        if self.machine.fault is None:
            raise _no(Code.NOT_READY, "there is no fault to reset")
        if fault != self.machine.fault.number:
            raise _no(Code.NOT_READY, f"the fault is number {self.machine.fault.number}, not {fault}: read it first")
        self.machine.reset()
        return Answer(Code.OK)

    def _hold_lease(self, client: int) -> None:
        """Acquire the lease if it is free, else refuse. Other clients may only query and stop the robot."""
        if not self.machine.lease.take(client):
            raise _no(Code.DENIED, "another client holds the command lease; it ends with that client's connection")
        if self._check is not None:
            raise _no(Code.NOT_READY, "the way to the target is still looked at; wait for the answer")

    def _illegal(self, trigger: Trigger) -> RequestRefusedError:
        if self.machine.state is State.MANUAL:
            return _no(Code.MANUAL, "the robot is in MANUAL; send PLANNING or START_UP first")
        if self.machine.state is State.EMERGENCY:
            number = "" if self.machine.fault is None else f" {self.machine.fault.number}: {self.machine.fault.text}"
            return _no(Code.EMERGENCY, f"fault{number}; a person must reset the robot")
        legal = ", ".join(command.value for command in COMMANDS if (self.machine.state, command) in TRANSITIONS)
        return _no(Code.NOT_READY, f"not {trigger.value} in {self.machine.state.value}; possible are {legal}")
