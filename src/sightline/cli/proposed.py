"""`sightline plan --propose`: the wires that a person did not pick, by the procedure's rule."""

from collections.abc import Collection, Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from sightline.calibration.view import CalibratedView
    from sightline.planning import Aids, Procedure, WirePicks


def wires_to_propose(procedure: str, picked: Collection[str], *, propose: bool) -> tuple[str, ...]:
    """Return the keys of the wires to propose; "" for a wire alone.

    Raises UnusableInputError where nothing is picked or to be proposed, or for an unknown procedure.
    """
    from sightline.errors import UnusableInputError
    from sightline.planning.procedures.files import document_of

    if not propose:
        if not picked:
            raise UnusableInputError(
                "give --entry and --end of each wire, or for the holes of a nail --hole, or --propose"
            )
        return ()
    document = None if ":" in procedure else document_of(procedure)
    keys = ("",) if document is None or len(document.wires) == 1 else document.drilling_order
    missing = tuple(key for key in keys if key not in picked)
    if not missing or (missing == ("",) and picked):
        raise UnusableInputError("all wires have --entry and --end; leave --propose out")
    return missing


def with_proposals(
    picked: "dict[str, WirePicks]",
    unpicked: Sequence[str],
    known: "Procedure",
    views: "Sequence[CalibratedView]",
    *,
    aids: "Aids | None",
    side: str | None,
) -> "tuple[dict[str, WirePicks], list[str]]":
    """Return the picks of all wires by key, with those of proposed ones, and a sentence on each of these.

    Raises what `propose_wires` raises.
    """
    from sightline.planning import Aids, WirePicks, propose_wires

    if not unpicked:
        return picked, []
    made = propose_wires(views, known.document, aids or Aids(), side, picked)
    proposed = {name: made[name or known.wire.key] for name in unpicked}
    picks = {name: WirePicks.of_proposal(one) for name, one in proposed.items()}
    return picked | picks, [f"{name} {one.sentence}".strip() for name, one in proposed.items()]
