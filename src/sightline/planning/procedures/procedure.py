"""A procedure: what its file says, for one of its wires."""

import json
from dataclasses import dataclass, replace
from functools import cached_property
from hashlib import sha256
from math import radians
from typing import Any, NamedTuple

from sightline.common.checks import Limits
from sightline.errors import UnusableInputError
from sightline.planning.procedures.document import AidAsked, ProcedureDocument, WireAsked
from sightline.planning.procedures.proposal_rules import ProposalRule
from sightline.planning.procedures.rules import CheckRule


def fingerprint(document: ProcedureDocument) -> str:
    """Return the identifier of a file: its key, and a hash of its content."""
    text = json.dumps(document.model_dump(mode="json", by_alias=True), sort_keys=True, separators=(",", ":"))
    return f"{document.key}#{sha256(text.encode()).hexdigest()[:16]}"


@dataclass(frozen=True)
class PlanInput:
    """One input of a plan that a person gives: `key` for files and options, `name` and `sentence` for display."""

    key: str
    name: str
    sentence: str


class ProcedureKey(NamedTuple):
    """The key of a procedure's file, and of one of its wires; "" for the only one. Written as "FILE:WIRE"."""

    file: str
    wire: str

    @staticmethod
    def of(text: str) -> "ProcedureKey":
        """Return the keys in a text."""
        file, _, wire = text.partition(":")
        return ProcedureKey(file, wire)

    def __str__(self) -> str:
        return f"{self.file}:{self.wire}" if self.wire else self.file


@dataclass(frozen=True, eq=False)
class Procedure:
    """A procedure's file, and the one of its wires that is planned.

    `limits`: those of the file, or others in their place.

    >>> procedure = sl.planning.kind("hip-screw")
    >>> procedure.limits.position_mm
    1.0
    """

    document: ProcedureDocument
    wire: WireAsked
    limits: Limits

    @staticmethod
    def of(document: ProcedureDocument, wire: str = "") -> "Procedure":
        """Return the procedure of a file for the wire of this key. Raises UnusableInputError.

        `wire` may be "" where there is one wire only.
        """
        wires = {one.key: one for one in document.wires}
        if wire not in wires and (wire or len(wires) > 1):
            names = ", ".join(f"{document.key}:{key}" for key in wires)
            raise UnusableInputError(
                f"{document.key} has {len(wires)} wires: name the wire of each entry and end, such as "
                f"'{document.wires[0].key} pa:U,V lateral:U,V', or choose one of {names}"
                if not wire
                else f"{document.key} has no wire {wire!r}; choose one of {names}"
            )
        given = document.limits
        before_mm = 0.0 if given.before_mm is None else given.before_mm.limit
        limits = Limits(given.position_mm.limit, radians(given.direction_deg.limit), given.beyond_mm.limit, before_mm)
        return Procedure(document, wires.get(wire, document.wires[0]), limits)

    @property
    def several(self) -> bool:
        """True where the file has other wires besides this one."""
        return len(self.document.wires) > 1

    @property
    def key(self) -> str:
        """Key of the file; of several wires with that of the wire, as "FILE:WIRE"."""
        return str(ProcedureKey(self.document.key, self.wire.key if self.several else ""))

    @property
    def name(self) -> str:
        """Name for display."""
        return f"{self.document.name}, {self.wire.name}" if self.several else self.document.name

    @property
    def purpose(self) -> str:
        """What is done."""
        return self.document.purpose

    @cached_property
    def fingerprint(self) -> str:
        """Identifier of the file: its key, and a hash of its content."""
        return fingerprint(self.document)

    @property
    def points(self) -> tuple[PlanInput, PlanInput]:
        """Entry and end."""
        entry, end = self.wire.entry, self.wire.end
        return PlanInput("entry", entry.name, entry.sentence), PlanInput("end", end.name, end.sentence)

    @property
    def landmarks(self) -> tuple[PlanInput, ...]:
        """Points of the bone that are picked freely in all views."""
        return tuple(PlanInput(one.key, one.name, one.sentence) for one in self.document.landmarks)

    @property
    def aids(self) -> tuple[AidAsked, ...]:
        """Drawn aids."""
        return self.document.aids

    @property
    def wire_mm(self) -> float:
        """Diameter of the wire or drill."""
        return self.wire.diameter_mm

    @property
    def checks(self) -> tuple[CheckRule, ...]:
        """Checks of the wire against the bone; they need the side, and some of landmarks and aids."""
        return self.document.checks

    @property
    def ends_before_joint(self) -> bool:
        """True where the tip must stay below a joint's surface, which then limits the depth of drilling."""
        return any(rule.check == "tip in head" for rule in self.checks)

    @property
    def proposal(self) -> ProposalRule | None:
        """The rule of a proposed wire, or None."""
        given = self.document.proposal
        if given is None:
            return None
        return ProposalRule(radians(given.angle_deg or 0.0), given.under_surface_mm or 0.0, given.rule, self.wire.key)

    def sentences(self) -> list[str]:
        """Return what a reader of a plan must know: of several wires, that the others are not in it."""
        if not self.several:
            return []
        relations = ", ".join(dict.fromkeys(one.relation for one in self.document.relations))
        said = f"This is the plan of one wire of {len(self.document.wires)}."
        return [f"{said} The relations between them ({relations or 'none'}) are not checked: plan all wires together."]

    def written(self) -> dict[str, Any]:
        """Return the file's content as JSON types."""
        return self.document.model_dump(mode="json", by_alias=True)

    def with_limits(self, limits: Limits | None) -> "Procedure":
        """Return the procedure judged by other limits, or unchanged for None."""
        return self if limits is None else replace(self, limits=limits)
