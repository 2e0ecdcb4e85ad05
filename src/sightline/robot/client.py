"""Navigation's side of the link, blocking and simple: one call for each step, each answered or an error in time."""

import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from types import TracebackType
from typing import Self

import numpy as np
from scipy.spatial.transform import RigidTransform

from sightline.errors import LinkError, RobotRefusedError
from sightline.robot import contract
from sightline.robot.contract import ACK_S, STATUS_S, Code
from sightline.robot.depth import SHOT_SD_MM
from sightline.robot.igtl import (
    Capability,
    Command,
    CommandReply,
    Get,
    Message,
    NDArray,
    Rejected,
    Status,
    String,
    Transform,
    timestamp_of,
)
from sightline.robot.igtl.kinds import Body
from sightline.robot.simulated import SimulatedWire
from sightline.robot.states import Cause
from sightline.robot.target import RobotTarget
from sightline.robot.transport import LOOPBACK, PORT, BlockingClient

CAPABILITY_S = (
    0.3  # a robot that answers no question for its CAPABILITY by then follows the old convention alone [ours]
)
MOTION_S = 300.0  # the longest motion: 250 mm at 1 mm/s, and some [calc]
# Robots of 2013 send no STATUS for these; what they do send says that the phase was entered.
_ENTERED_IS_DONE = (Cause.PLANNING.value, Cause.CALIBRATION.value)


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


_UNDERSTOOD = ("STRING", "STATUS", "TRANSFORM", "CAPABILITY", "RTS_COMMAND", "NDARRAY", "SENSOR")


class RobotClient:
    """A robot behind `host`:`port`: ours, or one of the old convention, which is told apart by its CAPABILITY.

    Every call raises LinkError where an answer does not come in time or the connection is lost, RobotRefusedError with
    the robot's reason where it refuses. Heartbeats go out while a call waits, so that a program that hangs stops the
    robot. `latest` holds the newest message of each device name, and `listeners` are told of every one. One thread;
    `stop` and `emergency` may be called from any other, and have a connection of their own.
    """

    def __init__(self, host: str = LOOPBACK, port: int = PORT, *, heartbeat: bool = True, streams: bool = True) -> None:
        self.latest: dict[str, Message] = {}
        self.listeners: list[Callable[[Message], None]] = []  # each hears every message, in order
        self.capabilities: frozenset[str] = frozenset()
        self.host, self.port = host, port
        self._number = 0
        self._beats, self._beat_s = False, -np.inf
        self._main = BlockingClient(host, port)
        self._stopper: BlockingClient | None = None
        try:
            self._ask_capabilities(heartbeat, streams)
            if contract.HAS_HEARTBEAT in self.capabilities:
                self._stopper = BlockingClient(host, port)
        except LinkError:
            self.close()
            raise
        self._beats = heartbeat and contract.HAS_HEARTBEAT in self.capabilities

    def close(self) -> None:
        """End it. A robot of ours that holds this client's lease stops and forgets what it was told."""
        self._main.close()
        if self._stopper is not None:
            self._stopper.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    @property
    def simulated(self) -> bool:
        """Whether the robot says that it is a simulator."""
        return contract.IS_SIMULATED in self.capabilities

    # The steps of an insertion.

    def start_up(self) -> None:
        """Begin; what the robot knew before is forgotten."""
        self.command(Cause.START_UP.value).refuse_unless_ok()

    def plan(self) -> None:
        """Say that a plan is being made."""
        self.command(Cause.PLANNING.value).refuse_unless_ok()

    def calibrate(self, T_mcs_cfcs: RigidTransform, imaged_s: float | None = None) -> None:
        """Send the registration. `imaged_s`: when its last image was taken, by the clock that targets are timed by."""
        self.command(Cause.CALIBRATION.value).refuse_unless_ok()
        self.send_transform(contract.CALIBRATION, T_mcs_cfcs.inv(), "CALIBRATION", imaged_s=imaged_s).refuse_unless_ok()

    def aim(
        self,
        T_cfcs_wire: RigidTransform,
        metadata: Mapping[str, str] | None = None,
        imaged_s: float | None = None,
    ) -> RigidTransform:
        """Send a target: the wire's pose at the end point. What the robot can reach of it, CFCS."""
        self.command(Cause.TARGETING.value).refuse_unless_ok()
        self.latest.pop("REACHABLE_TARGET", None)
        self.send_transform(contract.TARGET, T_cfcs_wire, "TARGET", metadata, imaged_s).refuse_unless_ok()
        reached = self._await(lambda message: _is(message, Transform, "REACHABLE_TARGET"), STATUS_S, "REACHABLE_TARGET")
        return _pose(reached)

    def aim_plan(self, target: RobotTarget, now_s: float, depth_limit_mm: float) -> RigidTransform:
        """Send a planned target with its identity; refused here already where its checks failed or it has expired.
        Robots of the old convention get the bare pose."""
        target.refuse_unfit(now_s)
        imaged_s = target.registration.imaged_s
        if contract.HAS_PLAN not in self.capabilities:
            return self.aim(target.T_cfcs_wire, imaged_s=imaged_s)
        return self.aim(target.T_cfcs_wire, plan_metadata(target, now_s, depth_limit_mm), imaged_s)

    def align(self) -> None:
        """Move to the aligned pose and wait there for the confirmation shot."""
        self.command(Cause.MOVE_TO_TARGET.value, MOTION_S).refuse_unless_ok()

    def drill(self) -> str:
        """Confirm, and drill: up to the pause before the tip, the next time to the tip. Where it ended: PAUSED or
        DONE; a robot of the old convention may say nothing of it."""
        return self._go_on(Cause.DRILL.value)

    def guide(self) -> None:
        """Hold the guide stiff; a person drills."""
        self.command(Cause.GUIDE.value).refuse_unless_ok()

    def retract(self) -> None:
        """Draw the wire, or the open chuck, back into its sleeve."""
        self._go_on(Cause.RETRACT.value)

    def stop(self) -> Said:
        """Stop, whatever goes on; on a connection of its own where the robot takes several. Any thread."""
        return self._stop(Cause.STOP.value)

    def emergency(self) -> Said:
        """Stop, and wait for a person at the robot. Any thread."""
        return self._stop(Cause.EMERGENCY.value)

    # Questions.

    def status(self) -> Status:
        """The robot's phase (`error_name`), with activity, fault and late cycles in the text."""
        self._send(String(contract.CURRENT_STATUS), contract.CURRENT_STATUS)
        body = self._await(self._answers_status, STATUS_S, contract.CURRENT_STATUS).body
        assert isinstance(body, Status)  # noqa: S101
        return body

    def position(self) -> RigidTransform:
        """The wire's pose, CFCS. Raises RobotRefusedError where no registration was sent yet."""
        self._send(String(contract.CURRENT_POSITION), contract.CURRENT_POSITION)
        said = self._await(
            lambda m: m.device_name == contract.CURRENT_POSITION and isinstance(m.body, (Transform, Status)),
            STATUS_S,
            contract.CURRENT_POSITION,
        )
        if isinstance(said.body, Status):
            Said(contract.CURRENT_POSITION, said.body.code, said.body.text).refuse_unless_ok()
        return _pose(said)

    def joints(self) -> np.ndarray:
        """(6, N): position, velocity, wanted position, commanded velocity, lower and upper limits; mm, rad."""
        self._send(Get("NDARRAY"), contract.MEASURED_JS)
        body = self.stream(contract.MEASURED_JS).body
        if not (isinstance(body, NDArray) and body.values.ndim == 2 and len(body.values) == 6):
            raise LinkError(f"the robot's {contract.MEASURED_JS} is no array (6, N)")
        return body.values

    def stream(self, name: str, timeout_s: float = STATUS_S) -> Message:
        """The next message of a stream."""
        return self._await(lambda message: message.device_name == name, timeout_s, name)

    def reset(self, fault: int) -> None:
        """Reset the robot after a fault that a person has read and seen to, by its number."""
        self._order(contract.RESET, str(fault))

    def shot_depth(self, depth_mm: float, sd_mm: float = SHOT_SD_MM) -> None:
        """Tell the robot, in PAUSED, how far beyond the entry point the second shot shows the tip, give or take."""
        self._order(contract.SHOT_DEPTH, f"{float(depth_mm)!r} {float(sd_mm)!r}")

    def simulated_wire(self) -> SimulatedWire:
        """Where a simulated robot's wire truly is, for simulated images. Raises RobotRefusedError of a real robot."""
        return SimulatedWire.of(self._order(contract.SIMULATED_WIRE, ""))

    def _order(self, name: str, text: str) -> str:
        """A COMMAND and the text of its reply."""
        self._number += 1
        number = self._number
        self._send(Command(number, name, text), name, version=2)
        said = self._await(lambda m: isinstance(m.body, CommandReply) and m.body.command_id == number, ACK_S, name).body
        assert isinstance(said, CommandReply)  # noqa: S101
        if said.error:
            raise RobotRefusedError(f"the robot refused {name}: {said.text}")
        return said.text

    # How anything is asked.

    def command(self, name: str, timeout_s: float = STATUS_S) -> Said:
        """Send a phase or an activity by its name, and wait for its acknowledgement, then for how it ended."""
        number = self._next_number()
        self._send(String(name), contract.COMMAND + number)
        self._acknowledged(self._main_hears, number, name)
        return self._ended(self._main_hears, name, timeout_s)

    def send_transform(
        self,
        kind: str,
        pose: RigidTransform | np.ndarray,
        name: str,
        metadata: Mapping[str, str] | None = None,
        imaged_s: float | None = None,
    ) -> Said:
        """Send a registration or a target, a pose or a matrix (4, 4), and wait for its echo and status."""
        number = self._next_number()
        matrix = pose.as_matrix() if isinstance(pose, RigidTransform) else pose
        self._send(Transform(matrix), kind + number, metadata=metadata or {}, imaged_s=imaged_s)
        self._acknowledged(self._main_hears, number, name)
        return self._ended(self._main_hears, name, STATUS_S)

    def _go_on(self, name: str) -> str:
        """The next step by its own name, or as the old convention has it."""
        if contract.HAS_DRILLING not in self.capabilities:
            name = Cause.MOVE_TO_TARGET.value
        return self.command(name, MOTION_S).refuse_unless_ok().text

    def _stop(self, name: str) -> Said:
        if self._stopper is None:
            return self.command(name)
        stopper = self._stopper
        number = f"S{time.monotonic_ns() % 10**9}"
        stopper.send(Message(String(name), contract.COMMAND + number))

        def hears(timeout_s: float) -> Message | None:
            return _readable(stopper.receive(timeout_s))

        self._acknowledged(hears, number, name)
        return self._ended(hears, name, STATUS_S)

    def _ask_capabilities(self, heartbeat: bool, streams: bool) -> None:
        self._send(Get("CAPABILITY"), "")
        with suppress(_LateError):
            said = self._await(lambda message: isinstance(message.body, Capability), CAPABILITY_S, "CAPABILITY").body
            self.capabilities = frozenset(said.types) if isinstance(said, Capability) else frozenset()
        if self.capabilities:
            mine = {contract.HAS_TELEMETRY: streams, contract.HAS_HEARTBEAT: heartbeat}
            said = (*_UNDERSTOOD, *(name for name, wanted in mine.items() if wanted))
            self._send(Capability(said), "", version=2)

    def _answers_status(self, message: Message) -> bool:
        """Named after the phase; ours says it twice, which tells the answer from how something ended."""
        body = message.body
        if not isinstance(body, Status) or message.device_name == contract.CURRENT_STATUS:
            return False
        return not self.capabilities or body.error_name == message.device_name

    def _acknowledged(self, hears: "_Hears", number: str, name: str) -> None:
        _wait(hears, lambda message: message.device_name == contract.ACKNOWLEDGED + number, ACK_S, f"ACK of {name}")

    def _ended(self, hears: "_Hears", name: str, timeout_s: float) -> Said:
        entered = name in _ENTERED_IS_DONE and not self.capabilities

        def ends(message: Message) -> bool:
            body = message.body
            if not isinstance(body, Status):
                return False
            return message.device_name == name or (
                entered and message.device_name == contract.CURRENT_STATUS and body.error_name == name
            )

        body = _wait(hears, ends, timeout_s, f"STATUS {name}").body
        assert isinstance(body, Status)  # noqa: S101
        return Said(name, body.code, body.text)

    def _await(self, wanted: Callable[[Message], bool], timeout_s: float, what: str) -> Message:
        return _wait(self._main_hears, wanted, timeout_s, what)

    def _main_hears(self, timeout_s: float) -> Message | None:
        """The next message, heartbeats sent meanwhile."""
        self._beat()
        message = _readable(self._main.receive(min(timeout_s, contract.HEARTBEAT_S)))
        if message is not None:
            self.latest[message.device_name] = message
            for listener in self.listeners:
                listener(message)
        return message

    def _beat(self) -> None:
        now = time.monotonic()
        if self._beats and now - self._beat_s >= contract.HEARTBEAT_S:
            self._beat_s = now
            self._send(String(""), contract.HEARTBEAT)

    def _send(
        self,
        body: Body,
        name: str,
        *,
        version: int = 1,
        metadata: Mapping[str, str] | None = None,
        imaged_s: float | None = None,
    ) -> None:
        timestamp = 0 if imaged_s is None else timestamp_of(imaged_s)
        version = 2 if metadata else version
        self._main.send(Message(body, name, timestamp, version, metadata=metadata or {}))

    def _next_number(self) -> str:
        self._number += 1
        return str(self._number)


def plan_metadata(target: RobotTarget, now_s: float, depth_limit_mm: float) -> dict[str, str]:
    """What a target of ours says beside its pose. `now_s` by the clock of `target.expires_s`: what travels is the time
    left, so that two clocks need not agree."""
    identity = target.identity
    return {
        contract.PLAN: identity.plan,
        contract.SIDE: identity.side,
        contract.FRAME_SERIAL: identity.frame_serial,
        contract.GO: contract.YES if identity.go else contract.NO,
        contract.UNITS: contract.MM,
        contract.COORDINATES: contract.CFCS,
        contract.LENGTH_MM: repr(target.length_mm),
        contract.DEPTH_LIMIT_MM: repr(depth_limit_mm),
        contract.VALID_S: repr(target.expires_s - now_s),
    }


_Hears = Callable[[float], Message | None]


class _LateError(LinkError):
    """An answer did not come in time."""


def _wait(hears: _Hears, wanted: Callable[[Message], bool], timeout_s: float, what: str) -> Message:
    end = time.monotonic() + timeout_s
    while (left := end - time.monotonic()) > 0:
        message = hears(left)
        if message is not None and wanted(message):
            return message
    raise _LateError(f"the robot sent no {what} within {timeout_s:g} s; check its state, and that it is a robot at all")


def _readable(event: object) -> Message | None:
    if isinstance(event, Rejected) and event.fatal:
        raise LinkError(f"the robot sends no OpenIGTLink: {event.reason}")
    return event if isinstance(event, Message) else None


def _is(message: Message, kind: type, name: str) -> bool:
    return message.device_name == name and isinstance(message.body, kind)


def _pose(message: Message) -> RigidTransform:
    assert isinstance(message.body, Transform)  # noqa: S101
    return message.body.rigid()
