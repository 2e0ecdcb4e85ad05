"""Step 4, Drill: a plan is sent to the robot and drilled; a person confirms each motion."""

import asyncio
import time
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from sightline.app import texts
from sightline.app.plan.planner import ROBOT_WIRE, Planned, plan_input, robot_wire_seen
from sightline.app.session.planning import Planning
from sightline.app.session.readiness import PlanAge, Readiness
from sightline.app.session.rehearsing import Patient
from sightline.app.session.seen import entry_of
from sightline.app.session.sent import DrilledWire, SentPlan
from sightline.case.journal import Actor, Kind
from sightline.case.stages import record_changed, record_planned
from sightline.common.checks import failed
from sightline.common.geometry.covariance import TWO_SIDED_95
from sightline.errors import RobotRefusedError, UnusableInputError
from sightline.planning.bone.metrics import Metric
from sightline.planning.procedures import kind as kind_of
from sightline.robot.control.insertion import DEPTH_SLACK_MM
from sightline.robot.control.states import State
from sightline.robot.control.supervision import depth_limit
from sightline.robot.kinematics.target import PlanIdentity, RobotTarget

if TYPE_CHECKING:
    from sightline.app.session.robot_session import RobotNow, RobotSession
    from sightline.rehearsal.process import RobotProcess

TO_BONE = "tip to bone along wire"


class DrillingWorkflow:
    """Sending and drilling of the current wire's plan. `session` and `now`: None until the robot is started. `held`:
    the plan that the robot holds; `objection`: returns why it must not be drilled on, "" where nothing says so."""

    def __init__(self, planning: Planning, age: PlanAge, readiness: Readiness) -> None:
        self._planning, self._age, self._readiness = planning, age, readiness
        self._process: RobotProcess | None = None
        self._starting = False
        self.session: RobotSession | None = None
        self.held: SentPlan | None = None
        self.objection: Callable[[], str] = str

    @property
    def now(self) -> "RobotNow | None":
        """The robot's current state."""
        return None if self.session is None else self.session.now

    @property
    def by_hand(self) -> bool:
        """Whether the robot holds a guide, through which a person drills."""
        return self.session is not None and not self.session.robot.manipulator.has_feed

    async def start_robot(self, *, fast: bool) -> None:
        """Start the simulated robot of the rehearsed patient in a separate process, posed as at the images.

        `fast`: run its time as fast as possible. Raises RobotRefusedError, LinkError."""
        patient = self._planning.patient
        if patient is None:
            raise RobotRefusedError(texts.NO_ROBOT)
        if self._starting:
            raise RobotRefusedError("wait: the robot is already being started")
        self._starting = True
        try:
            await self._start(patient, fast=fast)
        finally:
            self._starting = False

    async def _start(self, patient: Patient, *, fast: bool) -> None:
        await self.close()
        loop, notify = asyncio.get_running_loop(), self._planning.jobs.notify

        def start(patient: Patient) -> "tuple[RobotProcess, RobotSession]":
            # Imported here so that the first page does not wait for robot and twin.
            from sightline.app.session.robot_session import RobotSession
            from sightline.frame import Frame
            from sightline.rehearsal.process import RobotProcess
            from sightline.rehearsal.rehearsal import robot_at

            of = patient.seed, patient.frame, patient.side, patient.procedure, patient.arm
            process = RobotProcess(*of, virtual=fast)
            try:
                return process, RobotSession(
                    robot_at(patient.procedure, patient.side, Frame.load(patient.frame), patient.arm),
                    process.port,
                    lambda: loop.call_soon_threadsafe(notify) and None,
                )
            except BaseException:
                process.close()
                raise

        self._process, self.session = await asyncio.to_thread(start, patient)
        notify()

    async def close(self) -> None:
        """Close the link and end the simulated robot, if it runs."""
        session, process = self.session, self._process
        self.session = self._process = self.held = None
        if session is not None:
            await asyncio.to_thread(session.close)
        if process is not None:
            await asyncio.to_thread(process.close)

    async def send(self, known: Planned) -> None:
        """Send the plan that a person confirmed to the robot; nothing moves.

        Raises RobotRefusedError if the plan has changed since, LinkError, CaseError."""
        planning, session = self._planning, self._running()
        if planning.lacking:
            raise RobotRefusedError(" ".join(texts.LACKS[planning.lacking]))
        plan = known.plan if known is planning.planned else None
        now = kind_of(known.decisions.kind).fingerprint
        if plan is None or plan.kind.fingerprint != now or not self._readiness.can_send:
            raise RobotRefusedError(
                "check the step Plan and send again: the plan changed after you confirmed it, or it is not GO"
            )
        age_s = self._age.now_s
        assert age_s is not None  # noqa: S101 - it can be sent
        case, decisions = planning.case, known.decisions
        identity = PlanIdentity(
            plan=f"{case.number}-{case.last}",
            side=decisions.side or "",
            frame_serial=decisions.serial or "",
            go=self._readiness.can_send,
            kind=plan.kind.key,
            frame=planning.frame.fingerprint,
        )
        seen = robot_wire_seen(decisions, known.views)
        target = session.target_for(plan, identity, time.monotonic() - age_s, seen)
        limit = _depth_limit(known, target)
        views = [entry_of(case, seen) for seen in map(planning.seen, planning.names) if seen is not None]
        made = record_planned(case, views, plan_input(decisions, len(views), bone=known.bone), plan, by=Actor.SURGEON)
        planning.write_picks(decisions)
        # From here on the robot may hold this plan, even after an error; the earlier one must not be drilled.
        self.held = None
        planning.all_sent.pop(decisions.kind, None)
        planning.all_drilled.pop(decisions.kind, None)
        try:
            await session.send(target, limit)
        except RobotRefusedError as error:
            if seen is None and ROBOT_WIRE[0] in planning.specs and failed(target.checks):
                raise RobotRefusedError(
                    f"{error} Click tip and middle of the robot's wire in both images, on the step Plan: "
                    "they register the robot more accurately than its encoders."
                ) from error
            raise
        entry = case.record(
            Kind.SENT,
            {
                "plan": identity.plan,
                "decisions": decisions.document(),
                "procedure": now,
                "trajectory": plan.trajectory.document(),
                "joints": target.q,
                "error_95_mm": [target.entry_error_95_mm, target.end_error_95_mm],
                "registered_by": "encoders" if seen is None else "images",
                "depth_limit_mm": limit,
            },
            by=Actor.SURGEON,
            rests_on=[made.number],
        )
        self.held = planning.all_sent[decisions.kind] = SentPlan(known, entry.at, entry.number)
        planning.jobs.notify()

    async def align(self) -> None:
        """Align the arm with the plan that was sent. Raises RobotRefusedError, LinkError."""
        session = self._running()
        self._refuse_changed()
        await session.align()

    async def drill(self, since: State) -> None:
        """Drill from ALIGNED to the pause, or from PAUSED to the end, or hold the guide while a person drills. `since`:
        the state in which the person confirmed.

        Raises RobotRefusedError, LinkError, CaseError."""
        session = self._running()
        held = self._refuse_changed()
        if why := self.objection():
            raise RobotRefusedError(why)
        if await session.drill(since) != State.DONE.value:
            return
        planning, record = self._planning, session.record
        drilled = DrilledWire(record, await session.simulated_wire())
        planning.all_drilled[held.planned.decisions.kind] = drilled
        content = {"record": drilled.record.document(), "simulated_wire": drilled.wire.text()}
        planning.case.record(Kind.DRILLED, content, by=Actor.ROBOT)
        planning.jobs.notify()

    async def send_shot_depth(self, depth_mm: float, error_95_mm: float) -> None:
        """Send the robot, in PAUSED, the tip's depth that a person measured in the second shot. Raises
        RobotRefusedError, LinkError, CaseError."""
        session = self._running()
        self._refuse_changed()
        depths = {"depth_mm": depth_mm, "error_95_mm": error_95_mm, "robot_depth_mm": session.now.depth_mm}
        await session.send_shot_depth(depth_mm, error_95_mm)
        record_changed(self._planning.case, "second shot", depths, by=Actor.SURGEON)

    @property
    def changed(self) -> str:
        """Why the robot may not carry out the plan that it holds: it is of another wire, or was changed since. Empty
        where it may, or where it holds none."""
        held, planning = self.held, self._planning
        if held is None or (held is planning.sent and planning.sent_is_current):
            return ""
        if held is planning.sent or not held.holds_for(planning.decisions):
            return texts.CHANGED_AFTER_SENDING
        return (
            f"The robot holds the plan of the {held.plan.kind.wire.name}: choose that wire, or "
            "send the plan of this one."
        )

    def _refuse_changed(self) -> SentPlan:
        if self.held is None or self.changed:
            raise RobotRefusedError(self.changed or texts.CHANGED_AFTER_SENDING)
        return self.held

    def _running(self) -> "RobotSession":
        if self.session is None or self.session.now.lost:
            raise RobotRefusedError("start the robot first: there is no link to it")
        return self.session


def _depth_limit(known: Planned, target: RobotTarget) -> float:
    """Return the depth limit beyond the entry point, mm. For procedures that end before a joint, it is the
    distance to the joint surface less the 95 % error of both. Raises UnusableInputError if the surface is unknown."""
    if not known.kind.ends_before_joint:
        return target.depth_mm + DEPTH_SLACK_MM
    left: Metric | None = next((metric for metric in known.metrics if metric.name == TO_BONE), None)
    if left is None or left.value is None or left.sd is None:
        raise UnusableInputError(
            "Place the rim of the femoral head in both images, which gives the distance to the "
            "joint: the depth limit of the wire is unknown."
        )
    error = float(np.hypot(TWO_SIDED_95 * left.sd, target.end_error_95_mm))
    return depth_limit(target.length_mm + left.value, error)
