"""The wire in two more images, against its plan: a check shot of the drilled wire, and shots while drilling.

One least-squares adjustment in the CFCS of the planning images, in which the bone is at rest. Unknowns: landmarks, the
movement of the bone against the frame until the check, and the wire as a cubic along the planned axis. Observations:
landmarks in four images, centre line and tip in two. Each view has its stated covariance; all share the frame's errors.

A shot while drilling shows the robot's wire in its guide (ALIGNED) or at the pause (PAUSED). The frame is a block, put
back on its mount while the arm stands on the plan's line. The robot's encoders tell how it moved since the planning
images, and landmarks picked again tie it to the bone.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from sightline.calibration.solids.calibrate_together import adjusted_together
from sightline.calibration.view import CalibratedView
from sightline.common.checks import Check, CheckCode, Limits, at_most, failed
from sightline.common.geometry.covariance import length_quantile
from sightline.common.threads import one_blas_thread
from sightline.errors import UnusableInputError
from sightline.planning.check.adjustment import Adjustment
from sightline.planning.check.result import CheckShot, check_shot_error
from sightline.planning.check.wires import STILL, Beforehand, KnownWire, Landmarks, WireSeen
from sightline.planning.points.picks import Pick
from sightline.planning.points.results import Verdict
from sightline.planning.points.trajectory import Trajectory

__all__ = ["CheckShot", "Landmarks", "PlannedWire", "check_shot"]

_ITERATIONS = 5
_MAX_LEFT_OUT = 0.2  # share of the centre-line points that may be left out: bone edges displace some of them [ours]
ALIGNED, PAUSED = "ALIGNED", "PAUSED"  # as the robot's states
TURNED_AWAY = (
    "This shot cannot be measured: the frame has turned away with the arm, and its beads no longer tell where the bone "
    "is. Compare wire and plan by eye; the decision is yours."
)
NO_WIRE = (
    "This shot is not measured: no wire is in the guide yet. Compare guide and plan by eye; the decision is yours."
)
MIN_TIP_MM = 1.0  # nearer to the entry, the tip says nothing of the line's direction [ours]
MAX_DEPTH_MM = 3.0  # a robot refuses a measured depth that is further from its own [docs/robot-link.md]
_WORDS = {"go": "GO", "no-go": "STOP", "incomplete": "INCOMPLETE"}
_INPUTS = (CheckCode.CHECK_SHOT_ERROR, CheckCode.BONE_LANDMARKS)  # where these fail, an input is missing


@dataclass(frozen=True, eq=False)
class PlannedWire:
    """What a check shot compares a wire with: the trajectory of a plan, and the picks (entry, end) in its `views`.

    `limits`: what the wire is judged by. `through`: it is a drill through both walls of a nail, at the plan's two
    points: it is taken to be straight, and judged at both walls.
    """

    trajectory: Trajectory
    picks: Sequence[Sequence[Pick]]
    views: Sequence[CalibratedView]
    limits: Limits
    through: bool = False


@one_blas_thread
def check_shot(
    plan: PlannedWire,
    checked: Sequence[CalibratedView],
    wires: Sequence[WireSeen],
    *,
    landmarks: Landmarks | None = None,
    known: Beforehand = STILL,
) -> CheckShot:
    """Return the wire that two check images show, against the plan made on two or more others.

    `wires`: found in the images of the views `checked`, in the same order. `landmarks`: of the first two of the plan's
    views. The picks define the plan, so their errors are not counted. Outlying points of the centre lines are left out,
    the worst first, a fifth at most; a tip or a landmark is never left out. `known`: of images taken while drilling.
    Raises UnusableInputError, ReconstructionRefusedError, OutsideRegionError, ErrorUnknownError.
    """
    landmarks, known = landmarks or Landmarks(), replace(known, straight=True) if plan.through else known
    each = {len(point) for point in plan.picks} == {len(plan.views)}
    if len(plan.views) < 2 or not each or len(checked) != 2 or len(wires) != 2 or len(plan.picks) != 2:
        raise UnusableInputError(
            "give all views of the plan with two picks in each, and two views of the check with a wire in each"
        )
    views = adjusted_together(plan.views), adjusted_together(checked)

    def adjusted(wires: Sequence[WireSeen]) -> Adjustment:
        shot = Adjustment(plan.trajectory, plan.picks, views, wires, landmarks, known=known)
        for _ in range(_ITERATIONS):
            shot.step()
        return shot

    shot = adjusted(wires)
    for _ in range(int(_MAX_LEFT_OUT * sum(len(wire.uv_px) for wire in shot.wires))):
        outlier = shot.outlying_point()
        if outlier is None:
            break
        shot = adjusted([_without(wire, outlier[1]) if k == outlier[0] else wire for k, wire in enumerate(shot.wires)])
    return shot.result(plan.limits, through=plan.through)


def _without(wire: KnownWire, point: int) -> KnownWire:
    return replace(wire, uv_px=np.delete(wire.uv_px, point, axis=0), variance_px2=np.delete(wire.variance_px2, point))


@dataclass(frozen=True, eq=False)
class DrillShot:
    """The wire against the plan while it is drilled. `state`: ALIGNED or PAUSED.

    `wire`: the measurement; its planned tip is where the robot states the tip, its own checks are those of a drilled
    wire. `end_mm` (2,): where the wire would end beside the planned end if it were drilled on straight, in the axes
    `wire.across`; `end_covariance_mm2` (2, 2). `verdict`: of the checks of this shot.
    """

    state: str
    wire: CheckShot
    end_mm: np.ndarray
    end_covariance_mm2: np.ndarray
    verdict: Verdict

    @property
    def decision(self) -> str:
        """GO, STOP, or INCOMPLETE where only an input is missing."""
        return _WORDS[self.verdict.state]

    @property
    def depth_mm(self) -> float:
        """Depth of the tip, mm: the plan's length less the distance to its end; negative before the entry.

        A robot that drills on from this depth to the plan's length ends at the planned end.
        """
        return self.wire.length_mm + float(self.wire.deviation_mm[4])

    @property
    def depth_sd_mm(self) -> float:
        """Standard deviation of `depth_mm`."""
        return float(np.sqrt(self.wire.covariance_mm2[4, 4]))

    @property
    def end_error_95_mm(self) -> float:
        """95 % bound of the error of `end_mm`."""
        return float(length_quantile(self.end_covariance_mm2))

    def document(self) -> dict[str, Any]:
        """Return everything as JSON types: mm, angles in degrees."""
        measured = {key: value for key, value in self.wire.document().items() if key not in ("passed", "checks")}
        return {
            "state": self.state,
            "decision": self.decision,
            "depth_mm": self.depth_mm,
            "depth_sd_mm": self.depth_sd_mm,
            "end_deviation_mm": float(np.linalg.norm(self.end_mm)),
            "end_error_95_mm": self.end_error_95_mm,
            **measured,
            "checks": [vars(check) for check in self.verdict.checks],
        }


def drill_shot(
    plan: PlannedWire,
    taken: Sequence[CalibratedView],
    wires: Sequence[WireSeen],
    *,
    tip_mm: float,
    known: Beforehand,
    landmarks: Landmarks | None = None,
) -> DrillShot:
    """Return where two images that were `taken` while drilling show the wire, against the plan.

    `tip_mm`: depth of the tip beyond the planned entry by the robot, negative before it. `known`: how the frame moved
    since the planning images (`CalibratedRobot.frame_moved`); `known.straight` in ALIGNED. A drill for the hole of a
    nail is straight in PAUSED too, where it waits before the nail. The others as of `check_shot`, which also says what
    is raised; UnusableInputError too for a tip at the entry, from which no line to the end follows.
    """
    if abs(tip_mm) < MIN_TIP_MM:
        raise UnusableInputError(
            f"the tip is {tip_mm:+.1f} mm from the planned entry; take the shot before it or deeper"
        )
    trajectory, limits = plan.trajectory, plan.limits
    here = replace(plan, limits=replace(limits, beyond_mm=tip_mm - trajectory.length_mm), through=False)
    of_wire = replace(known, straight=known.straight or plan.through, before_mm=limits.before_mm)
    wire = check_shot(here, taken, wires, landmarks=landmarks, known=of_wire)
    share = (trajectory.length_mm + limits.beyond_mm) / tip_mm
    to_end = np.hstack([(1 - share) * np.eye(2), share * np.eye(2), np.zeros((2, 1))])
    end, spread = to_end @ wire.deviation_mm, to_end @ wire.covariance_mm2 @ to_end.T
    state = ALIGNED if known.straight else PAUSED
    shot = DrillShot(state, wire, end, spread, Verdict(()))
    checks = [check for of_wire in wire.checks for check in _checks(of_wire, shot, limits)]
    vague = any(check.code is CheckCode.CHECK_SHOT_ERROR for check in failed(checks))
    judged = tuple(
        replace(check, missing=not check.passed and _lacks_input(check, shot, vague=vague)) for check in checks
    )
    return replace(shot, verdict=Verdict(judged))


def _lacks_input(of: Check, shot: DrillShot, *, vague: bool) -> bool:
    """Whether a failed check lacks an input: it is one of the inputs, or a deviation that is not known to pass its
    limit because the errors are larger than theirs (`vague`)."""
    known = {
        CheckCode.WIRE_ENTRY: shot.wire.entry_error_95_mm,
        CheckCode.WIRE_AHEAD: shot.end_error_95_mm,
        CheckCode.WIRE_DIRECTION: float(np.rad2deg(shot.wire.direction_error_95_rad)),
    }
    if vague and of.code in known and of.figure is not None and of.limit is not None:
        return of.figure - known[of.code] <= of.limit
    return of.code in _INPUTS


def _checks(of_wire: Check, shot: DrillShot, limits: Limits) -> list[Check]:
    """Return what replaces one of the wire's checks: of the end ahead and the depth, not of the tip."""
    if of_wire.code is CheckCode.CHECK_SHOT_ERROR:
        return [check_shot_error(max(shot.wire.entry_error_95_mm, shot.end_error_95_mm), shot.wire, limits)]
    if of_wire.code is not CheckCode.WIRE_TIP:
        return [of_wire]
    end, off = float(np.linalg.norm(shot.end_mm)), float(shot.wire.deviation_mm[4])
    ahead = (
        f"Drilled on straight, the wire would end {end:.2f} mm beside the planned end (known to "
        f"{shot.end_error_95_mm:.2f} mm, 95 %)."
    )
    depth = (
        f"The tip lies {shot.depth_mm:.2f} mm beyond the planned entry (s.d. {shot.depth_sd_mm:.2f} mm), {off:+.2f} mm "
        "from where the robot states it"
    )
    again = ": these images are of another moment, or something has moved; take the shot again."
    return [
        Check("wire ahead", end <= limits.position_mm, end, limits.position_mm, "mm", ahead),
        at_most("wire depth", abs(off), MAX_DEPTH_MM, "mm", depth, otherwise=again),
    ]
