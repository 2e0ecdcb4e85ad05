"""What the conformance test says to a robot and hears: everything is taken as it comes, and nothing judged."""

from collections.abc import Callable, Generator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from time import monotonic, sleep

import numpy as np
from scipy.spatial.transform import RigidTransform

from sightline.errors import RobotRefusedError
from sightline.robot import contract
from sightline.robot.contract import HEARTBEAT_S, Code
from sightline.robot.control.own_time import OwnTime
from sightline.robot.igtl import Message, Status, String, Transform
from sightline.robot.link.client import RobotClient
from sightline.robot.link.exchange import pose_of
from sightline.robot.link.talk import Mail

MOVED_MM = 0.5  # a motion has begun [ours]
STILL_MM, STILL_RAD = 0.1, float(np.deg2rad(0.1))  # what stands may seem to move by: encoders, and a spring [ours]
STILL_S, STILL_POSES = 0.3, 10  # for so long, and so often seen [ours]
_ENTERED_IS_DONE = ("PLANNING", "CALIBRATION")  # to a robot of 2013


class NotAskedError(Exception):
    """What leads to a question did not lead there."""


@dataclass
class Answer:
    """To a command or a pose: when its ACK and its STATUS came, seconds, None where they did not; `order`: the names
    that came, "ACK" for the acknowledgement."""

    ack: Message | None = None
    ack_s: float | None = None
    status_s: float | None = None
    code: int | None = None
    text: str = ""
    order: list[str] = field(default_factory=list)


class Conversation:
    """With the robot of a client."""

    def __init__(self, robot: RobotClient) -> None:
        self._robot = robot
        self._streams = contract.HAS_TELEMETRY in robot.capabilities

    def bring(self, *commands: str) -> None:
        """Send them one after the other. Raises NotAskedError where one is not done."""
        for name in commands:
            answer = self.command(name)
            if answer.code != Code.OK:
                why = "no STATUS came" if answer.code is None else f"code {answer.code} {answer.text}"
                raise NotAskedError(f"{name} was not done: {why}")

    def at(self, *commands: str) -> None:
        """The same, and the robot says that it is in the phase of the last. Raises NotAskedError."""
        self.bring(*commands)
        if (phase := self.phase()) != commands[-1]:
            raise NotAskedError(f"after {commands[-1]} it says that its phase is {phase}")

    def command(
        self, name: str, *, number: str | None = None, whole: bool = False, within_s: float = contract.STATUS_S
    ) -> Answer:
        """`number`: its identifier, else a new one. `whole`: until ACK and STATUS came, in whatever order; else until
        STATUS."""
        number = number or self._robot.exchange.next_number()

        def send() -> None:
            self._robot.talk.send(String(name), contract.COMMAND + number)

        return self.exchange(send, number, name, whole=whole, within_s=within_s)

    def pose(self, kind: str, matrix: np.ndarray, said: Mapping[str, str] | None = None) -> Answer:
        """Send a registration or a target."""
        number = self._robot.exchange.next_number()
        status = "TARGET" if kind == contract.TARGET else "CALIBRATION"

        def send() -> None:
            self._robot.talk.send(Transform(matrix), kind + number, metadata=said)

        return self.exchange(send, number, status, within_s=contract.STATUS_S)

    def exchange(
        self,
        send: Callable[[], None],
        number: str,
        status: str,
        *,
        whole: bool = False,
        within_s: float = contract.STATUS_S,
    ) -> Answer:
        """What came until the STATUS of that name."""
        answer = Answer()
        entered = status in _ENTERED_IS_DONE and not self._robot.capabilities

        def ends(message: Message) -> bool:
            self._note(answer, message, number, status, mail.own.now_s)
            if entered and answer.order and answer.order[-1] == contract.CURRENT_STATUS and answer.code is None:
                answer.code, answer.status_s = int(Code.OK), mail.own.now_s
            return answer.code is not None and (answer.ack is not None or not whole)

        with self._robot.talk.mail() as mail:
            send()
            mail.until(ends, within_s)
        return answer

    def _note(self, answer: Answer, message: Message, number: str, status: str, at_s: float) -> None:
        body = message.body
        if message.device_name == contract.ACKNOWLEDGED + number:
            answer.order.append("ACK")
            answer.ack, answer.ack_s = message, at_s
        elif message.device_name == contract.CURRENT_STATUS and isinstance(body, Status):
            # It is streamed as well: what came before the ACK is no answer.
            if contract.CURRENT_STATUS not in answer.order and (answer.ack is not None or not self._streams):
                answer.order.append(contract.CURRENT_STATUS)
        elif message.device_name == status and isinstance(body, Status) and answer.code is None:
            answer.order.append(status)
            answer.code, answer.text, answer.status_s = body.code, body.text, at_s

    def next(self, name: str, within_s: float) -> Message | None:
        """The next message of that name."""
        with self._robot.talk.mail() as mail:
            return mail.until(lambda m: m.device_name == name, within_s)

    def phase(self) -> str:
        """What a question for the state is answered by: the STATUS's name. Raises LateError."""
        said = self._robot.talk.ask(
            String(contract.CURRENT_STATUS),
            contract.CURRENT_STATUS,
            lambda m: isinstance(m.body, Status) and m.device_name != contract.CURRENT_STATUS,
            contract.CURRENT_STATUS,
            marked=bool(self._robot.capabilities),
        )
        return said.device_name

    def tip(self) -> RigidTransform:
        """Where the wire is now: from the stream, which asks nothing, where there is one."""
        if self._streams:
            return pose_of(self._robot.talk.fresh(contract.MEASURED_CP))
        return self._robot.position()

    @contextmanager
    def moving(self, number: str | None = None) -> Generator["Motion"]:
        """A motion to the target that the robot holds, seen to have begun. Raises NotAskedError where it is over."""
        before = self.tip()
        number = number or self._robot.exchange.next_number()
        with self._robot.talk.mail() as mail:
            self._robot.talk.send(String("MOVE_TO_TARGET"), contract.COMMAND + number)
            waited = OwnTime(HEARTBEAT_S)
            while _apart(before, self.tip())[0] < MOVED_MM:
                waited.turn(monotonic())
                if waited.now_s > contract.STATUS_S:
                    raise NotAskedError("it acknowledged a motion, and does not move")
            yield Motion(self, mail)


class Motion:
    """One that goes on. `watch`: who sees where the wire is; `mail`: what its commander hears."""

    def __init__(self, watch: Conversation, mail: Mail) -> None:
        self.watch = watch
        self._mail = mail
        self._own = OwnTime(HEARTBEAT_S)

    def must_stand_after(self, stop: Callable[[], Answer]) -> str:
        """Raise RobotRefusedError where the wire goes on after a stop was answered."""
        before = self.watch.tip()
        answer = stop()
        if answer.code != Code.OK:
            raise RobotRefusedError(f"STOP was answered by {answer.code} {answer.text}")
        at_once = self.watch.tip()
        off = self._moves(at_once)
        if off:
            raise RobotRefusedError(f"STOP was acknowledged, and the wire went on by {off}")
        if self._mail.holds(_arrived):
            raise NotAskedError("the motion had ended by itself before it could be stopped")
        took = f"answered in {1e3 * (answer.status_s or 0.0):.0f} ms"
        return f"{took}, {_apart(before, at_once)[0]:.1f} mm after it was sent"

    def must_not_begin_again(self, answer: Answer) -> str:
        """Raise RobotRefusedError where the wire, which stood, moves after what was answered so."""
        off = self._moves(self.watch.tip())
        if off:
            raise RobotRefusedError(f"the repeated MOVE_TO_TARGET moved the wire again, by {off}")
        if answer.code is None:
            raise RobotRefusedError("the repeated MOVE_TO_TARGET was not answered")
        return f"the first answer again: {answer.code} {answer.text}"

    def must_stand_by_itself(self, within_s: float) -> str:
        """Raise RobotRefusedError where the wire still moves after this time."""
        self._own.turn(monotonic())
        began_s, off = self._own.now_s, "nothing"
        while (seen_s := self._own.now_s - began_s) < within_s:
            off = self._moves(self.watch.tip())
            if self._mail.holds(_arrived):
                raise NotAskedError("the motion had ended by itself before it could be judged")
            if not off:
                return f"stands after {seen_s:.2f} s at most"
        raise RobotRefusedError(f"after {within_s:g} s the wire still moves, by {off}")

    def _moves(self, first: RigidTransform) -> str:
        """By how much it moves from there in the time that it takes to see; '' where it stands."""
        began, seen = monotonic(), 0
        while monotonic() - began < STILL_S or seen < STILL_POSES:
            self._own.turn(monotonic())
            mm, rad = _apart(first, self.watch.tip())
            if mm > STILL_MM or rad > STILL_RAD:
                return f"{mm:.2f} mm, {np.rad2deg(rad):.2f}°"
            seen += 1
            sleep(STILL_S / STILL_POSES)
        return ""


def _arrived(message: Message) -> bool:
    body = message.body
    return message.device_name == "MOVE_TO_TARGET" and isinstance(body, Status) and body.code == Code.OK


def _apart(one: RigidTransform, other: RigidTransform) -> tuple[float, float]:
    between = one.inv() * other
    return float(np.linalg.norm(between.translation)), float(between.rotation.magnitude())
