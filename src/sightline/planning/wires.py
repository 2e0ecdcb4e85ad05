"""Plans of all wires of a procedure on the same images: their proposals, and the relations between them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Unpack

import numpy as np
from numpy.typing import ArrayLike

from sightline.calibration.solids.calibrate_together import adjusted_together
from sightline.calibration.view import CalibratedView
from sightline.common.checks import Check
from sightline.common.geometry.lines import across, unit
from sightline.common.show import Shown, checks_lines
from sightline.common.threads import one_blas_thread
from sightline.errors import ReconstructionRefusedError, UnusableInputError
from sightline.planning.bone.aids import Aids
from sightline.planning.bone.anatomy import Anatomy, locate
from sightline.planning.bone.directions import MEDIAL, caudal, towards
from sightline.planning.bone.drawings import Axis
from sightline.planning.bone.metrics import metric
from sightline.planning.check.result import CheckShot
from sightline.planning.check.wires import PlacedWire
from sightline.planning.nail.result import Hole
from sightline.planning.plan import Plan, SharedInputs, plan
from sightline.planning.points.picks import PickArrays, stack
from sightline.planning.points.reconstruct import reconstruct
from sightline.planning.points.results import Verdict
from sightline.planning.procedures import Procedure
from sightline.planning.procedures.document import ProcedureDocument, Relation
from sightline.planning.procedures.procedure import document_of, fingerprint
from sightline.planning.procedures.proposal import Proposal, propose
from sightline.planning.verdict.relations import WireLines, across_axes, judge_relations

# Kept from the limits of spacing and of the distance to the neck's surface, for the errors of the picks [ours].
MARGIN_MM = 1.0
_STEP_MM = 0.5


@dataclass(frozen=True, eq=False)
class WirePicks:
    """Picks of one wire, IDCS: `entry_uv_px` and `end_uv_px` (V, 2), `snapped` and `hole`, as for `plan`."""

    entry_uv_px: ArrayLike
    end_uv_px: ArrayLike
    snapped: bool | Sequence[bool] = False
    hole: Hole | None = None

    @staticmethod
    def of_proposal(proposal: Proposal) -> "WirePicks":
        """Return the picks of a proposed wire in the first two of its views; in others it is not picked."""
        # Contiguous, as when they are read back: another memory order changes the last bit of a sum.
        both = [np.array(uv, order="C") for uv in (proposal.entry_uv_px, proposal.end_uv_px)]
        for uv in both:
            uv[2:] = np.nan
        return WirePicks(*both, snapped=True)

    @staticmethod
    def of_hole(hole: Hole, views: Sequence[CalibratedView]) -> "WirePicks":
        """Return the picks of a drill from lateral through a measured hole: where the views see its ends.

        Raises ReconstructionRefusedError for a hole that does not run from lateral to medial, OutsideRegionError.
        """
        through = hole.entered_along(towards(hole.direction, MEDIAL, "the hole's axis"))
        uv = np.array(
            [view.project(np.stack([through.entry_mm, through.exit_mm])) for view in adjusted_together(views)]
        )
        return WirePicks(uv[:, 0], uv[:, 1], snapped=True, hole=through)


@dataclass(frozen=True, eq=False, repr=False)
class WirePlans(Shown):
    """The plans of a procedure's wires, the relations between them, and the verdict on all of them.

    `procedure`: the content of its file. `plans`: by the wires' keys in the order of drilling. Each is what `plan`
    gives for its wire alone; its verdict includes the relations of the wire that could be judged. `placed`: wires that
    are in the bone already. `lines`: all wires in space, with their joint error. `relations`: their checks. `verdict`:
    GO only if all wires are planned or placed, and all plans and relations passed; INCOMPLETE where only an input is
    missing.
    """

    procedure: ProcedureDocument
    plans: Mapping[str, Plan]
    placed: Mapping[str, Axis]
    lines: WireLines
    relations: tuple[Check, ...]
    verdict: Verdict

    def others_mm(self, key: str) -> tuple[np.ndarray, ...]:
        """Return entry and end (2, 3) of each wire but this one, planned or placed."""
        return tuple(ends for name, ends in zip(self.lines.keys, self.lines.ends_mm, strict=True) if name != key)

    @property
    def missing(self) -> tuple[str, ...]:
        """Keys of the wires that are neither planned nor placed, in the order of drilling."""
        return tuple(key for key in self.procedure.drilling_order if key not in {*self.plans, *self.placed})

    def document(self) -> dict[str, Any]:
        """Return the verdict on all wires, the relations, and each wire's plan, as JSON types."""
        return {
            "go": self.verdict.go,
            "verdict": self.verdict.state,
            "missing": list(self.verdict.missing),
            "procedure": {"name": self.procedure.name, "fingerprint": fingerprint(self.procedure)},
            "relations": [vars(check) for check in self.relations],
            "wires": {key: plan.document() for key, plan in self.plans.items()},
        }

    def summary(self) -> str:
        """Return the verdict, entry and end of each wire, and the checks that failed."""
        paths = [
            f"  {plan.kind.wire.name}: {line.strip()}"
            for plan in self.plans.values()
            for line in plan.trajectory.summary().splitlines()[1:]
        ]
        first = f"Plan of {len(self.plans)} of {len(self.procedure.wires)} wires, {self.procedure.name}"
        return "\n".join([f"{first}: {self.verdict.state.upper()}", *paths, *checks_lines(self.verdict.checks, 3)])


@one_blas_thread
def plan_wires(
    views: Sequence[CalibratedView],
    wires: Mapping[str, WirePicks],
    *,
    procedure: ProcedureDocument | str,
    placed: Mapping[str, Axis] | None = None,
    side: str | None = None,
    **shared: Unpack[SharedInputs],
) -> WirePlans:
    """Return the plans of several wires of a procedure on the same V >= 2 views, and their relations.

    `wires`: picks by the keys of the procedure's wires; those left out are missing. `procedure`: a file's content, its
    key or its path. `placed`: wires that are in the bone already, by their keys, measured in these coordinates; entry
    first. `side` and `shared`: arguments of `plan` that hold for all wires: landmarks, aids, method, error of a pick.

    The wires' points are reconstructed together for the relations, so that their errors are correlated as the views
    share them, and so are those of a `PlacedWire`, which was found in these images. Those of measured holes, and of a
    wire that was measured in other images, are taken to be independent.
    Raises UnusableInputError, and what `plan` raises.

    >>> pa, lateral = sl.load("out/demo/views.json")
    >>> picks = sl.planning.WirePicks([[162, 689], [684, 692]], [[818, 366], [378, 276]])
    >>> plans = sl.planning.plan_wires([pa, lateral], {"inferior": picks}, procedure="cannulated-hip-screws")
    >>> plans.verdict.state, plans.missing
    ('incomplete', ('anterior', 'posterior'))
    """
    document = procedure if isinstance(procedure, ProcedureDocument) else document_of(procedure)
    placed = {} if placed is None else dict(placed)
    _refuse_unknown(document, wires, placed)
    alone = {
        key: plan(
            views,
            wires[key].entry_uv_px,
            wires[key].end_uv_px,
            snapped=wires[key].snapped,
            hole=wires[key].hole,
            procedure=Procedure.of(document, key),
            side=side,
            **shared,
        )
        for key in document.drilling_order
        if key in wires
    }
    holes = {key: picks.hole.axis for key, picks in wires.items() if picks.hole is not None}
    lines = _lines(views, {key: own for key, own in alone.items() if key not in holes}, {**holes, **placed})
    names = {wire.key: wire.name for wire in document.wires}
    judged = judge_relations(document.relations, lines, names, side)
    planned = _all_planned([names[key] for key in names if key not in lines.keys], len(names))
    return WirePlans(
        procedure=document,
        plans={key: own.related(_judged_of(key, document, judged)) for key, own in alone.items()},
        placed=placed,
        lines=lines,
        relations=judged.checks,
        verdict=_of_all(alone).joined(judged).joined(planned),
    )


def _refuse_unknown(document: ProcedureDocument, wires: Mapping[str, Any], placed: Mapping[str, Any]) -> None:
    known = [wire.key for wire in document.wires]
    if not wires or not {*wires, *placed} <= set(known) or set(wires) & set(placed):
        raise UnusableInputError(
            f"the wires {', '.join(wires) or '(none)'} are to be planned and {', '.join(placed) or 'none'} placed; "
            f"plan one or more of {', '.join(known)}, and name each wire once"
        )


def _lines(views: Sequence[CalibratedView], plans: Mapping[str, Plan], placed: Mapping[str, Axis]) -> WireLines:
    """Return all wires; those of which picks on these views are known are reconstructed together."""
    if not plans:
        return WireLines.of((), None, placed)
    seen_here = {key: wire for key, wire in placed.items() if isinstance(wire, PlacedWire)}
    planned = stack([point for wire in plans.values() for point in wire.picks])
    each = [planned, *(wire.picks.in_views(len(views)) for wire in seen_here.values())]
    picks = PickArrays(*(np.concatenate(parts, axis=1) for parts in zip(*each, strict=True)))
    methods = {wire.arguments["method"] for wire in plans.values()}
    points = reconstruct(views, picks.uv_px, picks.covariance_px2, methods.pop(), picks.across_px)
    others = {key: wire for key, wire in placed.items() if key not in seen_here}
    return WireLines.of([*plans, *seen_here], points, others)


def _judged_of(key: str, document: ProcedureDocument, judged: Verdict) -> tuple[Check, ...]:
    """Return the checks of a wire's relations that could be made."""
    asked = [relation for relation in document.relations if relation.relation != "order"]
    pairs = zip(asked, judged.checks, strict=True)
    return tuple(check for relation, check in pairs if key in relation.wires and not check.missing)


def _of_all(plans: Mapping[str, Plan]) -> Verdict:
    """Return the checks of all plans: those that are the same for all once, the others with the wire's name."""
    verdicts = {verdict.kind.wire.name: verdict.verdict for verdict in plans.values()}
    first = next(iter(verdicts.values()))
    common = [check for check in first.checks if all(check in verdict.checks for verdict in verdicts.values())]

    def named(checks: Sequence[Check], name: str) -> list[Check]:
        own = [check for check in checks if check not in common]
        return [replace(check, sentence=f"{name}: {check.sentence}") for check in own]

    checks = [*common, *(check for name, verdict in verdicts.items() for check in named(verdict.checks, name))]
    return Verdict(tuple(checks))


def _all_planned(missing: Sequence[str], count: int) -> Verdict:
    """Return the check that all wires of the procedure are planned or placed."""
    sentence = f"{count - len(missing)} of {count} wires of the procedure are planned"
    sentence += f": pick entry and end of the {' and the '.join(missing)} too." if missing else "."
    figures = float(count - len(missing)), float(count)
    return Verdict((Check("all wires", not missing, *figures, "wires", sentence, missing=bool(missing)),))


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
        anatomy = locate(at_rest, aids)
        return {key: propose(at_rest, anatomy, side, Procedure.of(document, key).proposal) for key in missing}
    lowest = next((r.wires[0] for r in document.relations if r.relation == "inverted triangle"), "")
    if lowest not in given:
        first = f"give entry and end of the {lowest} wire first" if lowest else "pick entry and end"
        raise ReconstructionRefusedError(f"the procedure {document.key} states no rule for a proposal: {first}")
    picks, kind = given[lowest], Procedure.of(document, lowest)
    planned = plan(
        views, picks.entry_uv_px, picks.end_uv_px, snapped=picks.snapped, procedure=kind, side=side, aids=aids
    )
    return {key: wire for key, wire in propose_others(planned).items() if key in missing}


def propose_others(lowest: Plan) -> Mapping[str, Proposal]:
    """Return the two wires of an inverted triangle above the planned lowest one, by their keys.

    They are parallel to it and as far from it and from each other as the file's spacing and the drawn neck allow, the
    tips as deep below the head's surface, the entries as far from the shaft's axis. Without a drawn neck they have
    the smallest spacing; without head or shaft the ends are shifted across the wire only.

    Raises ReconstructionRefusedError where the file has no such triangle with a spacing, the side is not known, or the
    neck has no space for the wires, and OutsideRegionError where they lie outside a view's calibrated region.
    """
    document, key, side, anatomy = lowest.kind.document, lowest.kind.wire.key, lowest.side, lowest.anatomy
    triangle, low, high = _asked(document, key)
    if side is None:
        raise ReconstructionRefusedError("no wires can be proposed: the side is not given; give it")
    wire = lowest.trajectory.points.xyz_mm
    above, front = (axis[0] for axis in across_axes(lowest.trajectory.direction[None], -caudal(side)))
    spacings = np.arange(low + MARGIN_MM, high - MARGIN_MM + 1e-9, _STEP_MM)
    for spacing in spacings[::-1] if anatomy is not None and "outline" in anatomy.at else spacings[:1]:
        off = [np.sqrt(0.75) * spacing * above + way * spacing / 2 * front for way in (1.0, -1.0)]
        wires = [wire + shift if anatomy is None else _on_bone(wire, shift, anatomy) for shift in off]
        made = {key: shift for key, shift in zip(triangle.wires[1:], wires, strict=True) if shift is not None}
        if len(made) == len(wires) and all(_fits(anatomy, shift, document, side) for shift in made.values()):
            return {key: _proposal(lowest, shift, spacing) for key, shift in made.items()}
    raise ReconstructionRefusedError(
        f"neck and head have no space for wires {low + MARGIN_MM:g} mm apart above the {lowest.kind.wire.name}; move "
        "that wire to the lower border of the neck, or draw the neck's borders again"
    )


def _asked(document: ProcedureDocument, key: str) -> tuple[Relation, float, float]:
    """Return the triangle above a wire, and the limits of its spacing. Raises ReconstructionRefusedError."""
    triangles = [
        relation
        for relation in document.relations
        if relation.relation == "inverted triangle" and relation.wires[0] == key
    ]
    spacings = [relation for relation in document.relations if relation.relation == "spacing" and triangles]
    for relation in spacings:
        if set(triangles[0].wires) <= set(relation.wires) and relation.low is not None and relation.high is not None:
            return triangles[0], relation.low, relation.high
    raise ReconstructionRefusedError(
        f"no wires can be proposed beside {key!r}: the procedure {document.key} states no inverted triangle with a "
        "spacing whose lowest wire it is; plan that wire first, or pick the others"
    )


def _on_bone(wire: np.ndarray, off: np.ndarray, anatomy: Anatomy) -> np.ndarray | None:
    """Return the wire (2, 3) shifted by `off`, its ends moved along it: the entry is as far from the shaft's axis as
    that of `wire`, and the tip as far from the head's centre. None where it passes beside the shaft or the head.
    """
    along = unit(wire[1] - wire[0])
    entry, end = wire + off
    if anatomy.shaft is not None:
        (on, _), axis = anatomy.shaft.ends_mm, anatomy.shaft.direction
        slope = across(along, axis)
        radius, before = (np.linalg.norm(across(point - on, axis)) for point in (wire[0], entry))
        there = -(across(entry - on, axis) @ slope) / (slope @ slope)
        rest = there**2 - (before**2 - radius**2) / (slope @ slope)
        if rest <= 0.0:
            return None
        entry = entry + (there - np.sqrt(rest)) * along
    if anatomy.head is not None:
        centre = anatomy.head.centre_mm
        beside = across(end - centre, along)
        rest = ((wire[1] - centre) ** 2).sum() - beside @ beside
        if rest <= 0.0:
            return None
        end = centre + beside + np.sqrt(rest) * along
    return np.array([entry, end])


def _fits(anatomy: Anatomy | None, wire: np.ndarray, document: ProcedureDocument, side: str) -> bool:
    """Return True for a wire that keeps the file's distance from the neck's surface and MARGIN_MM more, or where no
    neck is drawn."""
    if anatomy is None or "outline" not in anatomy.at:
        return True
    values = anatomy.values.copy()
    values[anatomy.at["wire"]] = wire.ravel()
    least = max((rule.range[0] for rule in document.checks if rule.check == "wire in neck"), default=0.0)
    value = metric(replace(anatomy, values=values), "wire in neck", side).value
    return value is not None and value >= least + MARGIN_MM


def _proposal(lowest: Plan, wire: np.ndarray, spacing_mm: float) -> Proposal:
    pixels = np.array([view.project(wire) for view in lowest.views])
    sentence = (
        f"Proposed: parallel to the {lowest.kind.wire.name}, {spacing_mm:.1f} mm from it and from the other wire. "
        "Adjust it to the images."
    )
    return Proposal(wire[0], wire[1], pixels[:, 0], pixels[:, 1], sentence)
