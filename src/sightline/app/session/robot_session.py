"""The app's session with the robot: the link on its own thread, the robot's streams, and people's commands."""

import asyncio
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, replace
from queue import Empty, SimpleQueue
from typing import Any, TypeVar

import numpy as np

from sightline.app.session.jobs import sentence_of
from sightline.app.session.sent import ZeroSource
from sightline.common.geometry.covariance import TWO_SIDED_95
from sightline.errors import LinkError, RobotRefusedError, SightlineError
from sightline.planning import Plan
from sightline.planning.points.results import SpacePoints
from sightline.rehearsal.operation import await_hand, target_of
from sightline.robot import contract
from sightline.robot.control.states import State
from sightline.robot.igtl import Message, NDArray, Sensor
from sightline.robot.kinematics.calibrated import CalibratedRobot
from sightline.robot.kinematics.target import PlanIdentity, PoseAtImage, RobotTarget, register
from sightline.robot.link.client import RobotClient
from sightline.robot.link.record import DrillingRecord, Recorder, SimulatedWire

T = TypeVar("T")
_STATUS_EVERY_S = 0.25  # [ours] within a second a page shows a state that no message reported
_STOPS = 4  # [ours] STOPs that may be in progress at once; a further press waits for one of them, which is as good
_STOPPED = "the robot was told to stop: align again, or retract the wire"
_IDLE_S = 0.02  # polling period of the command queue
_NOTIFIED = ("state", "fault", "activity", "last_error", "lost", "zero")  # notify pages; they poll the rest
_MOTIONS = {
    "aligning": State.ALIGN,
    "drilling": State.DRILL,
    "holding the guide": State.GUIDE,
    "retracting": State.RETRACT,
}  # by activity
_MAX_SIGMA = 3.0  # largest difference in combined standard deviations; three in a thousand shots exceed it [ours]


@dataclass(frozen=True, eq=False)
class RobotNow:
    """The robot's state at one moment. `state`: as in the link's contract; `fault`: its number, 0 for none.
    `activity`: what the current command does, "" without one; `last_error`: the error of the last command, "" without
    one. `depth_sd_mm`: standard deviation of the depth, None if not stated; `zero`: what the zero of depth is based
    on; `open_hole_mm`: depth of the target's hole where it was begun before."""

    state: str = "UNDEFINED"
    text: str = ""
    fault: int = 0
    activity: str = ""
    last_error: str = ""
    depth_mm: float | None = None
    depth_sd_mm: float | None = None
    zero: tuple[ZeroSource, ...] = (ZeroSource.PLAN,)
    open_hole_mm: float | None = None
    force_n: float | None = None
    joints: np.ndarray | None = None
    lost: bool = False

    @property
    def phase(self) -> str:
        """What the robot is doing, as a state: during a motion that one, because its state is not queried meanwhile."""
        motion = _MOTIONS.get(self.activity)
        return self.state if motion is None else motion.value


_Command = tuple[Callable[[RobotClient], Any], Future[Any]]  # what to do, and where its result goes


class RobotSession:
    """Session with a simulated robot at a port of this machine. `changed` is called, from any thread, when state, fault
    or commands change.

    Commands are carried out one at a time; `stop` is sent at once, on a separate connection.
    `imaged_q` (n,): joints at the images, read when the session opens: the simulated robot starts in its pose at the
    images and moves only on commands sent here.
    """

    def __init__(self, robot: CalibratedRobot, port: int, changed: Callable[[], None]) -> None:
        """Block until the link is open. Raises LinkError."""
        self.robot, self.now, self.target, self.depth_limit_mm = robot, RobotNow(), None, None
        self._changed = changed
        self._recorder = Recorder()
        self._sending_shot = False
        self._commands: SimpleQueue[_Command] = SimpleQueue()
        self._end = threading.Event()
        self._lock = threading.Lock()  # for `now` and `_over`, which this thread and the link's replace
        self._over = False  # commands are no longer carried out
        self._told_to_stop = False  # since the last command
        self._stops = ThreadPoolExecutor(_STOPS, "stop")  # threads of its own, so that STOP waits for no other work
        self._client = RobotClient(port=port)
        self._client.listeners.append(self._heard)
        self.imaged_q = self._client.joints()[0]
        self._thread = threading.Thread(target=self._run, name="robot session", daemon=True)
        self._thread.start()

    target: RobotTarget | None
    depth_limit_mm: float | None  # of the target, from the entry point

    @property
    def record(self) -> DrillingRecord:
        """Depth, force and events since the last target was sent."""
        return self._recorder.record

    def close(self) -> None:
        """Close the link; the robot stops and clears its target."""
        self._end.set()
        self._thread.join(5.0)

    def target_for(
        self, plan: Plan, identity: PlanIdentity, imaged_s: float, wire: SpacePoints | None = None
    ) -> RobotTarget:
        """Return the robot's target for a plan. `imaged_s`: time of the images, time.monotonic. `wire`: a point and the
        tip of the robot's own wire in these images, which correct its registration (`CalibratedRobot.with_wire_seen`).

        Raises UnusableInputError, RobotRefusedError."""
        # Both times are `imaged_s`, so that no age is checked: `imaged_q` holds for the simulated robot at its images.
        pose = PoseAtImage(self.imaged_q, imaged_s, imaged_s)
        robot = self.robot
        if wire is not None:
            assert wire.joint_covariance_mm2 is not None  # noqa: S101 - of a wire that passed its checks
            robot = robot.with_wire_seen(self.imaged_q, wire.xyz_mm, wire.joint_covariance_mm2)
        return target_of(plan, identity, register(robot, {"pa": pose, "lateral": pose}))

    async def send(self, target: RobotTarget, depth_limit_mm: float) -> None:
        """Send the registration and the target. `depth_limit_mm` from the entry point. Raises RobotRefusedError,
        LinkError."""

        def command(client: RobotClient) -> None:
            client.start_up()
            client.calibrate(target.registration.T_mcs_cfcs, target.registration.imaged_s)
            client.aim_plan(target, time.monotonic(), depth_limit_mm)
            self._put(open_hole_mm=client.open_hole_mm)

        self._recorder, self.target = Recorder(), None
        self._put(open_hole_mm=None)
        await self._do("receiving the plan", command)
        self.target, self.depth_limit_mm = target, depth_limit_mm

    async def align(self) -> None:
        """Align the arm with the plan, and wait there. Raises RobotRefusedError, LinkError."""
        await self._do("aligning", lambda client: client.align())

    async def drill(self, since: State) -> str:
        """Drill from ALIGNED to the pause, or from PAUSED to the end; return the state at the end.

        An arm without a feed holds its guide until the simulated person has drilled. `since`: the state in which the
        person confirmed. Raises RobotRefusedError if the robot has left it, LinkError.
        """
        target = self.target
        if target is None or self.robot.manipulator.has_feed:
            return await self._do("drilling", lambda client: client.drill(), since)

        def command(client: RobotClient) -> str:
            client.guide()
            await_hand(client, target)
            return State.DONE.value

        return await self._do("holding the guide", command, since)

    def refuse_shot(self, depth_mm: float, error_95_mm: float) -> None:
        """Raise RobotRefusedError if a depth measured in the second shot contradicts the robot's depth, or was already
        sent: one shot counts once."""
        now, sd = self.now, error_95_mm / TWO_SIDED_95
        if ZeroSource.SHOT in now.zero or self._sending_shot:
            raise RobotRefusedError("the depth of this second shot was already sent; continue drilling, or stop")
        if not (np.isfinite([depth_mm, sd]).all() and sd > 0.0):
            raise RobotRefusedError("enter the depth of the tip in the second shot and its 95 % error, both in mm")
        if now.depth_mm is None or now.depth_sd_mm is None:
            raise RobotRefusedError(
                "the robot does not report the error of its depth, so this depth cannot be sent; check the wire in the "
                "images before you continue"
            )
        apart, together = abs(depth_mm - now.depth_mm), float(np.hypot(sd, now.depth_sd_mm))
        if apart > _MAX_SIGMA * together:
            raise RobotRefusedError(
                f"measure the shot again: it shows the tip at {depth_mm:.1f} mm, the robot reports "
                f"{now.depth_mm:.1f} mm. The difference is {apart:.1f} mm; at most {_MAX_SIGMA * together:.1f} mm is "
                "consistent with their errors. If it remains, press STOP and plan on new images"
            )

    async def send_shot_depth(self, depth_mm: float, error_95_mm: float) -> None:
        """Send the tip's depth measured in the second shot, in PAUSED. Raises RobotRefusedError, LinkError."""
        self.refuse_shot(depth_mm, error_95_mm)

        def command(client: RobotClient) -> None:
            self._sending_shot = True  # the next decrease of the depth's error is due to the shot
            try:
                client.shot_depth(depth_mm, error_95_mm / TWO_SIDED_95)
            except RobotRefusedError:  # after any other error the robot may have accepted it
                self._sending_shot = False
                raise

        await self._do("receiving the depth of the shot", command, State.PAUSED)

    async def retract(self) -> None:
        """Retract the wire, or the open chuck. Raises RobotRefusedError, LinkError."""
        await self._do("retracting", lambda client: client.retract())

    async def reset(self, fault: int) -> None:
        """Reset the robot after a fault that a person has dealt with. Raises RobotRefusedError, LinkError."""
        await self._do("resetting", lambda client: client.reset(fault))

    async def joints(self) -> np.ndarray:
        """Return the robot's joints (n,) by its encoders, now. Raises RobotRefusedError, LinkError."""
        return await self._do("reporting its joints", lambda client: client.joints()[0])

    async def simulated_wire(self) -> SimulatedWire:
        """Return the true pose of a simulated robot's wire. Raises RobotRefusedError from a real one."""
        return await self._do("reporting where the wire is", lambda client: client.simulated_wire())

    async def stop(self) -> None:
        """Stop at once; waiting commands are dropped. Raises LinkError."""
        self._drop_commands(_STOPPED)
        with self._lock:
            if self._over:
                raise LinkError("use the red button: the link to the robot is lost, so STOP does not reach it")
            self._told_to_stop = True
            stopping = self._stops.submit(self._client.stop)
        await asyncio.wrap_future(stopping)

    async def _do(self, activity: str, command: Callable[[RobotClient], T], since: State | None = None) -> T:
        future: Future[Any] = Future()
        self._begin(activity, since, (command, future))
        try:
            return await asyncio.wrap_future(future)
        except SightlineError as error:
            if self._told_to_stop and isinstance(
                error, RobotRefusedError
            ):  # what the robot says of it is a refusal of the motion
                self._put(last_error="")
                raise RobotRefusedError(_STOPPED) from error
            self._put(last_error=sentence_of(error))
            raise
        finally:
            self._put(activity="")

    def _begin(self, activity: str, since: State | None, queued: _Command) -> None:
        # One command at a time: a second confirmation, for example on another page, was made for an earlier state.
        with self._lock:
            now = self.now
            if now.lost or self._over:
                raise LinkError("start the robot again: the link to it is lost")
            if now.activity:
                raise RobotRefusedError(f"wait, or stop the robot: it is still {now.activity}")
            if since is not None and now.state != since.value:
                raise RobotRefusedError(
                    f"check the robot and confirm again: it is now in {now.state}, no longer in {since.value}"
                )
            self.now = replace(now, activity=activity, last_error="")
            self._told_to_stop = False
            self._commands.put(queued)
        self._notify()

    # The link's thread.

    def _run(self) -> None:
        try:
            with self._client:
                asked_s = 0.0
                while not self._end.is_set():
                    with suppress(Empty):
                        self._carry_out(*self._commands.get_nowait())
                    if time.monotonic() - asked_s > _STATUS_EVERY_S:
                        status = self._client.status()
                        state = status.text.split(";")[0] or status.error_name
                        self._put(state=state, text=status.text, fault=int(status.subcode))
                        asked_s = time.monotonic()
                    self._end.wait(_IDLE_S)
        except Exception as error:
            self._put(lost=True, last_error=sentence_of(error), activity="")
            if not isinstance(error, LinkError):
                raise
        finally:
            with self._lock:
                self._over = True  # later commands are refused; those in the queue are dropped below
            self._put(lost=True, activity="")
            self._drop_commands("the link to the robot was closed")
            self._stops.shutdown(wait=False)

    def _drop_commands(self, why: str) -> None:
        with suppress(Empty):
            while True:
                self._commands.get_nowait()[1].set_exception(LinkError(why))

    def _carry_out(self, command: Callable[[RobotClient], Any], future: Future[Any]) -> None:
        try:
            result = command(self._client)
        except BaseException as error:
            future.set_exception(error)
            if isinstance(error, LinkError) and not self._answers():
                raise
        else:
            future.set_result(result)

    def _answers(self) -> bool:
        with suppress(SightlineError):
            self._client.status()
            return True
        return False

    def _heard(self, message: Message) -> None:
        self._recorder.heard(message)
        body = message.body
        if isinstance(body, Sensor) and len(body.values) == 1:
            value = float(body.values[0])
            if message.device_name == contract.DEPTH:
                self._put(depth_mm=value if np.isfinite(value) else None)
            elif message.device_name == contract.DEPTH_SD:
                self._heard_error(value if np.isfinite(value) else None)
            elif message.device_name == contract.FORCE:
                self._put(force_n=value)
        elif isinstance(body, NDArray) and message.device_name == contract.MEASURED_JS and body.values.ndim == 2:
            self._put(joints=np.array(body.values[0]))

    def _heard_error(self, sd_mm: float | None) -> None:
        """Record the depth's standard deviation, and infer `zero`, which the robot does not report.

        A decrease means a new source of the zero: the second shot if its depth was just sent, else contact with bone.
        An increase or a missing value means a new target, whose zero rests on the plan."""
        before, zero = self.now.depth_sd_mm, self.now.zero
        if sd_mm is None or before is None or sd_mm > before:
            zero, self._sending_shot = (ZeroSource.PLAN,), False
        elif sd_mm < before:
            zero, self._sending_shot = (*zero, ZeroSource.SHOT if self._sending_shot else ZeroSource.CONTACT), False
        self._put(depth_sd_mm=sd_mm, zero=zero)

    def _put(self, **news: Any) -> None:
        with self._lock:
            before, self.now = self.now, replace(self.now, **news)
        if any(getattr(before, name) != news[name] for name in _NOTIFIED if name in news):
            self._notify()

    def _notify(self) -> None:
        if not self._end.is_set():  # when closing, the listeners may no longer exist
            self._changed()
