"""Requests over a connection to a robot, ours or one of the 2013 convention; the connection for stops; and how far a
reported wire is from its target."""

from collections.abc import Callable, Mapping
from contextlib import closing, suppress
from dataclasses import dataclass
from itertools import count
from threading import Event, Lock, Thread
from time import monotonic, sleep
from typing import Self

import numpy as np
from scipy.spatial.transform import RigidTransform

from sightline.errors import LinkError, RobotRefusedError
from sightline.robot import contract
from sightline.robot.contract import ACK_S, STATUS_S, Code
from sightline.robot.control.states import Trigger
from sightline.robot.igtl import (
    Body,
    Capability,
    Command,
    CommandReply,
    Get,
    Message,
    Sensor,
    Status,
    String,
    Transform,
)
from sightline.robot.link.shared_connection import Mailbox, SharedConnection

# Robots of 2013 send no STATUS for these phases; their CURRENT_STATUS says that the phase was entered.
_ENTERED_IS_DONE = (Trigger.PLANNING.value, Trigger.CALIBRATION.value)
_UNDERSTOOD = ("STRING", "STATUS", "TRANSFORM", "CAPABILITY", "RTS_COMMAND", "NDARRAY", "SENSOR")
# A stop that is not acknowledged on its own connection by then is also sent over the main one: our robots acknowledge
# in 10 ms.
STOP_ACK_S = contract.SILENCE_S
PROBE_S = ACK_S  # period of probes whether the stop connection still answers


# Half of the paper's limit for the tip, and a third of that for the direction [paper, Fig. 15; ours]. A robot's report
# comes from its encoders, which resolve a hundredth of these.
TIP_LIMIT_MM = 0.5
AXIS_LIMIT_RAD = float(np.deg2rad(0.2))
_APART_MM = TIP_LIMIT_MM / 2  # by which pose and depth may differ, of instants a quarter of a second apart at 1 mm/s
# Tolerance of an echo, which is in 32-bit numbers; a robot that converts it to a quaternion and back loses digits
# [ours].
_ECHO_DIGITS = 16 * np.finfo(np.float32).eps


@dataclass(frozen=True)
class WireDeviation:
    """Deviation of a wire from its target: the tip `aside_mm` from the planned axis and `along_mm` beyond the planned
    tip, its axis `angle_rad` from the planned one. Rotation about the wire does not count."""

    aside_mm: float
    along_mm: float
    angle_rad: float

    @staticmethod
    def of(wire: RigidTransform, target: RigidTransform) -> "WireDeviation":
        """Return the deviation between two poses of the wire's tip, +z along the wire, in one frame."""
        between = target.inv() * wire
        x, y, z = between.rotation.apply([0.0, 0.0, 1.0])
        tip = between.translation
        return WireDeviation(float(np.hypot(tip[0], tip[1])), float(tip[2]), float(np.arctan2(np.hypot(x, y), z)))

    def refuse_large(self, what: str, depth_off_mm: float | None = None, zero_limit_mm: float = 0.0) -> None:
        """Raise RobotRefusedError if tip or axis exceed their limits.

        `depth_off_mm`: the robot's own depth less the planned depth, for a robot whose zero of depth was corrected by
        contact or a shot, by at most `zero_limit_mm`."""
        deep = self.along_mm if depth_off_mm is None else depth_off_mm
        moved = abs(self.along_mm - deep)
        if (
            np.hypot(self.aside_mm, deep) <= TIP_LIMIT_MM
            and moved <= zero_limit_mm + _APART_MM
            and self.angle_rad <= AXIS_LIMIT_RAD
        ):
            return
        stated = ""
        if depth_off_mm is not None:
            moved_by = f"{moved:.2f} mm (at most {zero_limit_mm:.1f} mm)"
            stated = f", its stated depth {depth_off_mm:+.2f} mm off, its zero moved by {moved_by}"
        raise RobotRefusedError(
            f"{what} elsewhere than planned: the tip {self.aside_mm:.2f} mm aside and {self.along_mm:+.2f} mm along "
            f"the wire (at most {TIP_LIMIT_MM:g} mm){stated}, its axis {np.rad2deg(self.angle_rad):.2f}° off (at most "
            f"{np.rad2deg(AXIS_LIMIT_RAD):.1f}°); stop, and find the cause before anything moves"
        )


def refuse_other_pose(echo: np.ndarray, sent: np.ndarray, what: str) -> None:
    """Raise RobotRefusedError if an acknowledged matrix (4, 4) differs from the one that was sent."""
    sent = np.asarray(sent, dtype=np.float32).astype(np.float64)
    size = np.maximum(np.abs(sent), 1.0)
    same = (np.abs(echo - sent) <= _ECHO_DIGITS * size) | (np.isnan(echo) & np.isnan(sent)) | (echo == sent)
    if not same.all():
        off = np.abs(echo - sent)[:3, 3]
        raise RobotRefusedError(
            f"the robot acknowledged another {what} than was sent: its origin differs by {np.max(off):.2f} mm, or its "
            "axes do; nothing may move by it"
        )


@dataclass(frozen=True)
class RequestResult:
    """How a request ended: code and text of its STATUS."""

    name: str
    code: int
    text: str

    def refuse_unless_ok(self) -> Self:
        """Raise RobotRefusedError for any code but 1; else return itself."""
        if self.code != Code.OK:
            name = Code(self.code).name.lower().replace("_", " ") if self.code in set(Code) else "code"
            raise RobotRefusedError(
                f"the robot refused {self.name} ({name}, {self.code}): {self.text or 'no reason given'}", self.text
            )
        return self


class Exchange:
    """Requests over a connection, each with its own identifier. `capabilities`: those the robot announced; empty for a
    robot of the 2013 convention. Every call raises LinkError if no answer comes in time."""

    def __init__(self, connection: SharedConnection) -> None:
        self.connection = connection
        self.capabilities: frozenset[str] = frozenset()
        self._numbers = count(1)

    @property
    def knows_ours(self) -> bool:
        """Whether the robot knows our extensions of the 2013 convention."""
        return bool(self.capabilities)

    def introduce(self, heartbeat: bool, streams: bool) -> None:
        """Query the robot's capabilities and announce ours. A robot of the 2013 convention does not answer this; it
        answers the status query that follows."""
        with self.connection.mailbox() as mail:
            self.connection.send(Get("CAPABILITY"), "")
            self.connection.send(String(contract.CURRENT_STATUS), contract.CURRENT_STATUS)
            answer = mail.until(lambda m: isinstance(m.body, (Capability, Status)), ACK_S)
            if answer is None or not isinstance(answer.body, Capability):
                return
            self.capabilities = frozenset(answer.body.types)
            mine = {contract.HAS_TELEMETRY: streams, contract.HAS_HEARTBEAT: heartbeat}
            # A client that announces drilling drills by DRILL only: a stray MOVE_TO_TARGET at the bone is then refused.
            announced = (*_UNDERSTOOD, contract.HAS_DRILLING, *(name for name, wanted in mine.items() if wanted))
            self.connection.send(Capability(announced), "", version=2)
            mail.until(lambda m: isinstance(m.body, Capability), ACK_S)

    def next_number(self) -> str:
        """Return an identifier that was not used before."""
        return str(next(self._numbers))

    def command(self, name: str, timeout_s: float = STATUS_S) -> RequestResult:
        """Send a phase or an activity by its name, wait for its acknowledgement, and return how it ended."""
        return self.command_over(self.connection, name, ACK_S, timeout_s)

    def command_over(self, connection: SharedConnection, name: str, ack_s: float, timeout_s: float) -> RequestResult:
        """As `command`, over another connection to this robot, acknowledged within `ack_s`."""
        number = self.next_number()
        with connection.mailbox() as mail:
            connection.send(String(name), contract.COMMAND + number)
            mail.need(lambda m: m.device_name == contract.ACKNOWLEDGED + number, ack_s, f"ACK of {name}")
            return self._outcome(mail, name, timeout_s)

    def send_pose(
        self,
        mail: Mailbox,
        prefix: str,
        matrix: np.ndarray,
        name: str,
        *,
        metadata: Mapping[str, str] | None = None,
        imaged_s: float | None = None,
    ) -> tuple[RequestResult, Message]:
        """Send a registration or a target (4, 4), wait for its echo and STATUS, and return (result, echo)."""
        number = self.next_number()
        self.connection.send(Transform(matrix), prefix + number, metadata=metadata, imaged_s=imaged_s)
        echo = mail.need(lambda m: m.device_name == contract.ACKNOWLEDGED + number, ACK_S, f"ACK of {name}")
        return self._outcome(mail, name, STATUS_S), echo

    def order(self, name: str, text: str) -> str:
        """Send a COMMAND and return the text of its reply. Raises RobotRefusedError if it was refused."""
        number = next(self._numbers)
        with self.connection.mailbox() as mail:
            self.connection.send(Command(number, name, text), name, version=2)
            answer = mail.need(lambda m: isinstance(m.body, CommandReply) and m.body.command_id == number, ACK_S, name)
        assert isinstance(answer.body, CommandReply)  # noqa: S101
        if answer.body.error:
            raise RobotRefusedError(f"the robot refused {name}: {answer.body.text}", answer.body.text)
        return answer.body.text

    def ask(self, body: Body, name: str, answers: Callable[[Message], bool]) -> Message:
        """Send a query and return its answer."""
        return self.connection.ask(body, name, answers, name, marked=self.knows_ours)

    def status(self) -> Status:
        """Query the robot's phase (`error_name`), with activity, fault and late cycles in the text."""
        body = self.ask(String(contract.CURRENT_STATUS), contract.CURRENT_STATUS, self.answers_status).body
        assert isinstance(body, Status)  # noqa: S101
        return body

    def answers_status(self, message: Message) -> bool:
        """Return whether a message answers the status query. The answer is named after the phase; our robots repeat the
        phase in `error_name`, which distinguishes the answer from the end of a command."""
        body = message.body
        if not isinstance(body, Status) or message.device_name == contract.CURRENT_STATUS:
            return False
        return not self.knows_ours or body.error_name == message.device_name

    def _outcome(self, mail: Mailbox, name: str, timeout_s: float) -> RequestResult:
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
        return RequestResult(name, body.code, body.text)


def pose_of(message: Message) -> RigidTransform:
    """Return the pose in a TRANSFORM. Raises RobotRefusedError if the message is not a pose."""
    body = message.body
    fault = body.fault if isinstance(body, Transform) else f"it is a {message.type_name}"
    if not isinstance(body, Transform) or fault is not None:
        raise RobotRefusedError(f"the robot's {message.device_name} is not a pose: {fault}")
    return body.rigid()


def number_of(message: Message) -> float:
    """Return the finite number in a SENSOR. Raises RobotRefusedError if the message is not one number."""
    body = message.body
    if not isinstance(body, Sensor) or body.values.shape != (1,) or not np.isfinite(body.values).all():
        raise RobotRefusedError(f"the robot's {message.device_name} is not a SENSOR of one finite number")
    return float(body.values[0])


def matrix_of(echo: Message) -> np.ndarray:
    """Return the matrix (4, 4) of an echo. Raises RobotRefusedError if it is not a TRANSFORM."""
    if not isinstance(echo.body, Transform):
        raise RobotRefusedError(f"the robot acknowledged a TRANSFORM by a {echo.type_name}")
    return echo.body.matrix


def stop_robot(host: str, port: int) -> RequestResult:
    """Stop a robot, whoever commands it. The first message is the STOP, which has a place however many clients there
    are; another client may take that place before the STOP arrives. Raises LinkError if no connection is answered."""
    end_s = monotonic() + ACK_S
    while True:
        try:
            with closing(SharedConnection(host, port)) as connection:
                return Exchange(connection).command(Trigger.STOP.value)
        except LinkError as error:
            if monotonic() > end_s:
                text = f"use the red button: the robot did not confirm that it stopped: {error}"
                raise LinkError(text) from error
        sleep(STOP_ACK_S)


class StopChannel:
    """Stop channel to the robot at `host`:`port`. `exchange`: requests over the client's main connection."""

    def __init__(self, host: str, port: int, exchange: Exchange) -> None:
        self._host, self._port, self._exchange = host, port, exchange
        self._one_at_a_time, self._ended = Lock(), Event()
        self._own: SharedConnection | None = None

    def keep_connection(self) -> None:
        """Open a connection for stops and keep it open from now on. While there is none, stops use the main one."""
        self._connect()
        Thread(target=self._keep, name="stop connection", daemon=True).start()

    def close(self) -> None:
        """Close both connections."""
        self._ended.set()
        self._exchange.connection.close()
        own = self._own
        if own is not None:
            own.close()

    def send(self, name: str) -> RequestResult:
        """Send STOP or EMERGENCY and return its result; concurrent calls run one after the other. Any thread.

        Raises LinkError if no connection answers; both are then closed."""
        with self._one_at_a_time:
            for connection, ack_s in ((self._own, STOP_ACK_S), (self._exchange.connection, ACK_S)):
                with suppress(LinkError):
                    if connection is not None:
                        return self._exchange.command_over(connection, name, ack_s, STATUS_S)
            self.close()
        raise LinkError(
            f"use the red button: the robot answers no {name} on any connection. All are closed now, which stops a "
            "robot that keeps the contract"
        )

    def _connect(self) -> None:
        with suppress(LinkError):
            self._own = SharedConnection(self._host, self._port)

    def _keep(self) -> None:
        """Probe the connection and reopen it when it is dead, because an idle connection can die unnoticed."""
        while not self._ended.wait(PROBE_S):
            own = self._own
            if own is None:
                self._connect()
                continue
            try:
                own.ask(
                    String(contract.CURRENT_STATUS),
                    contract.CURRENT_STATUS,
                    self._exchange.answers_status,
                    "",
                    marked=False,
                )
            except LinkError:
                own.close()
                self._own = None
        if self._own is not None:
            self._own.close()
