"""The conformance test's conversation with a robot, and what its questions share: targets in air, expectations."""

from collections.abc import Callable, Generator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from time import monotonic, sleep
from uuid import uuid4

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from sightline.errors import RobotRefusedError
from sightline.robot import contract
from sightline.robot.contract import HEARTBEAT_S, Code
from sightline.robot.control.insertion import BARE_LENGTH_MM, DEPTH_SLACK_MM
from sightline.robot.control.timing import LoopClock
from sightline.robot.igtl import Message, Status, String, Transform
from sightline.robot.link.client import RobotClient
from sightline.robot.link.exchange import TIP_LIMIT_MM, WireDeviation, pose_of, refuse_other_pose
from sightline.robot.link.shared_connection import Mailbox

# A robot stands still if no more movement is seen than encoders and compliance show at rest, for this time and in at
# least so many poses [ours].
STILL_MM, STILL_RAD, STILL_S, STILL_POSES = 0.1, float(np.deg2rad(0.1)), 0.3, 10
_ENTERED_IS_DONE = ("PLANNING", "CALIBRATION")  # phases that robots of 2013 confirm by CURRENT_STATUS only

# A registration for tests of refusals, where any will do: 500 mm from base to hip, as many robots stand.
REGISTRATION = RigidTransform.from_translation([500.0, 0.0, 0.0])
# Target in air: distances ahead of home, mm, of which the first reachable one is used, and the distance aside.
AHEAD_MM, ASIDE_MM = (130.0, 100.0, 60.0, 30.0), 3.0
HIP_AHEAD_MM = 150.0  # ahead of the wire in its sleeve, as our frame is held; CFCS upright, its +X towards the robot
# Why questions are not for robots of the 2013 convention.
SEVERAL = "a robot of the 2013 convention accepts one client"
IDENTIFIERS = "the 2013 convention does not define repeated identifiers"


@dataclass
class Workplace:
    """Where a robot is tested. `frame_serial`: of the frame on its flange. `home`: the wire as the test found it, in
    MCS, or in CFCS for a robot without streams."""

    frame_serial: str
    home: RigidTransform | None = None


class NotAskedError(Exception):
    """The precondition of a question could not be reached."""


class UnsupportedError(Exception):
    """The robot does not announce the capability that a question needs."""


@dataclass
class Response:
    """The response to a command or a pose: times of its ACK and its STATUS, s, None if they did not come; `order`:
    names of the messages in order of arrival, "ACK" for the acknowledgement."""

    ack: Message | None = None
    ack_s: float | None = None
    status_s: float | None = None
    code: int | None = None
    text: str = ""
    order: list[str] = field(default_factory=list)


class Conversation:
    """A conversation with the robot over one client."""

    def __init__(self, robot: RobotClient, workplace: Workplace) -> None:
        self.robot, self.workplace = robot, workplace
        self._streams = contract.HAS_TELEMETRY in robot.capabilities

    def require(self, capability: str, why: str = "") -> None:
        """Raise UnsupportedError unless the robot announces a capability; `why`: the reason it is needed."""
        if capability not in self.robot.capabilities:
            raise UnsupportedError(f"announces no {capability}" + (f": {why}" if why else ""))

    def require_ours(self, why: str) -> None:
        """Raise UnsupportedError for a robot of the 2013 convention, with the reason."""
        if not self.robot.capabilities:
            raise UnsupportedError(why)

    @contextmanager
    def second(self) -> Generator["Conversation"]:
        """Open a second connection to the robot, without heartbeats."""
        with RobotClient(self.robot.host, self.robot.port, heartbeat=False) as other:
            yield Conversation(other, self.workplace)

    def bring(self, *commands: str) -> None:
        """Send commands in sequence. Raises NotAskedError if one is not done."""
        for name in commands:
            answer = self.command(name)
            if answer.code != Code.OK:
                why = "no STATUS came" if answer.code is None else f"code {answer.code} {answer.text}"
                raise NotAskedError(f"{name} was not done: {why}")

    def at(self, *commands: str) -> None:
        """Send commands in sequence and check that the robot reports the last one's phase. Raises NotAskedError."""
        self.bring(*commands)
        if (phase := self.phase()) != commands[-1]:
            raise NotAskedError(f"after {commands[-1]} its phase is {phase}")

    def command(
        self, name: str, *, number: str | None = None, whole: bool = False, within_s: float = contract.STATUS_S
    ) -> Response:
        """Send a command and return its response. `number`: its identifier, by default a new one. `whole`: wait for
        both ACK and STATUS, in any order; else for STATUS only."""
        number = number or self.robot.next_number()
        send = partial(self.robot.connection.send, String(name), contract.COMMAND + number)
        return self.exchange(send, number, name, whole=whole, within_s=within_s)

    def refused(self, name: str, *codes: Code) -> str:
        """Send a command that must be refused and return its answer; stop what a faulty robot begins.

        Raises RobotRefusedError."""
        try:
            return expect_code(self.command(name), *codes)
        finally:
            self.command("STOP")

    def pose(self, prefix: str, matrix: np.ndarray, metadata: Mapping[str, str] | None = None) -> Response:
        """Send a registration or a target and return its response."""
        number = self.robot.next_number()
        send = partial(self.robot.connection.send, Transform(matrix), prefix + number, metadata=metadata)
        return self.exchange(send, number, "TARGET" if prefix == contract.TARGET else "CALIBRATION")

    def exchange(
        self,
        send: Callable[[], None],
        number: str,
        status: str,
        *,
        whole: bool = False,
        within_s: float = contract.STATUS_S,
    ) -> Response:
        """Send, and return what came until the STATUS of that name."""
        answer = Response()
        entered = status in _ENTERED_IS_DONE and not self.robot.capabilities

        def ends(message: Message) -> bool:
            self._note(answer, message, number, status, mail.clock.now_s)
            if entered and answer.order and answer.order[-1] == contract.CURRENT_STATUS and answer.code is None:
                answer.code, answer.status_s = int(Code.OK), mail.clock.now_s
            return answer.code is not None and (answer.ack is not None or not whole)

        with self.robot.connection.mailbox() as mail:
            send()
            mail.until(ends, within_s)
        return answer

    def _note(self, answer: Response, message: Message, number: str, status: str, at_s: float) -> None:
        body = message.body
        if message.device_name == contract.ACKNOWLEDGED + number:
            answer.order.append("ACK")
            answer.ack, answer.ack_s = message, at_s
        elif message.device_name == contract.CURRENT_STATUS and isinstance(body, Status):
            # It is also streamed: one that came before the ACK is not the answer.
            if contract.CURRENT_STATUS not in answer.order and (answer.ack is not None or not self._streams):
                answer.order.append(contract.CURRENT_STATUS)
        elif message.device_name == status and isinstance(body, Status) and answer.code is None:
            answer.order.append(status)
            answer.code, answer.text, answer.status_s = body.code, body.text, at_s

    def target(self, target: np.ndarray) -> tuple[Response, Message | None]:
        """Send a target and return how it ended, and if it was accepted the REACHABLE_TARGET, None if none came."""
        with self.robot.connection.mailbox() as mail:
            answer = self.pose(contract.TARGET, target)
            accepted = answer.code == Code.OK
            return answer, mail.until(lambda m: m.device_name == "REACHABLE_TARGET", contract.ACK_S * accepted)

    def phase(self) -> str:
        """Query the state and return the name of the STATUS that answers. Raises LateError."""
        answer = self.robot.connection.ask(
            String(contract.CURRENT_STATUS),
            contract.CURRENT_STATUS,
            lambda m: isinstance(m.body, Status) and m.device_name != contract.CURRENT_STATUS,
            contract.CURRENT_STATUS,
            marked=bool(self.robot.capabilities),
        )
        return answer.device_name

    def expect_phase(self, wanted: str, when: str) -> None:
        """Raise RobotRefusedError unless the robot reports this phase; `when`: beginning of the message."""
        phase = self.phase()
        expect(phase == wanted, f"{when} the phase is {phase}")

    def tip(self) -> RigidTransform:
        """Return the wire's current pose, from the stream if there is one, else by a query."""
        if self._streams:
            return pose_of(self.robot.connection.fresh(contract.MEASURED_CP))
        return self.robot.position()

    def moves(self, first: RigidTransform, within_s: float = STILL_S) -> str:
        """Return the movement from `first` within a time as text; '' if the wire stands still."""
        began, seen = monotonic(), 0
        while monotonic() - began < within_s or seen < STILL_POSES:
            mm, rad = _apart(first, self.tip())
            if mm > STILL_MM or rad > STILL_RAD:
                return f"{mm:.2f} mm, {np.rad2deg(rad):.2f}°"
            seen += 1
            sleep(STILL_S / STILL_POSES)
        return ""

    @contextmanager
    def moving(self, number: str | None = None) -> Generator["Motion"]:
        """Start a motion to the robot's target and wait until it has begun. Raises NotAskedError if it does not
        begin."""
        before = self.tip()
        number = number or self.robot.next_number()
        with self.robot.connection.mailbox() as mail:
            self.robot.connection.send(String("MOVE_TO_TARGET"), contract.COMMAND + number)
            waited = LoopClock(HEARTBEAT_S)
            while _apart(before, self.tip())[0] < TIP_LIMIT_MM:
                waited.tick(monotonic())
                if waited.now_s > contract.STATUS_S:
                    raise NotAskedError("it acknowledged a motion but does not move")
            yield Motion(self, mail)


class Motion:
    """A motion in progress. `watch`: the conversation that observes the wire; `mail`: of the client that commands
    it."""

    def __init__(self, watch: Conversation, mail: Mailbox) -> None:
        self.watch = watch
        self._mail = mail
        self._clock = LoopClock(HEARTBEAT_S)

    def must_stand_after(self, stop: Callable[[], Response]) -> str:
        """Stop; raise RobotRefusedError if the wire moves on after the stop was answered."""
        before = self.watch.tip()
        answer = stop()
        expect(answer.code == Code.OK, f"STOP was answered by {answer.code} {answer.text}")
        at_once = self.watch.tip()
        off = self.watch.moves(at_once)
        expect(not off, f"STOP was acknowledged, but the wire moved on by {off}")
        if self._mail.holds(_arrived):
            raise NotAskedError("the motion had ended by itself before it could be stopped")
        took = f"answered in {1e3 * (answer.status_s or 0.0):.0f} ms"
        return f"{took}, {_apart(before, at_once)[0]:.1f} mm after it was sent"

    def must_not_begin_again(self, answer: Response) -> str:
        """Raise RobotRefusedError if the wire, which stood still, moves again after this response."""
        off = self.watch.moves(self.watch.tip())
        expect(not off, f"the repeated MOVE_TO_TARGET moved the wire again, by {off}")
        expect(answer.code is not None, "the repeated MOVE_TO_TARGET was not answered")
        return f"the first answer again: {answer.code} {answer.text}"

    def must_stand_by_itself(self, within_s: float) -> str:
        """Raise RobotRefusedError if the wire still moves after this time."""
        self._clock.tick(monotonic())
        began_s, off = self._clock.now_s, "nothing"
        while (seen_s := self._clock.now_s - began_s) < within_s:
            off = self.watch.moves(self.watch.tip())
            self._clock.tick(monotonic())
            if self._mail.holds(_arrived):
                raise NotAskedError("the motion had ended by itself before it could be judged")
            if not off:
                return f"stands after {seen_s:.2f} s at most"
        raise RobotRefusedError(f"after {within_s:g} s the wire still moves, by {off}")


def _arrived(message: Message) -> bool:
    body = message.body
    return message.device_name == "MOVE_TO_TARGET" and isinstance(body, Status) and body.code == Code.OK


def _apart(first: RigidTransform, second: RigidTransform) -> tuple[float, float]:
    between = first.inv() * second
    return float(np.linalg.norm(between.translation)), float(between.rotation.magnitude())


Question = Callable[[Conversation], str]  # returns what was observed; raises if it breaks the contract


def registered(talk: Conversation) -> RigidTransform:
    """Start up, send a registration that the robot accepts, and return the wire's home in it, CFCS. Raises
    NotAskedError."""
    talk.bring("START_UP")
    registration, place = REGISTRATION, talk.workplace
    streams = contract.HAS_TELEMETRY in talk.robot.capabilities
    if streams:
        if place.home is None:
            place.home = pose_of(talk.robot.connection.fresh(contract.MEASURED_CP))
        hip = place.home.apply([0.0, 0.0, HIP_AHEAD_MM])
        registration = RigidTransform.from_components(hip, Rotation.from_rotvec([0.0, 0.0, np.pi]))
    talk.bring("CALIBRATION")
    answer = talk.pose(contract.CALIBRATION, registration.inv().as_matrix())
    if answer.code != Code.OK:
        raise NotAskedError(f"no registration was accepted: {answer.text or answer.code}")
    if place.home is None:
        place.home = talk.robot.position()
    return registration.inv() * place.home if streams else place.home


def target_in_air(talk: Conversation, *, at_home: bool = False) -> tuple[np.ndarray, Message | None]:
    """Send a target ahead of home that the robot accepts; return it, (4, 4) CFCS, and its REACHABLE_TARGET, if any.

    It is to the other side of home than the arm stands, unless `at_home`. Raises NotAskedError.
    """
    home, why = registered(talk), ""
    stands_mm = (home.inv() * talk.robot.position()).translation[1]
    here = float(np.copysign(ASIDE_MM, stands_mm))
    asides = [aside for aside in (-here, here, 3.0 * here) if abs(aside - stands_mm) > ASIDE_MM / 2]
    talk.bring("TARGETING")
    for aside in [0.0, *asides] if at_home else asides:
        for ahead in AHEAD_MM:
            target = (home * RigidTransform.from_translation([0.0, aside, ahead])).as_matrix()
            answer, reachable = talk.target(target)
            if answer.code == Code.OK:
                return target, reachable
            why = why or answer.text
    raise NotAskedError(f"no target ahead of the wire is reachable: {why or 'no reason given'}")


def verified_target(talk: Conversation, *, at_home: bool = False) -> np.ndarray:
    """Send a target that the robot accepts and will reach, and return it, (4, 4) CFCS. Raises NotAskedError."""
    target, reachable = target_in_air(talk, at_home=at_home)
    if reachable is not None:
        try:
            WireDeviation.of(pose_of(reachable), RigidTransform.from_matrix(target)).refuse_large(
                "it would lay the wire"
            )
        except RobotRefusedError as error:
            raise NotAskedError(str(error)) from error
    return target


def plan_name() -> str:
    """Return the identifier of a plan that was not sent before."""
    return f"conformance {uuid4()}"


def accepted_plan(talk: Conversation, **stated: str) -> tuple[np.ndarray, dict[str, str]]:
    """Send a target in air with the identity of a plan that the robot accepts; return it, (4, 4) CFCS, and the plan's
    metadata. `stated`: metadata other than usual. Raises UnsupportedError, NotAskedError."""
    talk.require(contract.HAS_PLAN)
    target, _ = target_in_air(talk)
    talk.bring("TARGETING")
    refused: list[str] = []
    for side in ("right", "left"):
        plan = {
            contract.PLAN: plan_name(), contract.SIDE: side,
            contract.FRAME_SERIAL: talk.workplace.frame_serial, contract.GO: contract.YES, contract.UNITS: contract.MM,
            contract.COORDINATES: contract.CFCS, contract.LENGTH_MM: repr(BARE_LENGTH_MM),
            contract.DEPTH_LIMIT_MM: repr(BARE_LENGTH_MM + DEPTH_SLACK_MM), contract.VALID_S: "60",
        } | stated  # fmt: skip
        answer = talk.pose(contract.TARGET, target, plan)
        if answer.code == Code.OK:
            return target, plan
        refused.append(f"{side}: {answer.text or answer.code}")
    serial = talk.workplace.frame_serial
    raise NotAskedError(f"no plan for the frame {serial!r} (--frame-serial) was accepted: {'; '.join(refused)}")


def expect(condition: bool, seen: str) -> None:
    """Raise RobotRefusedError with the text `seen` if a condition does not hold."""
    if not condition:
        raise RobotRefusedError(seen)


def expect_code(answer: Response, *codes: Code) -> str:
    """Return the response's code and text. Raises RobotRefusedError for any other code, and if none came."""
    expect(answer.code is not None, "no STATUS came")
    received = f"code {answer.code}: {answer.text}" if answer.text else f"code {answer.code}"
    expect(answer.code in codes, f"{received}; wanted {' or '.join(str(int(code)) for code in codes)}")
    return received


def expect_echo(answer: Response, sent: np.ndarray, what: str) -> str:
    """Expect the matrix `sent` (4, 4) back. Raises RobotRefusedError if none or another came."""
    if answer.ack is None or not isinstance(answer.ack.body, Transform):
        raise RobotRefusedError(f"no echo of the {what} came")
    refuse_other_pose(answer.ack.body.matrix, sent, what)
    return "as it was sent"
