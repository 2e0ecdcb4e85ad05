"""Requests over a connection to a robot, ours or one of the old convention, and what ends each of them."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from itertools import count
from typing import Self

import numpy as np
from scipy.spatial.transform import RigidTransform

from sightline.errors import RobotRefusedError
from sightline.robot import contract
from sightline.robot.contract import ACK_S, STATUS_S, Code
from sightline.robot.control.states import Cause
from sightline.robot.igtl import Capability, Command, CommandReply, Get, Message, Status, String, Transform
from sightline.robot.igtl.kinds import Body
from sightline.robot.link.talk import Mail, Talk

# Robots of 2013 send no STATUS for these; what they do send says that the phase was entered.
_ENTERED_IS_DONE = (Cause.PLANNING.value, Cause.CALIBRATION.value)
_UNDERSTOOD = ("STRING", "STATUS", "TRANSFORM", "CAPABILITY", "RTS_COMMAND", "NDARRAY", "SENSOR")


@dataclass(frozen=True)
class Said:
    """How a request ended: STATUS's code and text."""

    name: str
    code: int
    text: str

    def refuse_unless_ok(self) -> Self:
        """Raise RobotRefusedError for any code but 1."""
        if self.code != Code.OK:
            name = Code(self.code).name.lower().replace("_", " ") if self.code in set(Code) else "code"
            raise RobotRefusedError(
                f"the robot refused {self.name} ({name}, {self.code}): {self.text or 'no reason given'}"
            )
        return self


class Exchange:
    """Requests over `talk`, each with an identifier of its own. `capabilities`: what the robot announced; empty for one
    of the old convention. Every call raises LinkError where an answer does not come in time."""

    def __init__(self, talk: Talk) -> None:
        self.capabilities: frozenset[str] = frozenset()
        self._talk = talk
        self._numbers = count(1)

    @property
    def knows_ours(self) -> bool:
        """Whether the robot knows what we added to the convention of 2013."""
        return bool(self.capabilities)

    def introduce(self, heartbeat: bool, streams: bool) -> None:
        """Ask for the robot's capabilities and announce ours. A robot of the old convention does not answer that; it
        answers the question for its state, which comes after."""
        with self._talk.mail() as mail:
            self._talk.send(Get("CAPABILITY"), "")
            self._talk.send(String(contract.CURRENT_STATUS), contract.CURRENT_STATUS)
            said = mail.until(lambda m: isinstance(m.body, (Capability, Status)), ACK_S)
            if said is None or not isinstance(said.body, Capability):
                return
            self.capabilities = frozenset(said.body.types)
            mine = {contract.HAS_TELEMETRY: streams, contract.HAS_HEARTBEAT: heartbeat}
            # Who announces drilling drills by DRILL alone: a stray MOVE_TO_TARGET at the bone is then refused.
            announced = (*_UNDERSTOOD, contract.HAS_DRILLING, *(name for name, wanted in mine.items() if wanted))
            self._talk.send(Capability(announced), "", version=2)
            mail.until(lambda m: isinstance(m.body, Capability), ACK_S)

    def next_number(self) -> str:
        """An identifier that was not used before."""
        return str(next(self._numbers))

    def command(self, name: str, timeout_s: float) -> Said:
        """Send a phase or an activity by its name, and wait for its acknowledgement, then for how it ended."""
        return self.command_over(self._talk, name, ACK_S, timeout_s)

    def command_over(self, talk: Talk, name: str, ack_s: float, timeout_s: float) -> Said:
        """The same over another connection to this robot, acknowledged within `ack_s`."""
        number = self.next_number()
        with talk.mail() as mail:
            talk.send(String(name), contract.COMMAND + number)
            mail.need(lambda m: m.device_name == contract.ACKNOWLEDGED + number, ack_s, f"ACK of {name}")
            return self._outcome(mail, name, timeout_s)

    def transform(
        self,
        mail: Mail,
        kind: str,
        matrix: np.ndarray,
        name: str,
        *,
        metadata: Mapping[str, str] | None = None,
        imaged_s: float | None = None,
    ) -> tuple[Said, Message]:
        """Send a registration or a target (4, 4), and wait for its echo and status: how it ended, and the echo."""
        number = self.next_number()
        self._talk.send(Transform(matrix), kind + number, metadata=metadata, imaged_s=imaged_s)
        echo = mail.need(lambda m: m.device_name == contract.ACKNOWLEDGED + number, ACK_S, f"ACK of {name}")
        return self._outcome(mail, name, STATUS_S), echo

    def order(self, name: str, text: str) -> str:
        """Send a COMMAND; the text of its reply. Raises RobotRefusedError where it was refused."""
        number = next(self._numbers)
        with self._talk.mail() as mail:
            self._talk.send(Command(number, name, text), name, version=2)
            said = mail.need(lambda m: isinstance(m.body, CommandReply) and m.body.command_id == number, ACK_S, name)
        assert isinstance(said.body, CommandReply)  # noqa: S101
        if said.body.error:
            raise RobotRefusedError(f"the robot refused {name}: {said.body.text}")
        return said.body.text

    def ask(self, body: Body, name: str, answers: Callable[[Message], bool]) -> Message:
        """The answer to a question."""
        return self._talk.ask(body, name, answers, name, marked=self.knows_ours)

    def status(self) -> Status:
        """The answer to the question for the robot's state: its phase is `error_name`."""
        body = self.ask(String(contract.CURRENT_STATUS), contract.CURRENT_STATUS, self.answers_status).body
        assert isinstance(body, Status)  # noqa: S101
        return body

    def answers_status(self, message: Message) -> bool:
        """Whether a message answers the question for the state: it is named after the phase; ours says it twice, which
        tells the answer from how something ended."""
        body = message.body
        if not isinstance(body, Status) or message.device_name == contract.CURRENT_STATUS:
            return False
        return not self.knows_ours or body.error_name == message.device_name

    def _outcome(self, mail: Mail, name: str, timeout_s: float) -> Said:
        entered = name in _ENTERED_IS_DONE and not self.knows_ours

        def ends(message: Message) -> bool:
            body = message.body
            if not isinstance(body, Status):
                return False
            return message.device_name == name or (
                entered and message.device_name == contract.CURRENT_STATUS and body.error_name == name
            )

        body = mail.need(ends, timeout_s, f"STATUS {name}").body
        assert isinstance(body, Status)  # noqa: S101
        return Said(name, body.code, body.text)


def pose_of(message: Message) -> RigidTransform:
    """The pose of a TRANSFORM. Raises RobotRefusedError for what is not one."""
    body = message.body
    fault = body.fault if isinstance(body, Transform) else f"it is a {message.type_name}"
    if not isinstance(body, Transform) or fault is not None:
        raise RobotRefusedError(f"the robot's {message.device_name} is not a pose: {fault}")
    return body.rigid()


def matrix_of(echo: Message) -> np.ndarray:
    """(4, 4): the matrix of an echo. Raises RobotRefusedError where it is not a TRANSFORM."""
    if not isinstance(echo.body, Transform):
        raise RobotRefusedError(f"the robot acknowledged a TRANSFORM by a {echo.type_name}")
    return echo.body.matrix
