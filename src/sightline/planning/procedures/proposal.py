"""A wire proposed from the drawn aids by its procedure's rule, with the drawings' error, for a person to adjust."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from sightline.calibration.view import CalibratedView
from sightline.common.geometry.covariance import length_quantile, response
from sightline.errors import ReconstructionRefusedError
from sightline.planning.bone.anatomy import Anatomy
from sightline.planning.procedures.proposal_rules import RULES, ProposalRule


@dataclass(frozen=True, eq=False)
class Proposal:
    """`entry_mm`, `end_mm` (3,), CFCS; `entry_uv_px`, `end_uv_px` (V, 2), a row for each view, as `plan` takes them.

    `covariance_mm2` (6, 6): of entry and end, by the errors of clicks and views; None where one is unknown, and for
    wires beside a planned one.
    """

    entry_mm: np.ndarray
    end_mm: np.ndarray
    entry_uv_px: np.ndarray
    end_uv_px: np.ndarray
    sentence: str
    covariance_mm2: np.ndarray | None = None


def propose(
    views: Sequence[CalibratedView], found: Anatomy, side: str | None, rule: ProposalRule | None = None
) -> Proposal:
    """Return the wire that the rule of a procedure puts into the located parts of a bone.

    `side`: needed by "through-head" only. The proposal is not a judgement: plan it, and look at the verdict.

    Raises ReconstructionRefusedError with the reason where no wire can be proposed, OutsideRegionError where it lies
    outside a view's calibrated region, UnusableInputError for an unknown side.
    """
    rule = rule or ProposalRule()
    if lacking := rule.lacking(found):
        raise ReconstructionRefusedError(f"no wire can be proposed: {found.why_absent(lacking[0])}")
    if rule.side and side is None:
        raise ReconstructionRefusedError("no wire can be proposed: the side is not given; look at the images, give it")
    known = RULES[rule.name]

    def of(values: np.ndarray) -> np.ndarray:
        return np.stack([known.ends(replace(found, values=one), side or "", rule).ravel() for one in values])

    wire, own = response(of, found.values)
    entry, end = wire.reshape(2, 3)
    length, (low, high) = float(np.linalg.norm(end - entry)), known.lengths_mm
    if not low <= length <= high:
        drawn = "head, shaft and lateral cortex" if rule.name == "through-head" else "what is drawn"
        raise ReconstructionRefusedError(
            f"the wire would be {length:.0f} mm long ({low:.0f} to {high:.0f} mm expected); check {drawn}"
        )
    covariance = None if found.covariance is None else own @ found.covariance @ own.T
    pixels = np.array([view.project(np.stack([entry, end])) for view in views])
    words = known.words.format(angle=np.rad2deg(rule.angle_rad), depth=rule.under_surface_mm)
    sentence = f"Proposed: {words}, {length:.0f} mm long.{_errors(covariance)} Adjust it to the images."
    return Proposal(entry, end, pixels[:, 0], pixels[:, 1], sentence, covariance)


def _errors(covariance: np.ndarray | None) -> str:
    if covariance is None:
        return ""
    entry, end = (float(length_quantile(covariance[at, at])) for at in (slice(0, 3), slice(3, 6)))
    return (
        f" By the errors of clicks and views its entry is known to {entry:.1f} mm and its end to {end:.1f} mm (95 %)."
    )
