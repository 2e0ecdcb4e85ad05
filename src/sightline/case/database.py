"""The SQLite file of a case: how it is opened, written in one step or not at all, and what its errors mean."""

import os
import sqlite3
from collections.abc import Iterator
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
    """A connection that several threads may use in turn; `mode`: ro, rw or rwc. Raises CaseError.

    A rollback journal, synced at every commit: when `record` returns, the entry is on the disk. A write-ahead log
    would take one sync instead of four (0.14 ms an entry instead of 0.5 [measured, benchmarks/bench_case.py]), but the
    newest entries would lie in a second file, which whoever copies the case may forget, and which a read-only disk
    hides. So the journal is one whole file between any two entries.
    """
    with said(file):
        db = sqlite3.connect(
            f"file:{quote(str(file.absolute()))}?mode={mode}",
            uri=True,
            timeout=_WAIT_S,
            isolation_level=None,
            check_same_thread=False,
        )
        try:
            if mode != "ro":
                db.execute("PRAGMA journal_mode = TRUNCATE").fetchall()
                db.execute("PRAGMA synchronous = FULL")
                db.execute("PRAGMA fullfsync = 1")  # macOS: to the platter, not to the drive's cache
        except BaseException:
            db.close()
            raise
        return db


def is_damage(error: BaseException | None) -> bool:
    """Whether SQLite raised this because the file itself is damaged."""
    return getattr(error, "sqlite_errorname", "").startswith(("SQLITE_CORRUPT", "SQLITE_NOTADB"))


@contextmanager
def transaction(db: sqlite3.Connection) -> Iterator[None]:
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
def said(file: Path) -> Iterator[None]:
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
