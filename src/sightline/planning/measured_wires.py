"""The relations between wires in the bone, as their check shots measured them."""

from collections.abc import Mapping

import numpy as np

from sightline.errors import UnusableInputError
from sightline.planning.check_result import CheckShot
from sightline.planning.relations import WireLines, judge_relations
from sightline.planning.results import Verdict
from sightline.planning.wires import WirePlans


def measured_lines(plans: WirePlans, shots: Mapping[str, CheckShot]) -> WireLines:
    """Return the wires with check shots, by the keys of `plans`, and those that were placed before.

    The covariance is the sum of that of the plans, with the errors that the wires share, and that of each deviation
    from its plan. This is an upper bound: the part of the views' errors that plan and deviation share would cancel.
    Raises UnusableInputError for a wire that is not planned.
    """
    if unknown := set(shots) - set(plans.plans):
        raise UnusableInputError(f"{', '.join(sorted(unknown))} is not planned here; give check shots of planned wires")
    keys = tuple(key for key in plans.lines.keys if key in shots or key in plans.placed)
    at = plans.lines.places(keys)
    ends, covariance = plans.lines.ends_mm[at], plans.lines.joint_covariance_mm2
    if covariance is not None:
        rows = np.concatenate([np.arange(6 * k, 6 * k + 6) for k in at]) if at else np.zeros(0, dtype=int)
        covariance = covariance[np.ix_(rows, rows)]
    for k, key in enumerate(keys):
        if key in shots:
            shot = shots[key]
            ends[k] = shot.entry_mm, shot.tip_mm
            if covariance is not None:
                covariance[6 * k : 6 * k + 6, 6 * k : 6 * k + 6] += _ends_covariance_mm2(shot)
    return WireLines(keys, ends, covariance)


def judge_measured(plans: WirePlans, shots: Mapping[str, CheckShot], side: str | None) -> Verdict:
    """Return the checks of the relations between the wires with check shots, as `judge_relations`.

    Raises UnusableInputError.
    """
    names = {wire.key: wire.name for wire in plans.procedure.wires}
    lines = measured_lines(plans, shots)
    return judge_relations(plans.procedure.relations, lines, names, side, "is not measured yet")


def _ends_covariance_mm2(shot: CheckShot) -> np.ndarray:
    """Return the covariance (6, 6) of entry and tip by the five components of their deviation."""
    along = np.cross(*shot.across)
    along *= np.sign(along @ (shot.tip_mm - shot.entry_mm))
    to_ends = np.zeros((6, 5))
    to_ends[:3, :2] = shot.across.T
    to_ends[3:, 2:] = np.column_stack([*shot.across, along])
    return to_ends @ shot.covariance_mm2 @ to_ends.T
