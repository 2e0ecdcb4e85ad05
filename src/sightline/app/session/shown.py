"""What the app shows to other programs of its open session, by OpenIGTLink."""

from dataclasses import replace
from typing import TYPE_CHECKING

from sightline.case.live import STATUS, LiveState, ShownImage, shown_of, status_of
from sightline.common.checks import failed
from sightline.robot.contract import Code
from sightline.robot.igtl import Status

if TYPE_CHECKING:
    from sightline.app.session.robot_session import RobotNow
    from sightline.app.session.session import Session

ROBOT = "robot"  # device name of its STATUS


class ShownSession:
    """Follows one session after another. Call it in any thread for what they show now."""

    def __init__(self) -> None:
        self._session: Session | None = None
        self._planned = LiveState()

    def follow(self, session: "Session") -> None:
        """Show `session` from now on. Must run on the event loop."""

        def update() -> None:
            self._session, self._planned = session, _planned(session)

        session.jobs.listeners.append(update)
        update()

    def __call__(self) -> LiveState:
        """Return what is shown now: the plan of the last change, and live image and robot as they are."""
        planned, session = self._planned, self._session
        if session is None:
            return planned
        statuses, images, tool = dict(planned.statuses), dict(planned.images), None
        if session.live.watch is not None:
            newest = session.live.latest()
            statuses[STATUS], images = status_of(newest), images | shown_of(newest)
        robot = session.drilling.session
        if robot is not None:
            statuses[ROBOT] = _robot_status(robot.now)
            if robot.now.joints is not None and not robot.now.lost:
                arm = robot.robot.manipulator
                tool = (arm.T_mcs_cfcs(robot.imaged_q).inv() * arm.T_mcs_tool(robot.now.joints)).as_matrix()
        return replace(planned, statuses=statuses, images=images, T_cfcs_tool=tool)


def _planned(session: "Session") -> LiveState:
    planning = session.planning
    known, bone = planning.planned, planning.accepted_bone
    plan = None if known is None else known.plan
    seen = {name: planning.seen(name) for name in planning.names}
    images = {name: ShownImage(s.image, s.view) for name, s in seen.items() if s is not None and s.view is not None}
    verdict, wire = "no plan", None
    if plan is not None:
        names = ", ".join(dict.fromkeys(check.name for check in failed(plan.verdict.checks)))
        verdict = plan.verdict.state.upper() + (f" ({names})" if names else "")
        wire = plan.trajectory.points.xyz_mm if plan.verdict.go else None
    return LiveState(
        {STATUS: Status(Code.OK, "", "no live image")},
        images,
        verdict,
        wire,
        None if bone is None else bone.registered,
        side=planning.decisions.side if planning.frame.solid is None else None,
    )


def _robot_status(now: "RobotNow") -> Status:
    if now.lost:
        return Status(Code.NOT_READY, "LOST", now.last_error or "the link to the robot is lost")
    return Status(Code.HARDWARE if now.fault else Code.OK, now.phase[:20], now.text, now.fault)
