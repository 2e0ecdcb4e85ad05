"""`sightline case`: check a case, compute it again, list its entries, write its report."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from sightline.cli.base import Output, command, group
from sightline.common.checks import Check

if TYPE_CHECKING:
    from sightline.case.journal import Entry
    from sightline.case.replay import Replayed

Folder = Annotated[Path, typer.Argument(metavar="DIR", help="Folder of the case.")]
_SHOWN = 3  # differences of an entry shown to people

app = group("case", "Check, replay, list or report a case.")


@command(app, "check", "sightline case check out/demo/case")
def check(output: Output, folder: Folder) -> None:
    """Check that a case is complete and unchanged.

    Checks the database, the chain of entries and the original files. Exit code 3 if a check fails.
    """
    document, checks = _checked(folder)
    if document:
        output.say(f"case {document['case']}, {document['entries']} entries")
    output.result(document, checks)


@command(app, "replay", "sightline case replay out/demo/case")
def replay(output: Output, folder: Folder) -> None:
    """Compute every entry again from the original files.

    Says which entries are bit-identical and which differ. Exit code 3 if one differs.
    """
    from sightline.case.journal import Case
    from sightline.case.replay import judge
    from sightline.case.replay import replay as computed_again

    with Case.open(folder, read_only=True) as case:
        replayed, problems, number = [], case.problems, case.number
        with output.progress("computing again", case.last) as advance:
            for entry in computed_again(case):
                replayed.append(entry)
                advance()
    output.table(f"Case {number}, computed again", ("entry", "", "outcome"), [_row(entry) for entry in replayed])
    for change in sorted({change for entry in replayed for change in entry.changed}):
        output.say(f"computed with other versions: {change}")
    document = {"case": number, "entries": [_document(entry) for entry in replayed]}
    output.result(document, (*problems, judge(replayed)))


@command(app, "show", "sightline case show out/demo/case")
def show(output: Output, folder: Folder) -> None:
    """List the entries of a case.

    For each entry: when, what, by whom, and the entries it was made from.
    """
    from sightline.case.journal import Case

    with Case.open(folder, read_only=True) as case:
        entries, number, problems = case.entries(), case.number, case.problems
    rows = [
        (
            entry.number,
            f"{entry.at:%Y-%m-%d %H:%M:%S}",
            entry.kind,
            entry.by,
            ", ".join(map(str, entry.rests_on)),
            _gist(entry),
        )
        for entry in entries
    ]
    output.table(f"Case {number}", ("entry", "UTC", "kind", "by", "rests on", ""), rows)
    document = [{**vars(entry), "at": entry.at.isoformat()} for entry in entries]
    output.result({"case": number, "entries": document}, problems)


@command(app, "report", "sightline case report out/demo/case --out out/report")
def report(
    output: Output,
    *,
    folder: Folder,
    out: Annotated[Path, typer.Option(help="Folder for report.html and report.json.")],
) -> None:
    """Write the report of the last plan in a case.

    It is a page, which a browser prints on paper or as PDF, and JSON. The plan is computed again from the originals.
    The report names the case by its number alone.
    """
    from sightline.case.journal import Case
    from sightline.case.report.content import report_of
    from sightline.case.report.document import report_document
    from sightline.case.report.page import render
    from sightline.common.atomic import write_folder

    with Case.open(folder, read_only=True) as case:
        with output.step("computing the last plan again"):
            made = report_of(case)
        number = case.number
    with output.step("writing the report"):
        document = report_document(made, number)
        pages = {
            "report.html": render(made).encode(),
            "report.json": document.model_dump_json(indent=1).encode(),
        }
        files = write_folder(out, pages)
    for file in files:
        output.say(f"written: {file}")
    output.result({"case": number, "go": made.plan.verdict.go, "files": files})


def _checked(folder: Path) -> tuple[dict[str, Any], tuple[Check, ...]]:
    """Return the document of a case and its checks; a database too damaged to open is a failed check, not an error."""
    from sightline.case.journal import Case
    from sightline.case.journal.database import is_damage
    from sightline.errors import CaseError

    try:
        with Case.open(folder, read_only=True) as case:
            last = case.entries(after=case.last - 1)
            document = {"case": case.number, "entries": case.last, "chain": last[0].chain if last else None}
            return document, case.checks
    except CaseError as error:
        if not is_damage(error.__cause__):
            raise
        return {}, (Check("case database", False, None, None, "", f"{error}."),)


def _row(replayed: "Replayed") -> tuple[str, str, str]:
    lines = [f"{replayed.said}{f': {replayed.reason}' if replayed.reason else ''}"]
    lines += [f"{d.where}: {d.then} -> {d.now}" for d in replayed.differences[:_SHOWN]]
    if len(replayed.differences) > _SHOWN:
        lines.append(f"and {len(replayed.differences) - _SHOWN} more")
    return str(replayed.entry.number), replayed.entry.kind, "\n".join(lines)


def _document(replayed: "Replayed") -> dict[str, Any]:
    from sightline.case.replay import largest

    return {
        "entry": replayed.entry.number,
        "kind": replayed.entry.kind,
        "outcome": replayed.said,
        "reason": replayed.reason or None,
        "versions": replayed.changed,
        "largest_change": {unit: largest(replayed.differences, unit) for unit in ("px", "mm")},
        "differences": replayed.differences,
    }


def _gist(entry: "Entry") -> str:
    """Return an entry's content in a few words."""
    content = entry.content
    words = [str(content[key]) for key in ("view", "method", "what") if isinstance(content.get(key), str)]
    if "uv_px" in content:
        words.append(f"{len(content['uv_px'])} beads")
    if isinstance(content.get("go"), bool):
        words.append("GO" if content["go"] else "NO-GO")
    if "original" in content:
        words.append(f"{content['original'][:12]}…")
    return " ".join(words)
