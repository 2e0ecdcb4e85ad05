"""Proposed wires of a procedure: each by its rule, or beside a planned one as an inverted triangle of the file's
spacing."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from sightline.calibration.solids.calibrate_together import adjusted_together
from sightline.calibration.view import CalibratedView
from sightline.errors import ReconstructionRefusedError
from sightline.planning.bone.aids import Aids
from sightline.planning.bone.anatomy import Anatomy, locate
from sightline.planning.bone.directions import across, caudal, unit
from sightline.planning.bone.metrics import metric
from sightline.planning.plan import Plan, plan
from sightline.planning.procedures import Procedure
from sightline.planning.procedures.document import ProcedureDocument, Relation
from sightline.planning.procedures.proposal import Proposal, propose
from sightline.planning.verdict.relations import across_axes
from sightline.planning.wires import WirePicks

# Kept from the limits of spacing and of the distance to the neck's surface, for the errors of the picks [ours].
MARGIN_MM = 1.0
_STEP_MM = 0.5


def propose_wires(
    views: Sequence[CalibratedView],
    document: ProcedureDocument,
    aids: Aids,
    side: str | None,
    given: Mapping[str, WirePicks] | None = None,
) -> Mapping[str, Proposal]:
    """Return the wires of a procedure that are not `given`, by their keys: by its rule, or beside the given lowest one
    of an inverted triangle.

    Raises ReconstructionRefusedError where the procedure has no rule for them, and what `propose`, `propose_others` and
    `plan` raise.
    """
    given = given or {}
    missing = [wire.key for wire in document.wires if wire.key not in given]
    if document.proposal is not None:
        at_rest = adjusted_together(views)
        found = locate(at_rest, aids)
        return {key: propose(at_rest, found, side, Procedure.of(document, key).proposal) for key in missing}
    lowest = next((one.wires[0] for one in document.relations if one.relation == "inverted triangle"), "")
    if lowest not in given:
        first = f"give entry and end of the {lowest} wire first" if lowest else "pick entry and end"
        raise ReconstructionRefusedError(f"the procedure {document.key} states no rule for a proposal: {first}")
    picks, kind = given[lowest], Procedure.of(document, lowest)
    planned = plan(views, picks.entry_uv_px, picks.end_uv_px, snapped=picks.snapped, kind=kind, side=side, aids=aids)
    return {key: one for key, one in propose_others(planned).items() if key in missing}


def propose_others(lowest: Plan) -> Mapping[str, Proposal]:
    """Return the two wires of an inverted triangle above the planned lowest one, by their keys.

    They are parallel to it and as far from it and from each other as the file's spacing and the drawn neck allow, the
    tips as deep below the head's surface, the entries as far from the shaft's axis. Without a drawn neck they have
    the smallest spacing; without head or shaft the ends are shifted across the wire only.

    Raises ReconstructionRefusedError where the file has no such triangle with a spacing, the side is not known, or the
    neck has no space for the wires, and OutsideRegionError where they lie outside a view's calibrated region.
    """
    document, key, side, found = lowest.kind.document, lowest.kind.wire.key, lowest.side, lowest.anatomy
    triangle, low, high = _asked(document, key)
    if side is None:
        raise ReconstructionRefusedError("no wires can be proposed: the side is not given; give it")
    wire = lowest.trajectory.points.xyz_mm
    above, front = (axis[0] for axis in across_axes(lowest.trajectory.direction[None], -caudal(side)))
    spacings = np.arange(low + MARGIN_MM, high - MARGIN_MM + 1e-9, _STEP_MM)
    for spacing in spacings[::-1] if found is not None and "outline" in found.at else spacings[:1]:
        off = [np.sqrt(0.75) * spacing * above + way * spacing / 2 * front for way in (1.0, -1.0)]
        wires = [wire + one if found is None else _on_bone(wire, one, found) for one in off]
        made = {key: one for key, one in zip(triangle.wires[1:], wires, strict=True) if one is not None}
        if len(made) == len(wires) and all(_fits(found, one, document, side) for one in made.values()):
            return {key: _proposal(lowest, one, spacing) for key, one in made.items()}
    raise ReconstructionRefusedError(
        f"neck and head have no space for wires {low + MARGIN_MM:g} mm apart above the {lowest.kind.wire.name}; move "
        "that wire to the lower border of the neck, or draw the neck's borders again"
    )


def _asked(document: ProcedureDocument, key: str) -> tuple[Relation, float, float]:
    """Return the triangle above a wire, and the limits of its spacing. Raises ReconstructionRefusedError."""
    triangles = [one for one in document.relations if one.relation == "inverted triangle" and one.wires[0] == key]
    spacings = [one for one in document.relations if one.relation == "spacing" and triangles]
    for one in spacings:
        if set(triangles[0].wires) <= set(one.wires) and one.low is not None and one.high is not None:
            return triangles[0], one.low, one.high
    raise ReconstructionRefusedError(
        f"no wires can be proposed beside {key!r}: the procedure {document.key} states no inverted triangle with a "
        "spacing whose lowest wire it is; plan that wire first, or pick the others"
    )


def _on_bone(wire: np.ndarray, off: np.ndarray, found: Anatomy) -> np.ndarray | None:
    """Return the wire (2, 3) shifted by `off`, its ends moved along it: the entry is as far from the shaft's axis as
    that of `wire`, and the tip as far from the head's centre. None where it passes beside the shaft or the head.
    """
    along = unit(wire[1] - wire[0])
    entry, end = wire + off
    if found.shaft is not None:
        (on, _), axis = found.shaft.ends_mm, found.shaft.direction
        slope = across(along, axis)
        radius, before = (np.linalg.norm(across(point - on, axis)) for point in (wire[0], entry))
        there = -(across(entry - on, axis) @ slope) / (slope @ slope)
        rest = there**2 - (before**2 - radius**2) / (slope @ slope)
        if rest <= 0.0:
            return None
        entry = entry + (there - np.sqrt(rest)) * along
    if found.head is not None:
        centre = found.head.centre_mm
        beside = across(end - centre, along)
        rest = ((wire[1] - centre) ** 2).sum() - beside @ beside
        if rest <= 0.0:
            return None
        end = centre + beside + np.sqrt(rest) * along
    return np.array([entry, end])


def _fits(found: Anatomy | None, wire: np.ndarray, document: ProcedureDocument, side: str) -> bool:
    """Return True for a wire that keeps the file's distance from the neck's surface and MARGIN_MM more, or where no
    neck is drawn."""
    if found is None or "outline" not in found.at:
        return True
    values = found.values.copy()
    values[found.at["wire"]] = wire.ravel()
    least = max((rule.range[0] for rule in document.checks if rule.check == "wire in neck"), default=0.0)
    value = metric(replace(found, values=values), "wire in neck", side).value
    return value is not None and value >= least + MARGIN_MM


def _proposal(lowest: Plan, wire: np.ndarray, spacing_mm: float) -> Proposal:
    pixels = np.array([view.project(wire) for view in lowest.views])
    sentence = (
        f"Proposed: parallel to the {lowest.kind.wire.name}, {spacing_mm:.1f} mm from it and from the other wire. "
        "Adjust it to the images."
    )
    return Proposal(wire[0], wire[1], pixels[:, 0], pixels[:, 1], sentence)
