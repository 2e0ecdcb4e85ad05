"""Navigation's end of the link: a blocking client with one call per step; each call returns or raises in time."""

import math
from collections.abc import Generator, Mapping
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import RigidTransform

from sightline.common.closing import Closing
from sightline.errors import LinkError, RobotRefusedError
from sightline.robot import contract
from sightline.robot.contract import ACK_S, STATUS_S
from sightline.robot.control.insertion import BARE_LENGTH_MM
from sightline.robot.control.states import State, Trigger
from sightline.robot.igtl import Get, Message, NDArray, Sensor, Status, String, Transform
from sightline.robot.kinematics.target import CONTACT_WEIGHT, MAX_ZERO_SHIFT_MM, SHOT_SD_MM, RobotTarget
from sightline.robot.link.exchange import (
    Exchange,
    RequestResult,
    StopChannel,
    WireDeviation,
    matrix_of,
    number_of,
    pose_of,
    refuse_other_pose,
)
from sightline.robot.link.record import SimulatedWire
from sightline.robot.link.shared_connection import LateError, SharedConnection
from sightline.robot.transport import LOOPBACK, PORT

MOTION_S = 300.0  # time limit of the longest motion, 250 mm at 1 mm/s, with a margin [calc]


class RobotClient(Exchange, Closing):
    """Client of the robot at `host`:`port`: ours, or one of the 2013 convention, distinguished by its CAPABILITY.

    Every call raises LinkError if no answer comes in time or the connection is lost, and RobotRefusedError with the
    robot's reason if it refuses. While a call waits, a separate process sends heartbeats; if a call hangs for a second
    they end, and the robot stops. Without `heartbeat` a robot does not drill for this client. `latest` holds the newest
    message of each device name; `listeners` are called with every message. `open_hole_mm`: depth of the target's hole
    where it was begun before, else None. Use one thread; only `stop` and `emergency` may be called from others. They
    have a connection of their own and fall back to the main one.
    """

    def __init__(self, host: str = LOOPBACK, port: int = PORT, *, heartbeat: bool = True, streams: bool = True) -> None:
        self.host, self.port = host, port
        self._target: RigidTransform | None = None
        self._length_mm: float | None = None
        self.open_hole_mm: float | None = None
        self._beyond_mm = self._zero_shift_mm = 0.0  # the latter: of the robot's zero of depth, at most
        self._doubts: dict[str, str] = {}  # "registration" or "target": why the robot may not move by it
        super().__init__(SharedConnection(host, port))
        self.latest, self.listeners = self.connection.latest, self.connection.listeners
        self._stopping = StopChannel(host, port, self)
        try:
            self.introduce(heartbeat, streams)
        except LinkError:
            self.close()
            raise
        if self.knows_ours:
            self._stopping.keep_connection()
        if heartbeat and contract.HAS_HEARTBEAT in self.capabilities:
            self.connection.keep_alive()

    def close(self) -> None:
        """Close all connections. A robot of ours whose lease this client holds stops and clears its registration and
        target."""
        self._stopping.close()

    @property
    def simulated(self) -> bool:
        """Whether the robot announces that it is a simulator."""
        return contract.IS_SIMULATED in self.capabilities

    # The steps of an insertion.

    def start_up(self) -> None:
        """Start up; the robot clears its registration and target."""
        self.command(Trigger.START_UP.value).refuse_unless_ok()

    def plan(self) -> None:
        """Tell the robot that a plan is being made."""
        self.command(Trigger.PLANNING.value).refuse_unless_ok()

    def calibrate(self, T_mcs_cfcs: RigidTransform, imaged_s: float | None = None) -> None:
        """Send the registration. `imaged_s`: time of its last image, on the same clock as targets.

        Raises RobotRefusedError also if the robot acknowledges another registration than was sent; motion commands are
        then refused here."""
        self.command(Trigger.CALIBRATION.value).refuse_unless_ok()
        sent = T_mcs_cfcs.inv().as_matrix()
        with self.connection.mailbox() as mail:
            answer, echo = self.send_pose(mail, contract.CALIBRATION, sent, "CALIBRATION", imaged_s=imaged_s)
        answer.refuse_unless_ok()
        with self._verified("registration"):
            refuse_other_pose(matrix_of(echo), sent, "registration")

    def aim(
        self,
        T_cfcs_wire: RigidTransform,
        metadata: Mapping[str, str] | None = None,
        imaged_s: float | None = None,
    ) -> RigidTransform:
        """Send a target, the wire's pose at the end point. Returns the pose that the robot will reach, CFCS; for a
        robot of the 2013 convention that does not report it, the acknowledged target.

        Raises RobotRefusedError also if the robot acknowledges another target, or would put the wire elsewhere; motion
        commands are then refused here."""
        self._target = self.open_hole_mm = None
        self.latest.pop(contract.OPEN_HOLE_DEPTH, None)
        self.command(Trigger.TARGETING.value).refuse_unless_ok()
        with self.connection.mailbox() as mail:
            answer, echo = self.send_pose(
                mail, contract.TARGET, T_cfcs_wire.as_matrix(), "TARGET", metadata=metadata, imaged_s=imaged_s
            )
            answer.refuse_unless_ok()
            reachable = mail.until(
                lambda m: m.device_name == "REACHABLE_TARGET", STATUS_S if self.knows_ours else ACK_S
            )
        if reachable is None and self.knows_ours:
            raise LateError(f"the robot sent no REACHABLE_TARGET within {STATUS_S:g} s; it does not keep the contract")
        with self._verified("target"):
            refuse_other_pose(matrix_of(echo), T_cfcs_wire.as_matrix(), "target")
            reached = pose_of(reachable or echo)
            WireDeviation.of(reached, T_cfcs_wire).refuse_large("the robot would lay the wire")
            if (hole := self.latest.get(contract.OPEN_HOLE_DEPTH)) is not None:  # comes before REACHABLE_TARGET
                self.open_hole_mm = number_of(hole)
        self._target = T_cfcs_wire
        said_mm = {} if metadata is None else metadata
        self._length_mm = float(said_mm[contract.LENGTH_MM]) if contract.LENGTH_MM in said_mm else None
        self._beyond_mm = float(said_mm.get(contract.BEYOND_MM, 0.0))
        # A drill through something before the bone, or beyond its end, is not corrected by contact.
        by_contact = self._beyond_mm == float(said_mm.get(contract.BEFORE_MM, 0.0)) == 0.0
        self._zero_shift_mm = CONTACT_WEIGHT * MAX_ZERO_SHIFT_MM * by_contact
        if self.open_hole_mm is not None:
            self._zero_shift_mm = MAX_ZERO_SHIFT_MM  # its zero holds on, which a shot may have moved
        return reached

    def aim_plan(self, target: RobotTarget, now_s: float, depth_limit_mm: float) -> RigidTransform:
        """Send a planned target with its identity, and return the pose that the robot will reach, CFCS. Raises
        RobotRefusedError before sending if its checks failed or it has expired. Robots of the 2013 convention get the
        bare pose."""
        target.refuse_unfit(now_s)
        imaged_s = target.registration.imaged_s
        if contract.HAS_PLAN not in self.capabilities:
            return self.aim(target.T_cfcs_wire, imaged_s=imaged_s)
        return self.aim(target.T_cfcs_wire, plan_metadata(target, now_s, depth_limit_mm), imaged_s)

    def align(self) -> None:
        """Move to the aligned pose and wait there for the confirmation shot. A robot of the 2013 convention goes to the
        target itself; its position is then compared with the plan, as after `drill`.

        Raises RobotRefusedError also if the wire, by the robot's own position, is off its line or beyond the entry
        point."""
        self._refuse_doubted()
        self.command(Trigger.MOVE_TO_TARGET.value, MOTION_S).refuse_unless_ok()
        if contract.HAS_DRILLING not in self.capabilities:
            self.wire_deviation()
        else:
            self._refuse_beyond(self._length_mm or BARE_LENGTH_MM, "from the entry point, the aligned wire lies")

    def drill(self) -> str:
        """Confirm and drill: first to the pause before the end point, then to the end point. Returns the state at the
        end, PAUSED or DONE; a robot of the 2013 convention may return nothing.

        Raises RobotRefusedError also if the wire, by the robot's own position, does not end where planned."""
        self._refuse_doubted()
        where = self._go_on(Trigger.DRILL.value)
        if where == State.DONE.value or contract.HAS_DRILLING not in self.capabilities:
            self.wire_deviation()
        else:
            self._refuse_beyond(0.0, "at the pause the wire lies")
        return where

    def guide(self) -> None:
        """Hold the guide in place while a person drills."""
        self._refuse_doubted()
        self.command(Trigger.GUIDE.value).refuse_unless_ok()

    def retract(self) -> None:
        """Retract the wire, or the open chuck, into its sleeve."""
        self._go_on(Trigger.RETRACT.value)

    def stop(self) -> RequestResult:
        """Stop any motion, over a separate connection if the robot accepts several. Any thread."""
        return self._stopping.send(Trigger.STOP.value)

    def emergency(self) -> RequestResult:
        """Stop and enter EMERGENCY until a person resets the robot. Any thread."""
        return self._stopping.send(Trigger.EMERGENCY.value)

    # Queries.

    def position(self) -> RigidTransform:
        """Return the wire's pose, CFCS. Raises RobotRefusedError if no registration was sent yet, or if the robot's
        answer is not a pose."""
        answer = self.ask(
            String(contract.CURRENT_POSITION),
            contract.CURRENT_POSITION,
            lambda m: m.device_name == contract.CURRENT_POSITION and isinstance(m.body, (Transform, Status)),
        )
        if isinstance(answer.body, Status):
            RequestResult(contract.CURRENT_POSITION, answer.body.code, answer.body.text).refuse_unless_ok()
        return pose_of(answer)

    def wire_deviation(self) -> WireDeviation:
        """Return the wire's deviation from the target, by the robot's own position. Raises RobotRefusedError if it
        exceeds 0.5 mm or 0.2°. Along the wire the robot's stated depth counts, if any, because contact and check shot
        move its zero, by no more than either can; past the end point a break-through may end drilling early."""
        if self._target is None:
            raise RobotRefusedError("send a target first: there is none to compare the wire with")
        deviation = WireDeviation.of(self.position(), self._target)
        depth = self.latest.get(contract.DEPTH)
        if self._length_mm is None or depth is None or not isinstance(depth.body, Sensor):
            deviation.refuse_large("the wire lies")
        else:
            depth_off_mm = float(depth.body.values[0]) - self._length_mm
            short_mm = min(max(-depth_off_mm, 0.0), self._beyond_mm)
            ended = replace(deviation, along_mm=deviation.along_mm + short_mm)
            ended.refuse_large("the wire lies", depth_off_mm + short_mm, self._zero_shift_mm)
        return deviation

    def joints(self) -> np.ndarray:
        """Return (6, N): position, velocity, commanded position, commanded velocity, lower and upper limit; mm, rad."""
        answer = self.ask(Get("NDARRAY"), contract.MEASURED_JS, lambda m: m.device_name == contract.MEASURED_JS)
        body = answer.body
        if not (isinstance(body, NDArray) and body.values.ndim == 2 and len(body.values) == 6):
            raise LinkError(f"the robot's {contract.MEASURED_JS} is not an array (6, N)")
        return body.values

    def stream(self, name: str, timeout_s: float = STATUS_S) -> Message:
        """Return the next message of a stream."""
        with self.connection.mailbox() as mail:
            return mail.need(lambda message: message.device_name == name, timeout_s, name)

    def reset(self, fault: int) -> None:
        """Reset the robot after the fault of this number, which a person has read and dealt with."""
        self.order(contract.RESET, str(fault))

    def shot_depth(self, depth_mm: float, sd_mm: float = SHOT_SD_MM) -> None:
        """Send, in PAUSED, the depth of the tip beyond the entry point in the check shot, and its standard
        deviation."""
        self.order(contract.SHOT_DEPTH, f"{float(depth_mm)!r} {float(sd_mm)!r}")
        self._zero_shift_mm = MAX_ZERO_SHIFT_MM

    def simulated_wire(self) -> SimulatedWire:
        """Return the true pose of a simulated robot's wire, for simulated images. Raises RobotRefusedError from a real
        robot."""
        return SimulatedWire.of(self.order(contract.SIMULATED_WIRE, ""))

    def _refuse_beyond(self, before_mm: float, what: str) -> None:
        """Raise RobotRefusedError if the wire is off its line, or its tip beyond a point `before_mm` before the end."""
        if self._target is not None:
            off = WireDeviation.of(self.position(), self._target)
            replace(off, along_mm=max(off.along_mm + before_mm, 0.0)).refuse_large(what)

    def _go_on(self, name: str) -> str:
        """Send the next step by its own name, or as MOVE_TO_TARGET of the 2013 convention. Returns the text at its
        end."""
        if contract.HAS_DRILLING not in self.capabilities:
            name = Trigger.MOVE_TO_TARGET.value
        return self.command(name, MOTION_S).refuse_unless_ok().text

    # Verification of what the robot acknowledges.

    @contextmanager
    def _verified(self, what: str) -> Generator[None]:
        """Remember a refusal that the block raises, so that nothing moves until `what` was sent again."""
        self._doubts.pop(what, None)
        try:
            yield
        except RobotRefusedError as error:
            self._doubts[what] = str(error)
            raise

    def _refuse_doubted(self) -> None:
        for why in self._doubts.values():
            raise RobotRefusedError(f"nothing may move: {why}")


def plan_metadata(target: RobotTarget, now_s: float, depth_limit_mm: float) -> dict[str, str]:
    """Return the metadata of a target. `now_s` is on the clock of `target.expires_s`: the remaining time is sent, so
    that the two clocks need not agree."""
    identity, limits = target.identity, target.limits
    return {
        contract.PLAN: identity.plan,
        contract.SIDE: identity.side,
        contract.FRAME_SERIAL: identity.frame_serial,
        contract.GO: contract.YES if identity.go else contract.NO,
        contract.UNITS: contract.MM,
        contract.COORDINATES: contract.CFCS,
        contract.LENGTH_MM: repr(target.depth_mm),
        contract.DEPTH_LIMIT_MM: repr(depth_limit_mm),
        contract.VALID_S: repr(target.expires_s - now_s),
        contract.FRAME: identity.frame,
        contract.KIND: identity.kind,
        contract.POSITION_LIMIT_MM: repr(limits.position_mm),
        contract.DIRECTION_LIMIT_DEG: repr(math.degrees(limits.direction_rad)),
        contract.BEYOND_MM: repr(limits.beyond_mm),
        contract.BEFORE_MM: repr(limits.before_mm),
    }
