"""Plans of all wires of a procedure on the same images, and the relations between the wires, planned or measured."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Unpack

import numpy as np
from numpy.typing import ArrayLike

from sightline.calibration.solids.calibrate_together import adjusted_together
from sightline.calibration.view import CalibratedView
from sightline.common.checks import Check
from sightline.common.show import Shown, checks_lines
from sightline.common.threads import one_blas_thread
from sightline.errors import UnusableInputError
from sightline.planning.bone.axis import Axis
from sightline.planning.bone.directions import MEDIAL, towards
from sightline.planning.check.placed_wires import PlacedWire
from sightline.planning.check.result import CheckShot
from sightline.planning.nail.result import Hole
from sightline.planning.plan import Plan, SharedInputs, plan
from sightline.planning.points.picks import PickArrays, stack
from sightline.planning.points.reconstruct import reconstruct
from sightline.planning.points.results import Verdict
from sightline.planning.procedures import Procedure
from sightline.planning.procedures.document import ProcedureDocument
from sightline.planning.procedures.files import document_of
from sightline.planning.procedures.procedure import fingerprint
from sightline.planning.procedures.proposal import Proposal
from sightline.planning.verdict.relations import WireLines, judge_relations


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
            "wires": {key: one.document() for key, one in self.plans.items()},
        }

    def summary(self) -> str:
        """Return the verdict, entry and end of each wire, and the checks that failed."""
        paths = [
            f"  {one.kind.wire.name}: {line.strip()}"
            for one in self.plans.values()
            for line in one.trajectory.summary().splitlines()[1:]
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
            kind=Procedure.of(document, key),
            side=side,
            **shared,
        )
        for key in document.drilling_order
        if key in wires
    }
    holes = {key: one.axis for key, picks in wires.items() if (one := picks.hole) is not None}
    lines = _lines(views, {key: one for key, one in alone.items() if key not in holes}, {**holes, **placed})
    names = {wire.key: wire.name for wire in document.wires}
    judged = judge_relations(document.relations, lines, names, side)
    planned = _all_planned([names[key] for key in names if key not in lines.keys], len(names))
    return WirePlans(
        procedure=document,
        plans={key: one.related(_judged_of(key, document, judged)) for key, one in alone.items()},
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
    found = {key: one for key, one in placed.items() if isinstance(one, PlacedWire)}
    planned = stack([point for one in plans.values() for point in one.picks])
    each = [planned, *(one.picks.in_views(len(views)) for one in found.values())]
    picks = PickArrays(*(np.concatenate(parts, axis=1) for parts in zip(*each, strict=True)))
    methods = {one.arguments["method"] for one in plans.values()}
    points = reconstruct(views, picks.uv_px, picks.covariance_px2, methods.pop(), picks.across_px)
    others = {key: one for key, one in placed.items() if key not in found}
    return WireLines.of([*plans, *found], points, others)


def _judged_of(key: str, document: ProcedureDocument, judged: Verdict) -> tuple[Check, ...]:
    """Return the checks of a wire's relations that could be made."""
    asked = [relation for relation in document.relations if relation.relation != "order"]
    pairs = zip(asked, judged.checks, strict=True)
    return tuple(check for relation, check in pairs if key in relation.wires and not check.missing)


def _of_all(plans: Mapping[str, Plan]) -> Verdict:
    """Return the checks of all plans: those that are the same for all once, the others with the wire's name."""
    verdicts = {one.kind.wire.name: one.verdict for one in plans.values()}
    first = next(iter(verdicts.values()))
    common = [check for check in first.checks if all(check in one.checks for one in verdicts.values())]

    def named(checks: Sequence[Check], name: str) -> list[Check]:
        own = [check for check in checks if check not in common]
        return [replace(check, sentence=f"{name}: {check.sentence}") for check in own]

    checks = [*common, *(check for name, one in verdicts.items() for check in named(one.checks, name))]
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
