"""The robot's own wire in the planning images of a block: its marks, and its place in space."""

from collections.abc import Sequence

import numpy as np

from sightline.app.plan.decisions import Decisions
from sightline.app.plan.marks import MarkSpec
from sightline.app.plan.planner import PICK_SD_PX
from sightline.calibration import CalibratedView
from sightline.case.views import NAMES
from sightline.checks import failed
from sightline.errors import RobotRefusedError
from sightline.planning import reconstruct
from sightline.planning.points.results import SpacePoints

# The robot's own wire in the planning images of a block, which register the robot more accurately than its encoders.
ROBOT_WIRE = (
    MarkSpec(
        "robot-guide",
        "Robot's wire 1",
        "Any point in the middle of the robot's own wire, 25 mm or more behind its tip.",
        "robot",
        "robot-wire",
    ),
    MarkSpec("robot-tip", "Robot's wire 2", "The tip of the robot's own wire, before the bone.", "robot", "robot-wire"),
)


def robot_wire_seen(decisions: Decisions, views: Sequence[CalibratedView]) -> SpacePoints | None:
    """Return a point of the robot's own wire and its tip as PA and lateral image show them; None where neither is
    clicked.

    Nothing on the wire tells the same point in both images, so the first click counts across the wire only: along it,
    its error is the distance to the tip (1 s.d.). Raises RobotRefusedError where a click is missing or both images do
    not show one tip, and what `reconstruct` raises.
    """
    marks = [decisions.mark(spec.name) for spec in ROBOT_WIRE]
    if not any(mark.places for mark in marks):
        return None
    if not all(mark.complete() for mark in marks):
        raise RobotRefusedError(
            "click tip and middle of the robot's wire in both images, or remove their marks: the robot is registered "
            "by all four clicks, or by its encoders"
        )
    uv = np.array([[mark.at(name) for mark in marks] for name in NAMES])
    spread = np.tile(PICK_SD_PX**2 * np.eye(2), (*uv.shape[:2], 1, 1))
    for view, (point, tip) in enumerate(uv):
        spread[view, 0] += np.outer(tip - point, tip - point)
    seen = reconstruct(views[: len(NAMES)], uv, spread)
    if wrong := failed(seen.checks):  # point 1 is on the wire, point 2 its tip
        raise RobotRefusedError(f"click the robot's wire again in both images: {wrong[0].sentence}")
    return seen
