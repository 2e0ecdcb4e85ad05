"""The shots while drilling of the demo: two images at the skin and two at the pause, with a block."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import numpy as np

    from sightline.case.contents import DrillShotRequest, Pair
    from sightline.cli.demos.robot import DemoPlan
    from sightline.cli.output import Output
    from sightline.planning.check.shot import DrillShot
    from sightline.planning.check.wires import Landmarks
    from sightline.rehearsal.patient import CheckImages, RehearsedPatient
    from sightline.rehearsal.rehearsal import Rehearsal
    from sightline.robot.control.states import State
    from sightline.robot.kinematics.target import RobotTarget
    from sightline.robot.link.client import RobotClient


@dataclass(frozen=True, eq=False)
class ShotTaken:
    """A shot while drilling: its inputs, its images (None if one could not be calibrated), and its result or the reason
    for a refusal."""

    asked: "DrillShotRequest"
    images: "Pair | None"
    found: "DrillShot | str"


def confirming(
    output: "Output",
    planned: "DemoPlan[Rehearsal]",
    robot: "RobotClient",
    target: "RobotTarget",
    rng: "np.random.Generator",
) -> "tuple[Callable[[State], None], dict[str, ShotTaken]]":
    """Return what `insert` calls where the robot waits, and the shots that it takes, by the robot's state.

    A shot that says STOP raises RobotRefusedError. Plates cannot be measured, which is said.
    """
    from sightline.planning.check.shot import TURNED_AWAY

    taken: dict[str, ShotTaken] = {}

    def confirm(state: "State") -> None:
        if planned.rehearsal.setup.frame.solid is None:
            output.note(f"{state.value}: {TURNED_AWAY}")
        elif planned.before_mm:
            output.note(f"{state.value}: this demo measures the shots while drilling of the first wire only")
        else:
            taken[state.value] = _shot(planned, robot, target, state, rng)

    return confirm, taken


def found_again(planned: "DemoPlan[RehearsedPatient]", taken: "CheckImages", rng: "np.random.Generator") -> "Landmarks":
    """Return the plan's landmarks, picked by a person in two more images."""
    from sightline.planning.check.wires import Landmarks

    before = planned.asked
    found = taken.landmarks_px(tuple(planned.rehearsal.landmarks), before.pick_sd_px, rng)
    assert before.landmarks_uv_px is not None  # noqa: S101 - they were picked
    return Landmarks(before.landmarks_uv_px, found, before.pick_sd_px)


def _shot(
    planned: "DemoPlan[Rehearsal]",
    robot: "RobotClient",
    target: "RobotTarget",
    state: "State",
    rng: "np.random.Generator",
) -> ShotTaken:
    """Take and measure two images, with the block on its mount again; send a depth measured at the pause."""
    from sightline.case.contents import CheckRequest, DrillShotRequest
    from sightline.cli.demos.robot import read_back
    from sightline.errors import RefusedError, RobotRefusedError
    from sightline.robot.control.states import State
    from sightline.robot.kinematics.manipulator import FEED

    rehearsal, plan, q = planned.rehearsal, planned.plan, robot.joints()[0]
    taken = rehearsal.drilling_images(robot.simulated_wire(), q, state.value, planned.key, planned.before_mm)
    middle_mm = plan.trajectory.points.xyz_mm.mean(axis=0)
    movement, covariance = rehearsal.robot.frame_moved(target.registration.q, q, middle_mm)
    check = CheckRequest(plan.kind.wire_mm, found_again(planned, taken, rng))
    picked = None if taken.picked_mm is None else taken.pixels(taken.picked_mm, planned.asked.pick_sd_px, rng)
    depth_mm, straight = float(q[FEED] - target.q[FEED]), state is State.ALIGNED
    asked, images = DrillShotRequest(check, depth_mm, straight, movement.as_matrix(), covariance, picked), None
    try:
        images = read_back(taken.images, rehearsal.setup.frame)
        found = asked.shot(plan, planned.images, images, planned.others_mm)
    except RefusedError as error:
        return ShotTaken(asked, images, str(error))
    if found.decision == "STOP":
        failed = "; ".join(one.sentence for one in found.verdict.checks if not one.passed)
        raise RobotRefusedError(f"the shot at {state.value} says STOP: {failed}")
    if state is State.PAUSED and found.decision == "GO":
        robot.shot_depth(found.depth_mm, found.depth_sd_mm)
    return ShotTaken(asked, images, found)
