"""The SQLite file of a case: how it is opened, written in one step or not at all, and what its errors mean."""

import os
import sqlite3
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path
from urllib.parse import quote

from sightline.errors import CaseError

_WAIT_S = 10.0  # for another program that is writing: a thousand times what an entry takes [ours]
_SAID = {
    "SQLITE_FULL": "the disk is full; free some space and try again: what was recorded before is safe",
    "SQLITE_READONLY": "it cannot be written: a read-only disk or folder; copy the case to a disk that can be written",
    "SQLITE_CANTOPEN": "it cannot be opened: look whether the disk is there, and may be read and written",
    "SQLITE_BUSY": "another program keeps writing to it; close that program, or try again",
    "SQLITE_IOERR": "the disk does not take it or does not give it back (full, damaged or taken away): what was "
    "recorded before is safe; look at the disk and open the case again",
    "SQLITE_CORRUPT": "the file is damaged; keep it as it is, and go back to a copy of the case",
    "SQLITE_NOTADB": "the file is damaged, or no journal at all; keep it as it is, and go back to a copy of the case",
}


def connect(file: Path, mode: str) -> sqlite3.Connection:
    """A connection that several threads may use in turn; `mode`: rw or rwc. Commits sync. Raises sqlite3.Error."""
    db = sqlite3.connect(
        f"file:{quote(str(file.absolute()))}?mode={mode}",
        uri=True,
        timeout=_WAIT_S,
        isolation_level=None,
        check_same_thread=False,
    )
    try:
        db.execute("PRAGMA synchronous = EXTRA")  # every commit, and the folder where a journal is removed from it
        db.execute("PRAGMA fullfsync = 1")  # macOS: to the disk itself, not to its cache
    except BaseException:
        db.close()
        raise
    return db


def log_ahead(db: sqlite3.Connection) -> None:
    """Entries go to a write-ahead log first, which takes one sync an entry, not the four of a rollback journal.

    Measured (benchmarks/bench_case.py): 0.14 against 0.5 ms on an idle disk, 4 against 22 ms where others keep it busy.
    The price: while a case is open, and after a kill, its newest entries are in `journal.sqlite-wal` beside it; closing
    brings them in. Where a disk cannot do it (a network share) SQLite goes on with the rollback journal, as safe;
    likewise while another program opens the same new case, for which SQLite does not wait. The next opening changes it.
    """
    try:
        db.execute("PRAGMA journal_mode = WAL").fetchall()
    except sqlite3.OperationalError as error:
        if error.sqlite_errorcode & 0xFF != sqlite3.SQLITE_BUSY:
            raise


def in_memory(db: sqlite3.Connection) -> sqlite3.Connection:
    """A copy."""
    copy = sqlite3.connect(":memory:", isolation_level=None, check_same_thread=False)
    db.backup(copy)
    return copy


def is_damage(error: BaseException | None) -> bool:
    """Whether SQLite raised this because the file itself is damaged."""
    return getattr(error, "sqlite_errorname", "").startswith(("SQLITE_CORRUPT", "SQLITE_NOTADB"))


@contextmanager
def transaction(db: sqlite3.Connection) -> Generator[None]:
    """`with transaction(db):` all of it is written, and on the disk, or none of it is."""
    db.execute("BEGIN IMMEDIATE")
    try:
        yield
        db.execute("COMMIT")
    except BaseException:
        if db.in_transaction:
            db.execute("ROLLBACK")
        raise


@contextmanager
def said(file: Path) -> Generator[None]:
    """Turns what SQLite and the disk raise into a CaseError that says what to do."""
    try:
        yield
    except sqlite3.Error as error:
        name = getattr(error, "sqlite_errorname", "") or ""
        kind = "_".join(name.split("_")[:2])
        why = _SAID.get(kind, f"SQLite says: {error}")
        raise CaseError(f"the case in {file.parent.name or os.sep}: {why}") from error
    except OSError as error:
        raise CaseError(
            f"the case in {file.parent.name or os.sep} cannot be read or written ({error.strerror}); look at its disk "
            "and folder: what was recorded before is safe"
        ) from error
