"""The check shot: the drilled wire, reconstructed from two more images, against the plan.

One least-squares adjustment in the CFCS of the planning images, in which the bone is at rest. Unknowns: landmarks, the
movement of the bone against the frame until the check, and the wire as a cubic along the planned axis. Observations:
landmarks in four images, centre line and tip in two. Each view has its stated covariance; all share the frame's errors.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from sightline.calibration.solids.calibrate_together import adjusted_together
from sightline.calibration.view import CalibratedView
from sightline.common.checks import Limits
from sightline.common.threads import one_blas_thread
from sightline.errors import UnusableInputError
from sightline.planning.check.adjustment import Adjustment
from sightline.planning.check.result import CheckShot
from sightline.planning.check.start import STILL, Beforehand, KnownWire, Landmarks, WireSeen
from sightline.planning.points.picks import Pick
from sightline.planning.points.trajectory import Trajectory

__all__ = ["CheckShot", "Landmarks", "PlannedWire", "check_shot"]

_ITERATIONS = 5
_MAX_LEFT_OUT = 0.2  # share of the centre-line points that may be left out: bone edges displace some of them [ours]


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
