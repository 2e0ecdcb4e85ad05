"""The journal's tables, their version, and the migration of older versions."""

import secrets
import sqlite3
from pathlib import Path

from sightline.case.canonical import digest
from sightline.case.journal.database import connect, transaction
from sightline.case.journal.entry import next_link
from sightline.case.journal.rows import HEAD, first_link, head_of_row
from sightline.common.atomic import sync_folder
from sightline.errors import CaseError

APPLICATION = 0x51674C6E  # "QgLn": distinguishes a case from other SQLite files
VERSION = 1
# Without I, L, O and U, which people misread [Crockford's base 32].
_LETTERS = "0123456789ABCDEFGHJKMNPQRSTVWXYZ"
_NUMBER_LENGTH = 12  # 60 bits: among a million cases the probability of a collision is 4e-7

_TABLES = f"""
CREATE TABLE about (number TEXT NOT NULL);
CREATE TABLE entries (
    number INTEGER PRIMARY KEY,
    {", ".join(f"{column} TEXT NOT NULL" for column in HEAD[1:])},
    content TEXT NOT NULL,
    chain TEXT NOT NULL
);
CREATE INDEX of_kind ON entries (kind, number);
CREATE TRIGGER never_changed BEFORE UPDATE ON entries BEGIN SELECT RAISE(ABORT, 'entries are never changed'); END;
CREATE TRIGGER never_removed BEFORE DELETE ON entries BEGIN SELECT RAISE(ABORT, 'entries are never removed'); END;
"""


def create(db: sqlite3.Connection) -> bool:
    """Create a new case's tables in one transaction, unless there are tables; return whether they were created.

    If two programs create a case at the same time, SQLite's lock decides. Renaming a finished file into place would not
    be safe: it could replace a journal in which the other program has already recorded entries.
    """
    with transaction(db):
        new = not has_tables(db)
        if new:
            _build(db, "-".join(["C", *_groups(_NUMBER_LENGTH)]))
    return new


def check_version(db: sqlite3.Connection) -> int:
    """Return the schema version of the file. Raises CaseError if it is not a case or its version is newer."""
    if not has_tables(db):
        raise CaseError("there is no case in this folder; create one, or name the folder of a case")
    application, version = (db.execute(f"PRAGMA {name}").fetchone()[0] for name in ("application_id", "user_version"))
    if application != APPLICATION:
        raise CaseError("journal.sqlite in this folder is not the journal of a case; name the folder of a case")
    if version > VERSION:
        raise CaseError(
            f"this case was written by a newer Sightline (schema {version}, this one reads up to {VERSION}); open it "
            "with the newer one"
        )
    return version


def refuse_unwritable(db: sqlite3.Connection) -> None:
    """Write and roll back, so that a case that cannot be written is refused on opening, not at the first entry."""
    db.execute("BEGIN IMMEDIATE")
    try:
        db.execute(f"PRAGMA user_version = {VERSION}")
    finally:
        if db.in_transaction:
            db.execute("ROLLBACK")


def migrate(db: sqlite3.Connection) -> None:
    """Migrate an older version to this one in one transaction."""
    with transaction(db):
        if check_version(db) == 0:
            _from_0(db)


def back_up(db: sqlite3.Connection, file: Path) -> None:
    """Copy the journal to `file`; the copy is on the disk when this returns."""
    copy = connect(file, "rwc")
    try:
        db.backup(copy)
    finally:
        copy.close()
    sync_folder(file.parent)


def _from_0(db: sqlite3.Connection) -> None:
    """Add the hashes and the chain, which version 0 did not have."""
    (number,) = db.execute("SELECT number FROM about").fetchone()
    columns = [column for column in HEAD if column != "content_sha256"]
    rows = db.execute(f"SELECT {', '.join(columns)}, content FROM entries ORDER BY number").fetchall()  # noqa: S608
    db.execute("DROP TABLE entries")
    db.execute("DROP TABLE about")
    _build(db, number)
    chain = first_link(number)
    for *head, content in rows:
        row = (*head, digest(content))
        chain = next_link(chain, head_of_row(row))
        insert(db, (*row, content, chain))


def insert(db: sqlite3.Connection, row: tuple[object, ...]) -> None:
    """Insert a row of `entries`: the columns of HEAD, content, chain."""
    db.execute(f"INSERT INTO entries VALUES ({', '.join('?' * len(row))})", row)  # noqa: S608 - question marks only


def _build(db: sqlite3.Connection, number: str) -> None:
    for statement in _statements():
        db.execute(statement)
    db.execute("INSERT INTO about VALUES (?)", (number,))
    db.execute(f"PRAGMA application_id = {APPLICATION}")
    db.execute(f"PRAGMA user_version = {VERSION}")


def _statements() -> list[str]:
    """Split `_TABLES` into statements, because `executescript` would commit the transaction first."""
    out, text = [], ""
    for line in _TABLES.strip().splitlines():
        text += line + "\n"
        if sqlite3.complete_statement(text):
            out.append(text)
            text = ""
    return out


def has_tables(db: sqlite3.Connection) -> bool:
    """Whether anything was written: a program killed while it creates a case leaves an empty file."""
    return db.execute("SELECT count(*) FROM sqlite_master").fetchone()[0] > 0


def _groups(length: int) -> list[str]:
    text = "".join(secrets.choice(_LETTERS) for _ in range(length))
    return [text[k : k + 4] for k in range(0, length, 4)]
