"""Navigation's side of the link, blocking and simple: one call for each step, each answered or an error in time."""

import math
from collections.abc import Generator, Mapping
from contextlib import contextmanager

import numpy as np
from scipy.spatial.transform import RigidTransform

from sightline.closing import Closing
from sightline.errors import LinkError, RobotRefusedError
from sightline.robot import contract
from sightline.robot.contract import ACK_S, STATUS_S
from sightline.robot.control.motion.depth import LIMIT_MM as ZERO_LIMIT_MM
from sightline.robot.control.motion.depth import SHOT_SD_MM
from sightline.robot.control.states import Cause, State
from sightline.robot.igtl import (
    Get,
    Message,
    NDArray,
    Sensor,
    Status,
    String,
    Transform,
)
from sightline.robot.kinematics.target import RobotTarget
from sightline.robot.link.exchange import Exchange, Said, matrix_of, pose_of
from sightline.robot.link.laid import Laid, refuse_other_pose
from sightline.robot.link.simulated import SimulatedWire
from sightline.robot.link.stopping import Stopping
from sightline.robot.link.talk import LateError, Talk
from sightline.robot.transport import LOOPBACK, PORT

MOTION_S = 300.0  # the longest motion: 250 mm at 1 mm/s, and some [calc]


class RobotClient(Closing):
    """A robot behind `host`:`port`: ours, or one of the old convention, which is told apart by its CAPABILITY.

    Every call raises LinkError where an answer does not come in time or the connection is lost, RobotRefusedError with
    the robot's reason where it refuses. While a call waits, heartbeats go out on a thread of their own; a call that
    hangs for a second sends no more, and the robot stops. `latest` holds the newest message of each device name, and
    `listeners` are told of every one; `talk` is the connection itself, `exchange` the requests over it. One thread;
    `stop` and `emergency` may be called from any other, have a connection of their own, and fall back to the main one.
    """

    def __init__(self, host: str = LOOPBACK, port: int = PORT, *, heartbeat: bool = True, streams: bool = True) -> None:
        self.host, self.port = host, port
        self._aimed: RigidTransform | None = None
        self._length_mm: float | None = None
        self._doubts: dict[str, str] = {}  # by what was sent: why nothing may move by it
        self.talk = Talk(host, port)
        self.latest, self.listeners = self.talk.latest, self.talk.listeners
        self.exchange = Exchange(self.talk)
        self._stopping = Stopping(host, port, self.talk, self.exchange)
        try:
            self.exchange.introduce(heartbeat, streams)
        except LinkError:
            self.close()
            raise
        if contract.HAS_HEARTBEAT in self.capabilities:
            self._stopping.keep_connection()
            if heartbeat:
                self.talk.keep_alive()

    def close(self) -> None:
        """End it. A robot of ours that holds this client's lease stops and forgets what it was told."""
        self._stopping.close()

    @property
    def capabilities(self) -> frozenset[str]:
        """What the robot announced; nothing where it is one of the old convention."""
        return self.exchange.capabilities

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
        """Send the registration. `imaged_s`: when its last image was taken, by the clock that targets are timed by.

        Raises RobotRefusedError also where the robot acknowledges another than was sent: then it is not told to
        move."""
        self.command(Cause.CALIBRATION.value).refuse_unless_ok()
        sent = T_mcs_cfcs.inv()
        with self.talk.mail() as mail:
            said, echo = self.exchange.transform(
                mail, contract.CALIBRATION, sent.as_matrix(), "CALIBRATION", imaged_s=imaged_s
            )
        said.refuse_unless_ok()
        with self._doubted("registration"):
            refuse_other_pose(matrix_of(echo), sent.as_matrix(), "registration")

    def aim(
        self,
        T_cfcs_wire: RigidTransform,
        metadata: Mapping[str, str] | None = None,
        imaged_s: float | None = None,
    ) -> RigidTransform:
        """Send a target: the wire's pose at the end point. What the robot can reach of it, CFCS; where a robot of the
        old convention does not say, the target as it acknowledged it.

        Raises RobotRefusedError also where the robot acknowledges another target, or would lay the wire elsewhere: then
        it is not told to move."""
        self._aimed = None
        self.command(Cause.TARGETING.value).refuse_unless_ok()
        with self.talk.mail() as mail:
            said, echo = self.exchange.transform(
                mail, contract.TARGET, T_cfcs_wire.as_matrix(), "TARGET", metadata=metadata, imaged_s=imaged_s
            )
            said.refuse_unless_ok()
            reachable = mail.until(
                lambda m: m.device_name == "REACHABLE_TARGET", STATUS_S if self.exchange.knows_ours else ACK_S
            )
        if reachable is None and self.exchange.knows_ours:
            raise LateError(f"the robot sent no REACHABLE_TARGET within {STATUS_S:g} s; it does not keep the contract")
        with self._doubted("target"):
            refuse_other_pose(matrix_of(echo), T_cfcs_wire.as_matrix(), "target")
            reached = pose_of(reachable or echo)
            Laid.of(reached, T_cfcs_wire).refuse_elsewhere("the robot would lay the wire")
        self._aimed = T_cfcs_wire
        self._length_mm = float(metadata[contract.LENGTH_MM]) if metadata and contract.LENGTH_MM in metadata else None
        return reached

    def aim_plan(self, target: RobotTarget, now_s: float, depth_limit_mm: float) -> RigidTransform:
        """Send a planned target with its identity; refused here already where its checks failed or it has expired.
        Robots of the old convention get the bare pose."""
        target.refuse_unfit(now_s)
        imaged_s = target.registration.imaged_s
        if contract.HAS_PLAN not in self.capabilities:
            return self.aim(target.T_cfcs_wire, imaged_s=imaged_s)
        return self.aim(target.T_cfcs_wire, plan_metadata(target, now_s, depth_limit_mm), imaged_s)

    def align(self) -> None:
        """Move to the aligned pose and wait there for the confirmation shot. A robot of the old convention goes to the
        target itself; then its own position is compared with the plan, as after `drill`."""
        self._refuse_doubted()
        self.command(Cause.MOVE_TO_TARGET.value, MOTION_S).refuse_unless_ok()
        if contract.HAS_DRILLING not in self.capabilities:
            self.laid()

    def drill(self) -> str:
        """Confirm, and drill: up to the pause before the tip, the next time to the tip. Where it ended: PAUSED or
        DONE; a robot of the old convention may say nothing of it.

        Raises RobotRefusedError also where the wire ends elsewhere than planned by the robot's own position."""
        self._refuse_doubted()
        where = self._go_on(Cause.DRILL.value)
        if where == State.DONE.value or contract.HAS_DRILLING not in self.capabilities:
            self.laid()
        return where

    def guide(self) -> None:
        """Hold the guide stiff; a person drills."""
        self._refuse_doubted()
        self.command(Cause.GUIDE.value).refuse_unless_ok()

    def retract(self) -> None:
        """Draw the wire, or the open chuck, back into its sleeve."""
        self._go_on(Cause.RETRACT.value)

    def stop(self) -> Said:
        """Stop, whatever goes on; on a connection of its own where the robot takes several. Any thread."""
        return self._stopping.send(Cause.STOP.value)

    def emergency(self) -> Said:
        """Stop, and wait for a person at the robot. Any thread."""
        return self._stopping.send(Cause.EMERGENCY.value)

    # Questions.

    def status(self) -> Status:
        """The robot's phase (`error_name`), with activity, fault and late cycles in the text."""
        return self.exchange.status()

    def position(self) -> RigidTransform:
        """The wire's pose, CFCS. Raises RobotRefusedError where no registration was sent yet, or the robot sends what
        is not a pose."""
        said = self.exchange.ask(
            String(contract.CURRENT_POSITION),
            contract.CURRENT_POSITION,
            lambda m: m.device_name == contract.CURRENT_POSITION and isinstance(m.body, (Transform, Status)),
        )
        if isinstance(said.body, Status):
            Said(contract.CURRENT_POSITION, said.body.code, said.body.text).refuse_unless_ok()
        return pose_of(said)

    def laid(self) -> Laid:
        """How the wire lies against the target, by the robot's own position. Raises RobotRefusedError where it is
        beyond 0.5 mm or 0.2°. Along the wire the robot's depth counts where it states one: contact and the second shot
        move its zero."""
        if self._aimed is None:
            raise RobotRefusedError("this client has sent no target to compare the wire with")
        laid = Laid.of(self.position(), self._aimed)
        depth = self.latest.get(contract.DEPTH)
        if self._length_mm is None or depth is None or not isinstance(depth.body, Sensor):
            laid.refuse_elsewhere("the wire lies")
        else:
            laid.refuse_elsewhere("the wire lies", float(depth.body.values[0]) - self._length_mm, ZERO_LIMIT_MM)
        return laid

    def joints(self) -> np.ndarray:
        """(6, N): position, velocity, wanted position, commanded velocity, lower and upper limits; mm, rad."""
        said = self.exchange.ask(Get("NDARRAY"), contract.MEASURED_JS, lambda m: m.device_name == contract.MEASURED_JS)
        body = said.body
        if not (isinstance(body, NDArray) and body.values.ndim == 2 and len(body.values) == 6):
            raise LinkError(f"the robot's {contract.MEASURED_JS} is not an array (6, N)")
        return body.values

    def stream(self, name: str, timeout_s: float = STATUS_S) -> Message:
        """The next message of a stream."""
        with self.talk.mail() as mail:
            return mail.need(lambda message: message.device_name == name, timeout_s, name)

    def reset(self, fault: int) -> None:
        """Reset the robot after a fault that a person has read and seen to, by its number."""
        self.exchange.order(contract.RESET, str(fault))

    def shot_depth(self, depth_mm: float, sd_mm: float = SHOT_SD_MM) -> None:
        """Tell the robot, in PAUSED, how far beyond the entry point the second shot shows the tip, give or take."""
        self.exchange.order(contract.SHOT_DEPTH, f"{float(depth_mm)!r} {float(sd_mm)!r}")

    def simulated_wire(self) -> SimulatedWire:
        """Where a simulated robot's wire truly is, for simulated images. Raises RobotRefusedError of a real robot."""
        return SimulatedWire.of(self.exchange.order(contract.SIMULATED_WIRE, ""))

    # How anything is asked.

    def command(self, name: str, timeout_s: float = STATUS_S) -> Said:
        """Send a phase or an activity by its name, and wait for its acknowledgement, then for how it ended."""
        return self.exchange.command(name, timeout_s)

    def _go_on(self, name: str) -> str:
        """The next step by its own name, or as the old convention has it."""
        if contract.HAS_DRILLING not in self.capabilities:
            name = Cause.MOVE_TO_TARGET.value
        return self.command(name, MOTION_S).refuse_unless_ok().text

    # What the robot said and was not meant.

    @contextmanager
    def _doubted(self, what: str) -> Generator[None]:
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
    """What a target of ours says beside its pose. `now_s` by the clock of `target.expires_s`: what travels is the time
    left, so that two clocks need not agree."""
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
        contract.KIND: identity.kind,
        contract.POSITION_LIMIT_MM: repr(limits.position_mm),
        contract.DIRECTION_LIMIT_DEG: repr(math.degrees(limits.direction_rad)),
        contract.BEYOND_MM: repr(limits.beyond_mm),
    }
