"""The check shot: the wire seen in two more images, in space, against the plan.

Everything is one adjustment in the coordinates of the planning images, which the bone carries: landmarks, the movement
of the bone against the frame until the check, and the wire as a cubic along the planned axis. Observed are landmarks in
four images, centre line and tip in two. Views err as they state, the frame's errors are those of all four.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from sightline.calibration.view import CalibratedView
from sightline.checks import Limits
from sightline.errors import UnusableInputError
from sightline.planning.check_adjustment import Adjustment
from sightline.planning.check_result import CheckShot
from sightline.planning.check_start import KnownWire, Landmarks, WireSeen
from sightline.planning.picks import Pick
from sightline.planning.trajectory import Trajectory

__all__ = ["CheckShot", "Landmarks", "check_shot"]

_ITERATIONS = 5
_OVERLAID = 0.2  # share of the centre lines' points that may be left out: bone's edges pull some of them aside [ours]


def check_shot(
    trajectory: Trajectory,
    picks: Sequence[tuple[Pick, Pick]],
    planned: Sequence[CalibratedView],
    checked: Sequence[CalibratedView],
    wires: Sequence[WireSeen],
    *,
    landmarks: Landmarks | None = None,
    limits: Limits | None = None,
) -> CheckShot:
    """The wire that two check images show, against the plan made on two others.

    `trajectory`, `picks` (entry, end) of a `Plan` made on the views `planned`; `wires`: what the images of the views
    `checked` show, in their order. The picks define the plan: that they may miss what the surgeon meant is no error
    here. Points of the centre lines that all else contradicts are left out, the worst first, a fifth at most; a tip or
    a landmark never is.
    Raises UnusableInputError, ReconstructionRefusedError, OutsideRegionError, ErrorUnknownError.
    """
    landmarks = landmarks or Landmarks()
    if len(planned) != 2 or len(checked) != 2 or len(wires) != 2 or len(picks) != 2:
        raise UnusableInputError("a check shot needs two views of the plan, two of the check, a wire in each of these")
    shot = _adjusted(trajectory, picks, (planned, checked), wires, landmarks)
    for _ in range(int(_OVERLAID * sum(len(wire.uv_px) for wire in shot.wires))):
        piece = shot.contradicted_piece()
        if piece is None:
            break
        wires = [_without(wire, piece[1]) if k == piece[0] else wire for k, wire in enumerate(shot.wires)]
        shot = _adjusted(trajectory, picks, (planned, checked), wires, landmarks)
    return shot.result(limits or Limits())


def _adjusted(
    trajectory: Trajectory,
    picks: Sequence[tuple[Pick, Pick]],
    views: tuple[Sequence[CalibratedView], Sequence[CalibratedView]],
    wires: Sequence[WireSeen],
    landmarks: Landmarks,
) -> Adjustment:
    shot = Adjustment(trajectory, picks, views, wires, landmarks)
    for _ in range(_ITERATIONS):
        shot.step()
    return shot


def _without(wire: KnownWire, piece: int) -> KnownWire:
    return replace(wire, uv_px=np.delete(wire.uv_px, piece, axis=0), variance_px2=np.delete(wire.variance_px2, piece))
