"""The SQLite file of a case: connections, transactions, and error messages that say what to do."""

import os
import sqlite3
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path
from urllib.parse import quote

from sightline.errors import CaseError

_WAIT_S = 10.0  # for another program's transaction: a thousand times the time of one entry [ours]
_MESSAGES = {
    "SQLITE_FULL": "the disk is full; free some space and try again: entries already recorded are safe",
    "SQLITE_READONLY": "it cannot be written: the disk or folder is read-only; copy the case to a writable disk",
    "SQLITE_CANTOPEN": "it cannot be opened; check that the disk is there and that you may read and write it",
    "SQLITE_BUSY": "another program keeps writing to it; close that program, or try again",
    "SQLITE_IOERR": "disk read or write error (the disk is full, damaged or removed); check the disk and open the case "
    "again: entries already recorded are safe",
    "SQLITE_CORRUPT": "the file is damaged; keep it as it is, and go back to a copy of the case",
    "SQLITE_NOTADB": "the file is damaged or is not a journal; keep it as it is, and go back to a copy of the case",
}


def connect(file: Path, mode: str) -> sqlite3.Connection:
    """Open a connection that several threads may use in turn; `mode`: rw or rwc. A commit waits until its data is on
    the disk. Raises sqlite3.Error."""
    db = sqlite3.connect(
        f"file:{quote(str(file.absolute()))}?mode={mode}",
        uri=True,
        timeout=_WAIT_S,
        isolation_level=None,
        check_same_thread=False,
    )
    try:
        db.execute("PRAGMA synchronous = EXTRA")  # sync every commit, and the folder after a journal file is removed
        db.execute("PRAGMA fullfsync = 1")  # macOS: flush the disk's own cache too
    except BaseException:
        db.close()
        raise
    return db


def use_write_ahead_log(db: sqlite3.Connection) -> None:
    """Switch the database to a write-ahead log, which needs one sync per entry; a rollback journal needs four.

    Measured (benchmarks/bench_case.py): 0.14 ms instead of 0.5 ms per entry on an idle disk, 4 ms instead of 22 ms on a
    busy one. While a case is open, and after its program was killed, its newest entries are in `journal.sqlite-wal`;
    closing the case moves them into the journal. SQLite keeps the rollback journal, which is as safe, on disks that
    cannot use the log (a network share), and while another program opens the same new case; the next opening switches.
    """
    try:
        db.execute("PRAGMA journal_mode = WAL").fetchall()
    except sqlite3.OperationalError as error:
        if error.sqlite_errorcode & 0xFF != sqlite3.SQLITE_BUSY:
            raise


def memory_copy(db: sqlite3.Connection) -> sqlite3.Connection:
    """Return a copy of the database in memory."""
    copy = sqlite3.connect(":memory:", isolation_level=None, check_same_thread=False)
    db.backup(copy)
    return copy


def is_damage(error: BaseException | None) -> bool:
    """Whether SQLite raised this error because the file is damaged."""
    return getattr(error, "sqlite_errorname", "").startswith(("SQLITE_CORRUPT", "SQLITE_NOTADB"))


@contextmanager
def transaction(db: sqlite3.Connection) -> Generator[None]:
    """Context in which either all statements are committed to the disk, or none."""
    db.execute("BEGIN IMMEDIATE")
    try:
        yield
        db.execute("COMMIT")
    except BaseException:
        if db.in_transaction:
            db.execute("ROLLBACK")
        raise


@contextmanager
def errors_explained(file: Path) -> Generator[None]:
    """Context that turns errors of SQLite and the disk into a CaseError that says what to do."""
    try:
        yield
    except sqlite3.Error as error:
        name = getattr(error, "sqlite_errorname", "") or ""
        kind = "_".join(name.split("_")[:2])
        why = _MESSAGES.get(kind, f"SQLite says: {error}")
        raise CaseError(f"the case in {file.parent.name or os.sep}: {why}") from error
    except OSError as error:
        raise CaseError(
            f"the case in {file.parent.name or os.sep} cannot be read or written ({error.strerror}); check its disk "
            "and folder: entries already recorded are safe"
        ) from error
