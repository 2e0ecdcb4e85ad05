"""Checks that a case is intact: its database, the hash chain over its entries, the originals that they name."""

import sqlite3
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from sightline.case.canonical import digest
from sightline.case.journal.entry import HEAD, entry_of_row, first_link, head_of_row, next_link, originals_in
from sightline.case.journal.originals import is_whole
from sightline.common.checks import Check
from sightline.errors import CaseError

_SHOWN = 3


def check_case(db: sqlite3.Connection, originals: Path) -> tuple[Check, ...]:
    """Return the checks of docs/refusals.md, "Checks of a case"."""
    database = _database(db)
    try:
        (number,) = db.execute("SELECT number FROM about").fetchone()
        rows = db.execute("SELECT * FROM entries ORDER BY number").fetchall()
    except (sqlite3.Error, TypeError):  # TypeError: `about` has no row
        return (database, Check("case chain", False, None, 0.0, "entries", "The entries cannot be read."))
    return database, _chain(number, rows), _originals(rows, originals)


def _database(db: sqlite3.Connection) -> Check:
    try:
        answers = [row[0] for row in db.execute(f"PRAGMA integrity_check({_SHOWN})")]
    except sqlite3.Error as error:
        answers = [str(error)]
    whole = answers == ["ok"]
    sentence = "SQLite finds the file whole." if whole else f"SQLite finds the file damaged: {'; '.join(answers)}."
    return Check("case database", whole, None, None, "", sentence)


def _chain(case_number: str, rows: Iterable[tuple[Any, ...]]) -> Check:
    """Check each entry's hash and its link to the chain. After a break the check continues from the chain value that
    the row states, so that one bad entry does not condemn those after it."""
    bad, before, expected = [], first_link(case_number), 1
    for row in rows:
        number, content, chain = row[0], row[len(HEAD)], row[len(HEAD) + 1]
        intact = digest(str(content)) == row[len(HEAD) - 1] and _readable(row)
        if not intact or number != expected or next_link(before, head_of_row(row)) != chain:
            bad.append(number)
        before, expected = chain, number + 1
    if not bad:
        sentence = f"All {expected - 1} entries are as they were recorded; the chain ends in {before[:16]}."
    else:
        sentence = f"Entry {bad[0]} or what stood before it is not what was recorded"
        sentence += f"; {len(bad)} in all." if len(bad) > 1 else "."
    return Check("case chain", not bad, float(len(bad)), 0.0, "entries", sentence)


def _readable(row: tuple[Any, ...]) -> bool:
    try:
        entry_of_row(row)
    except CaseError:
        return False
    return True


def _originals(rows: Iterable[tuple[Any, ...]], folder: Path) -> Check:
    names = sorted(set().union(*(_named(row) for row in rows)))
    wrong = [name for name in names if not _intact(folder / name)]
    if not wrong:
        sentence = f"All {len(names)} originals are there, unchanged."
    else:
        shown = ", ".join(wrong[:_SHOWN])
        sentence = f"Missing or not what they were: {shown}{' and more' if len(wrong) > _SHOWN else ''}."
    return Check("case originals", not wrong, float(len(wrong)), 0.0, "files", sentence)


def _named(row: tuple[Any, ...]) -> set[str]:
    try:
        return originals_in(str(row[len(HEAD)])) | originals_in(str(row[HEAD.index("settings")]))
    except CaseError:
        return set()  # the check of the chain reports a damaged entry


def _intact(path: Path) -> bool:
    try:
        return is_whole(path)
    except OSError:
        return False
