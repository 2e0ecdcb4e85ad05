"""The aids that the checks of a plan still need."""

from collections.abc import Sequence
from itertools import chain

from sightline.app import texts
from sightline.app.plan.planner import Planned
from sightline.checks import Code
from sightline.planning.points.results import Verdict
from sightline.planning.procedures import Procedure
from sightline.planning.procedures.rules import CHECKS

_OF_BONE = {Code.VIEW_DIRECTIONS: 2, Code.SIDE: 3}  # directions of the bone that a check takes from the procedure


def needed_aids(known: Planned, verdict: Verdict) -> tuple[str, ...]:
    """Return the keys of the aids that are not drawn and without which checks of a verdict cannot be made, in the order
    of the procedure."""
    kind, unmade = known.kind, {check.code for check in verdict.unmade}
    needs = {"head"} if Code.HEAD in unmade else set[str]()
    for rule in kind.checks:
        if rule.code in unmade:
            needs.update(*CHECKS[rule.check].needs[:1])
    if known.decisions.side is not None:  # else that is what these two wait for
        needs.update(*(_of_bone(kind, count) for code, count in _OF_BONE.items() if code in unmade))
    return tuple(aid.key for aid in kind.aids if aid.key in needs and known.anatomy.undrawn(aid.key))


def _of_bone(kind: Procedure, count: int) -> set[str]:
    """Return the keys that the first directions of the bone are made of; none where the procedure has fewer."""
    directions = kind.document.directions
    if len(directions) < count:
        return set()
    return set(chain.from_iterable((*one.from_, *one.to, one.along or "") for one in directions[:count]))


def aid_labels(kind: Procedure, keys: Sequence[str]) -> tuple[str, ...]:
    """Return the names of aids, by their keys."""
    names = {aid.key: texts.titled(aid.name) for aid in kind.aids}
    return tuple(names[key] for key in keys)
