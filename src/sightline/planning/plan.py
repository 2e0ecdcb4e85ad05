"""From picks in two views to a plan: trajectory, image-matching curves, verdict."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sightline.calibration.view import CalibratedView
from sightline.errors import UnusableInputError
from sightline.planning.curve import MatchingCurve, matching_curve, snap
from sightline.planning.picks import DEFAULT_PICK_SD_PX, Pick, stack
from sightline.planning.reconstruct import Method, reconstruct
from sightline.planning.results import Verdict
from sightline.planning.trajectory import Trajectory
from sightline.planning.verdict import Limits, judge


@dataclass(frozen=True, eq=False)
class Plan:
    """A trajectory, the curves of its two points in the second view, and what stands for or against it.

    `picks`: for entry and end, the pick in each view as it was used: snapped ones lie on their curve.
    """

    trajectory: Trajectory
    picks: tuple[tuple[Pick, Pick], tuple[Pick, Pick]]
    entry_curve: MatchingCurve
    end_curve: MatchingCurve
    verdict: Verdict


def plan(
    views: Sequence[CalibratedView],
    entry_uv_px: np.ndarray,
    end_uv_px: np.ndarray,
    *,
    pick_sd_px: float = DEFAULT_PICK_SD_PX,
    snapped: bool = False,
    method: Method = "weighted",
    limits: Limits | None = None,
) -> Plan:
    """Plan from the pixels of entry and end point, each (2, 2): a row for each view, IDCS.

    `pick_sd_px`: how well a person picks. `snapped`: the second view's picks are taken to the curves of the first's.
    Raises what `reconstruct`, `matching_curve` and `snap` raise.
    """
    if len(views) != 2:
        raise UnusableInputError(f"{len(views)} views given; a plan is made on exactly two")
    picked = [_picks(views, uv, pick_sd_px, snapped) for uv in (entry_uv_px, end_uv_px)]
    (entry, entry_curve), (end, end_curve) = picked
    trajectory = Trajectory(reconstruct(views, *_arguments(entry, end, method)))
    return Plan(trajectory, (entry, end), entry_curve, end_curve, judge(trajectory, views, limits))


def _arguments(entry: tuple[Pick, Pick], end: tuple[Pick, Pick], method: Method) -> tuple:
    uv, covariance, across = stack([entry, end])
    return uv, covariance, method, across


def _picks(
    views: Sequence[CalibratedView], uv_px: np.ndarray, sd_px: float, snapped: bool
) -> tuple[tuple[Pick, Pick], MatchingCurve]:
    uv = np.asarray(uv_px, dtype=np.float64)
    if uv.shape != (2, 2) or not np.isfinite(uv).all():
        raise UnusableInputError("a plan point needs one finite pixel (u, v) in each of the two images")
    first = Pick.free(uv[0], sd_px)
    curve = matching_curve(views[0], first.uv_px, views[1], first.covariance_px2)
    second = snap(curve, uv[1], sd_px) if snapped else Pick.free(uv[1], sd_px)
    return (first, second), curve
