"""The check shot: the drilled wire, reconstructed from two more images, against the plan.

One least-squares adjustment in the CFCS of the planning images, in which the bone is at rest. Unknowns: landmarks, the
movement of the bone against the frame until the check, and the wire as a cubic along the planned axis. Observations:
landmarks in four images, centre line and tip in two. Each view has its stated covariance; all share the frame's errors.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from sightline.calibration.solids.calibrate_together import adjusted_together
from sightline.calibration.view import CalibratedView
from sightline.checks import Limits
from sightline.errors import UnusableInputError
from sightline.planning.check.adjustment import Adjustment
from sightline.planning.check.result import CheckShot
from sightline.planning.check.start import STILL, Beforehand, KnownWire, Landmarks, WireSeen
from sightline.planning.points.picks import Pick
from sightline.planning.points.trajectory import Trajectory
from sightline.threads import one_blas_thread

__all__ = ["CheckShot", "Landmarks", "check_shot"]

_ITERATIONS = 5
_MAX_LEFT_OUT = 0.2  # share of the centre-line points that may be left out: bone edges displace some of them [ours]


@one_blas_thread
def check_shot(
    trajectory: Trajectory,
    picks: Sequence[Sequence[Pick]],
    planned: Sequence[CalibratedView],
    checked: Sequence[CalibratedView],
    wires: Sequence[WireSeen],
    *,
    landmarks: Landmarks | None = None,
    limits: Limits | None = None,
    known: Beforehand = STILL,
    through: bool = False,
) -> CheckShot:
    """Return the wire that two check images show, against the plan made on two or more others.

    `trajectory`, `picks` (entry, end): of a `Plan` made on the views `planned`; `landmarks`: of the first two of them.
    `wires`: found in the images of the views `checked`, in the same order. The picks define the plan, so their errors
    are not counted. Outlying points of the centre lines are left out, the worst first, a fifth at most; a tip or a
    landmark is never left out. `known`: of images taken while drilling. `through`: the wire is a drill through both
    walls of a nail, at the plan's two points: it is taken to be straight, and judged at both walls.
    Raises UnusableInputError, ReconstructionRefusedError, OutsideRegionError, ErrorUnknownError.
    """
    landmarks, known = landmarks or Landmarks(), replace(known, straight=True) if through else known
    each = {len(point) for point in picks} == {len(planned)}
    if len(planned) < 2 or not each or len(checked) != 2 or len(wires) != 2 or len(picks) != 2:
        raise UnusableInputError(
            "give all views of the plan with two picks in each, and two views of the check with a wire in each"
        )
    planned, checked = adjusted_together(planned), adjusted_together(checked)
    shot = _adjusted(trajectory, picks, (planned, checked), wires, landmarks, known=known)
    for _ in range(int(_MAX_LEFT_OUT * sum(len(wire.uv_px) for wire in shot.wires))):
        outlier = shot.outlying_point()
        if outlier is None:
            break
        wires = [_without(wire, outlier[1]) if k == outlier[0] else wire for k, wire in enumerate(shot.wires)]
        shot = _adjusted(trajectory, picks, (planned, checked), wires, landmarks, known=known)
    return shot.result(limits or Limits(), through=through)


def _adjusted(
    trajectory: Trajectory,
    picks: Sequence[Sequence[Pick]],
    views: tuple[Sequence[CalibratedView], Sequence[CalibratedView]],
    wires: Sequence[WireSeen],
    landmarks: Landmarks,
    *,
    known: Beforehand,
) -> Adjustment:
    shot = Adjustment(trajectory, picks, views, wires, landmarks, known=known)
    for _ in range(_ITERATIONS):
        shot.step()
    return shot


def _without(wire: KnownWire, point: int) -> KnownWire:
    return replace(wire, uv_px=np.delete(wire.uv_px, point, axis=0), variance_px2=np.delete(wire.variance_px2, point))
