"""`sightline procedure list | show | check | new`."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sightline.cli.base import Output, command, group

if TYPE_CHECKING:
    from sightline.planning.procedures.document import CheckRule, ProcedureDocument, Relation

app = group("procedure", "List, show, check and make procedures.")

ProcedureSource = Annotated[str, typer.Argument(metavar="PROCEDURE", help="A key of the list, or a procedure's file.")]


@command(app, "list", "sightline procedure list")
def list_all(output: Output) -> None:
    """List the shipped procedures and your own.

    Your own files lie in the folder that the environment variable SIGHTLINE_PROCEDURES names, each called KEY.json.
    """
    from sightline.errors import UnusableInputError
    from sightline.planning.procedures.procedure import own_file, own_files, shipped

    rows = [(document, "shipped") for document in shipped().values()]
    unusable: dict[str, str] = {}
    for key, path in own_files().items():
        try:
            rows.append((own_file(key), str(path)))
        except UnusableInputError as error:
            unusable[key] = str(error)
    output.table(
        "Procedures",
        ("key", "name", "wires", "file"),
        [(listed_one.key, listed_one.name, len(listed_one.wires), where) for listed_one, where in rows],
    )
    for why in unusable.values():
        output.note(f"left out: {why}")
    listed = [
        {"key": listed_one.key, "name": listed_one.name, "wires": len(listed_one.wires), "file": where}
        for listed_one, where in rows
    ]
    output.result({"procedures": listed, "unusable": unusable})


@command(app, "show", "sightline procedure show hip-screw")
def show(output: Output, procedure: ProcedureSource) -> None:
    """Show points, limits, checks and their sources."""
    from sightline.planning.procedures.procedure import document_of, fingerprint

    document = document_of(procedure)
    _show(output, document)
    output.result({"fingerprint": fingerprint(document), **document.model_dump(mode="json", by_alias=True)})


@command(app, "check", "sightline procedure check mine.json")
def check(output: Output, file: Annotated[Path, typer.Argument(help="The procedure's file.")]) -> None:
    """Check a procedure's file.

    Exit code 2 with a sentence for what is wrong in it; otherwise what it asks for, and what no check shows.
    """
    from sightline.planning.procedures.document import open_ends
    from sightline.planning.procedures.procedure import fingerprint, read_document

    document = read_document(file)
    ends = open_ends(document)
    idle = [f"corridor: no check shows whether the {end} leaves the bone" for end in ends]
    if not document.directions and any(reason.check == "view directions" for reason in document.checks):
        idle.append("view directions with a block: state 'directions' of the bone, which tell how the patient lies")
    output.say(f"{file.name} is a procedure: {document.name}, {len(document.checks)} checks of the bone")
    for reason in idle:
        output.say(f"not evaluated: {reason}")
    output.result({"file": file, "key": document.key, "fingerprint": fingerprint(document), "not_evaluated": idle})


@command(app, "new", "sightline procedure new mine.json --like hip-screw")
def new(
    output: Output,
    *,
    file: Annotated[Path, typer.Argument(help="The file to write; its name without .json becomes the key.")],
    like: Annotated[str, typer.Option(help="The procedure to copy: a key of the list, or a file.")],
) -> None:
    """Write a procedure's file like another one, to be edited."""
    from sightline.common.atomic import write_whole
    from sightline.errors import UnusableInputError
    from sightline.planning.procedures.procedure import copy_text

    if file.suffix != ".json":
        raise UnusableInputError(f"only files ending in .json are found as procedures: name it {file.name}.json")
    if file.exists():
        raise UnusableInputError(f"{file.name} exists; remove it, or name another file")
    write_whole(file, copy_text(like, file.stem))
    output.say(f"written: {file}")
    output.say(f"edit it, then: sightline procedure check {file}")
    output.result({"file": file, "key": file.stem})


def _show(output: Output, document: "ProcedureDocument") -> None:
    output.say(f"{document.name} ({document.key}): {document.purpose}")
    output.table(
        "Views, in the order of the images",
        ("view", "orbit °", "tilt °", "within °", "purpose"),
        [(v.name, f"{v.orbit_deg:g}", f"{v.tilt_deg:g}", f"{v.within_deg:g}", v.purpose) for v in document.views],
    )
    points = [
        (f"{wire.key}: {name}", point.name, point.sentence)
        for wire in document.wires
        for name, point in (("entry", wire.entry), ("end", wire.end))
    ]
    points += [(f"landmark {item.key}", item.name, item.sentence) for item in document.landmarks]
    points += [(f"{item.type} {item.key}", item.name, item.sentence) for item in document.aids]
    output.table("What a person picks and draws", ("key", "name", "where"), points)
    wires = [(f"wire {item.key}", "diameter", f"{item.diameter_mm:g} mm", "") for item in document.wires]
    limits = [
        (f"limit {name}", "", f"{item.limit:.4g}", item.source)
        for name, item in ((name, getattr(document.limits, name)) for name in type(document.limits).model_fields)
        if item is not None
    ]
    relations = [
        (f"relation {item.relation}", ", ".join(item.wires), _range(item), item.source) for item in document.relations
    ]
    directions = [
        (
            f"direction {item.label}",
            item.along or "",
            f"orbit {item.orbit_deg:g}°, tilt {item.tilt_deg:g}°",
            item.source,
        )
        for item in document.directions
    ]
    checks = [
        (f"check {item.check}", "required" if item.optional is None else "optional", _range(item), _why(item))
        for item in document.checks
    ]
    output.table(
        "Wires, limits, relations and checks",
        ("what", "of", "accepted", "source"),
        [*wires, *limits, *relations, *directions, *checks],
    )
    if (catalogue := document.catalogue) is not None:
        lengths = catalogue.lengths_mm
        output.say(
            f"{catalogue.implants}: {len(lengths)} lengths of {lengths[0]:g} to {lengths[-1]:g} mm, diameter "
            f"{', '.join(f'{mm:g}' for mm in catalogue.diameters_mm)} mm ({catalogue.source})"
        )


def _why(rule: "CheckRule") -> str:
    """Return the source of a check's limits, and why a plan may do without it."""
    return rule.source if rule.optional is None else f"{rule.source}; optional: {rule.optional}"


def _range(limited: "CheckRule | Relation") -> str:
    """Return the accepted values in words."""
    if limited.low is None:
        return "" if limited.high is None else f"to {limited.high:g}"
    return f"from {limited.low:g}" if limited.high is None else f"{limited.low:g} to {limited.high:g}"
