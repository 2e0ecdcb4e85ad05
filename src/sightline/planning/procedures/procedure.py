"""A procedure: what its file says, for one of its wires. Files are shipped, in the user's folder, or at any path."""

import json
import os
import re
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cache, cached_property, lru_cache
from hashlib import sha256
from importlib.resources import files
from importlib.resources.abc import Traversable
from math import radians
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

from pydantic import ValidationError

from sightline.common.bounded import MAX_TEXT_BYTES, read_bounded
from sightline.common.checks import Limits
from sightline.common.strict import explain, read_strictly
from sightline.errors import UnusableInputError
from sightline.planning.procedures.document import AidAsked, CheckRule, ProcedureDocument, WireAsked
from sightline.planning.procedures.proposal import ProposalRule

FOLDER = "SIGHTLINE_PROCEDURES"  # environment variable: the folder of the user's files
MAX_FILES = 200  # [ours] of the user's folder: each is kept in memory once it was read
_RENAMED = {"interlocking": "distal-interlocking"}  # keys of earlier versions
# Files that had one wire in earlier versions: the wire that a plan by the file's key alone is of.
_ONLY_WIRE = {"distal-interlocking": "distal-interlocking:distal"}
ADVICE = {
    "extra_forbidden": "is not a key of a procedure's file; correct its spelling or remove it",
    "missing": "is missing; add it",
    "finite_number": "is not a finite number; write a number",
    "float_type": "is not a number; write it without quotes",
    "string_type": "is not a text; write it in quotes",
    "string_pattern_mismatch": "must be lower-case letters, digits and hyphens, at most 40, a letter first",
}


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
        wires = {asked.key: asked for asked in document.wires}
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
        return tuple(PlanInput(landmark.key, landmark.name, landmark.sentence) for landmark in self.document.landmarks)

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
        """Return what a reader of a plan must know: that the bone is not looked at, that other wires are left out."""
        said: list[str] = []
        if not self.document.checks:
            said += [
                f"No {self.document.name} is compared with the bone: nothing tells whether its ends are exchanged."
            ]
        if self.several:
            relations = ", ".join(dict.fromkeys(relation.relation for relation in self.document.relations)) or "none"
            alone = f"This is the plan of one wire of {len(self.document.wires)}."
            said += [f"{alone} The relations between them ({relations}) are not checked: plan all wires together."]
        return said

    def written(self) -> dict[str, Any]:
        """Return the file's content as JSON types."""
        return self.document.model_dump(mode="json", by_alias=True)

    def with_limits(self, limits: Limits | None) -> "Procedure":
        """Return the procedure judged by other limits, or unchanged for None."""
        return self if limits is None else replace(self, limits=limits)


@cache
def shipped() -> MappingProxyType[str, ProcedureDocument]:
    """Return the shipped files by key, the hip screw first."""
    texts = sorted(
        (file.name, file.read_bytes()) for file in _shipped_folder().iterdir() if file.name.endswith(".json")
    )
    made = {name.removesuffix(".json"): document_from_json(text) for name, text in texts}
    return MappingProxyType({"hip-screw": made["hip-screw"], **made})


def read_document(path: Path) -> ProcedureDocument:
    """Return the content of a procedure's file. Raises UnusableInputError, also for another one's shipped key."""
    try:
        document = document_from_json(read_bounded(path, MAX_TEXT_BYTES, UnusableInputError, "give a procedure's file"))
    except UnusableInputError as error:
        raise UnusableInputError(f"{path.name}: {error}") from None
    if shipped().get(document.key, document) != document:
        raise UnusableInputError(f"{path.name}: the key {document.key!r} is that of a shipped procedure; give another")
    return document


def document_from_json(text: bytes | str) -> ProcedureDocument:
    """Return the content in the text of a procedure's file. Raises UnusableInputError."""
    return read_strictly(text, ProcedureDocument, UnusableInputError, ADVICE)


def user_files(variable: str) -> dict[str, Path]:
    """Return the files in the folder that an environment variable names, by key. Raises UnusableInputError."""
    named = os.environ.get(variable)
    if named and not Path(named).is_dir():
        raise UnusableInputError(f"{variable} is {named!r}, which is not a folder; correct it, or unset it")
    paths = sorted(Path(named).glob("*.json")) if named else []
    if len(paths) > MAX_FILES:
        raise UnusableInputError(f"{variable} holds {len(paths)} files; keep at most {MAX_FILES} there")
    return {path.stem: path for path in paths}


def own_files() -> dict[str, Path]:
    """Return the files in the user's folder by key, without those whose key is shipped. Raises UnusableInputError."""
    return {key: path for key, path in user_files(FOLDER).items() if key not in shipped()}


def own_file(key: str) -> ProcedureDocument:
    """Return the content of a file in the user's folder. Raises UnusableInputError."""
    document = read_document(path := own_files()[key])
    if document.key != key:
        raise UnusableInputError(f"{path.name}: its key is {document.key!r}; name the file {document.key}.json")
    return document


def document_of(name: str) -> ProcedureDocument:
    """Return the content of the file of a key or path, as `kind` takes them. Raises UnusableInputError."""
    name = _RENAMED.get(name, name)
    return shipped()[name] if name in shipped() else _own(name)


def copy_text(name: str, key: str) -> bytes:
    """Return the text of a procedure's file with another key, in its own layout. Raises UnusableInputError."""
    old = document_of(name)
    text = _shipped_folder() / f"{old.key}.json" if old.key in shipped() else own_files().get(name, Path(name))
    copied = re.sub(rb'("key"\s*:\s*)"%b"' % old.key.encode(), rb'\1"%b"' % key.encode(), text.read_bytes(), count=1)
    if key in shipped() or document_from_json(copied).key != key:
        raise UnusableInputError(f"{key!r} is the key of a shipped procedure; name the file otherwise")
    return copied


def _own(name: str) -> ProcedureDocument:
    """Return the content of the file of a key in the user's folder, or of a path. Raises UnusableInputError."""
    return own_file(name) if name in own_files() else read_document(_path(name))


def _shipped_folder() -> Traversable:
    return files("sightline.planning.procedures") / "shipped"


def _path(name: str) -> Path:
    """Return the file of a key in the user's folder, or of a path. Raises UnusableInputError."""
    own = own_files()
    path = own.get(name, Path(name))
    if not path.is_file():
        known = ", ".join([*shipped(), *own])
        raise UnusableInputError(f"unknown procedure {name!r}; choose one of {known}, or give a procedure's file")
    return path


def kind(name: str) -> Procedure:
    """Return the procedure of this key or file: "hip-screw", "mine.json", or of several wires "KEY:WIRE".

    A shipped key takes precedence over a file of that name, and a key in the user's folder over another path.
    Raises UnusableInputError.

    >>> sl.planning.kind("free-wire").name
    'free wire'
    """
    name = current_key(name)
    if name in PROCEDURES:
        return PROCEDURES[name]
    file, _, wire = name.rpartition(":") if ":" in name and not Path(name).is_file() else (name, "", "")
    if file in shipped():
        return Procedure.of(shipped()[file], wire)
    path = _path(file)
    at = path.stat()
    return _read(file, path.resolve(), wire, at.st_mtime_ns, at.st_size)


def current_key(name: str) -> str:
    """Return the key of a procedure's wire that earlier versions named otherwise; any other name unchanged."""
    name = _RENAMED.get(name, name)
    return _ONLY_WIRE.get(name, name)


@lru_cache(maxsize=MAX_FILES)
def _read(name: str, _path: Path, wire: str, _changed_ns: int, _bytes: int) -> Procedure:
    """Return the procedure of a file, read again whenever it changed."""
    return Procedure.of(_own(name), wire)


def kept(key: str, content: dict[str, Any] | None) -> Procedure:
    """Return the procedure that a case or a saved plan keeps: its key, and the content of a file that is not shipped.

    Raises UnusableInputError.
    """
    if content is None:
        return kind(key)
    try:
        document = ProcedureDocument.model_validate_json(json.dumps(content))
    except ValidationError as error:
        raise UnusableInputError(f"the procedure {key} cannot be read: {explain(error, ADVICE)}") from None
    return Procedure.of(document, ProcedureKey.of(key).wire)


def keeping(procedure: Procedure) -> dict[str, Any] | None:
    """Return what `kept` needs besides the key: the file's content, or None for a shipped one."""
    return None if shipped().get(procedure.document.key) == procedure.document else procedure.written()


def each_wire(document: ProcedureDocument) -> list[Procedure]:
    """Return a procedure for each wire of a file."""
    return [Procedure.of(document, wire.key) for wire in document.wires]


def procedures() -> dict[str, Procedure]:
    """Return all shipped procedures and the readable ones of the user's folder by key, one for each wire.

    Raises UnusableInputError where the folder cannot be read.
    """
    own: list[ProcedureDocument] = []
    for key in own_files():
        with suppress(UnusableInputError):  # `sightline procedure list` says why
            own.append(own_file(key))
    return PROCEDURES | {procedure.key: procedure for document in own for procedure in each_wire(document)}


PROCEDURES = {procedure.key: procedure for document in shipped().values() for procedure in each_wire(document)}
