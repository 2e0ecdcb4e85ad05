"""A case: the append-only record of one patient's procedure, in one folder (docs/case.md)."""

import sqlite3
from collections.abc import Generator, Mapping, Sequence
from contextlib import closing, contextmanager
from datetime import UTC, datetime
from enum import StrEnum
from pathlib import Path
from threading import RLock
from typing import Any, TypeVar

from sightline.case.canonical import canonical, digest
from sightline.case.journal import database, originals
from sightline.case.journal.database import (
    closed_on_error,
    connect,
    errors_explained,
    memory_copy,
    transaction,
    use_write_ahead_log,
)
from sightline.case.journal.entry import (
    HEAD,
    Actor,
    Entry,
    Kind,
    entry_of_row,
    first_link,
    head_of_row,
    next_link,
    originals_in,
    versions,
)
from sightline.case.journal.integrity import check_case
from sightline.common.atomic import scratch_folder, sync_folder
from sightline.common.checks import Check, failed
from sightline.common.closing import Closing
from sightline.errors import CaseError, OvertakenError

JOURNAL = "journal.sqlite"
_Named = TypeVar("_Named", bound=StrEnum)


class Case(Closing):
    """One folder: `journal.sqlite` and `originals/`. Made by `create` or `open`; several threads may use it.

    `number`: random, the only identity that leaves the case. `checks`: made on opening; `problems`: those that failed.
    A damaged case can be read and written as far as possible; nothing is repaired without the user's knowledge.
    """

    def __init__(self, folder: Path, db: sqlite3.Connection) -> None:
        self.folder, self._db, self._lock = folder, db, RLock()
        with self._reading():
            row = db.execute("SELECT number FROM about").fetchone()
        self.number: str = str(row[0]) if row else "unknown"
        self.checks: tuple[Check, ...] = self.check()

    @staticmethod
    def create(folder: str | Path, *, exist_ok: bool = False) -> "Case":
        """Create a case, and its folder if it is missing. An empty journal, left by a killed program, is not a case.

        Raises CaseError if there is a case already; with `exist_ok` that case is opened.
        """
        place = Path(folder)
        if exist_ok and Case.exists(place):
            return Case.open(place)
        with errors_explained(place / JOURNAL):
            (place / originals.FOLDER).mkdir(parents=True, exist_ok=True)
            db = connect(place / JOURNAL, "rwc")
            with closed_on_error(db):
                if not database.create(db):
                    if not exist_ok:
                        raise CaseError("there is a case in this folder already; open it, or name another folder")
                    db.close()
                    return Case.open(place)
                use_write_ahead_log(db)
                sync_folder(place)
                sync_folder(place.absolute().parent)
                return Case(place, db)

    @staticmethod
    def exists(folder: str | Path) -> bool:
        """Whether the folder holds a case, of any version. An empty journal is not a case. Raises CaseError."""
        file = Path(folder) / JOURNAL
        if not file.is_file():
            return False
        with errors_explained(file), closing(_readable(file)) as db:
            return database.has_tables(db)

    @staticmethod
    def open(folder: str | Path, read_only: bool = False) -> "Case":
        """Open an existing case. A transaction that a killed program left unfinished is rolled back.

        A case of an older version is migrated after its journal was copied; with `read_only` a migrated copy is read.
        Raises CaseError if there is no case, or it cannot be opened.
        """
        file = Path(folder) / JOURNAL
        if not file.is_file():
            raise CaseError(f"there is no case in {Path(folder).name!r}; name the folder that holds its {JOURNAL}")
        with errors_explained(file):
            db = _read_only(file) if read_only else _writable(file)
            with closed_on_error(db):
                return Case(Path(folder), db)

    def close(self) -> None:
        """Close the database. Without it nothing is lost: every entry is on the disk when `record` returns."""
        with self._lock:
            self._db.close()

    @property
    def problems(self) -> tuple[Check, ...]:
        """The checks that failed on opening; empty if the case is intact."""
        return failed(self.checks)

    def check(self) -> tuple[Check, ...]:
        """Check now whether the case is intact."""
        with self._lock:
            return check_case(self._db, self.folder / originals.FOLDER)

    @property
    def last(self) -> int:
        """The number of the last entry; 0 if there is none."""
        with self._reading():
            return self._db.execute("SELECT coalesce(max(number), 0) FROM entries").fetchone()[0]

    def keep(self, data: bytes, suffix: str) -> str:
        """Keep a file unchanged and return its name in the case. It is on the disk when this returns.

        Keeping the same bytes again changes nothing. Raises CaseError.
        """
        name = originals.name_of(data, suffix)
        with errors_explained(self.folder / JOURNAL):
            originals.keep(self.folder / originals.FOLDER, name, data)
        return name

    def original(self, name: str) -> Path:
        """Return the file of an original. Raises CaseError if there is none of this name."""
        return originals.path_of(self.folder / originals.FOLDER, name)

    def record(
        self,
        kind: Kind,
        content: Mapping[str, Any],
        *,
        by: Actor,
        rests_on: Sequence[int] = (),
        settings: Mapping[str, Any] | None = None,
        expect: int | None = None,
    ) -> Entry:
        """Append an entry; it is on the disk when this returns. Pass the number of the last entry you have seen as
        `expect` for optimistic locking: the call fails if another entry came first.

        Raises OvertakenError if `expect` is not the last entry; CaseError if `content` or `settings` is not JSON or
        names a file that is not kept, if `rests_on` names no earlier entry, and on a disk error. Then nothing was
        appended.
        """
        what, who = _one_of(Kind, kind), _one_of(Actor, by)
        texts = [canonical(dict(value)) for value in (content, settings or {})]
        for name in sorted(originals_in(texts[0]) | originals_in(texts[1])):
            self.original(name)
        with self._reading(), transaction(self._db):
            last, before = self._tail()
            if expect is not None and expect != last:
                raise OvertakenError(
                    f"entry {last} was recorded meanwhile, but the last one expected is {expect}; look at the new one "
                    "first"
                )
            if not all(isinstance(number, int) and 1 <= number <= last for number in rests_on):
                raise CaseError(f"an entry must rest on earlier entries, 1 to {last}, not on {list(rests_on)}")
            at = datetime.now(UTC).isoformat(timespec="microseconds")
            head = (last + 1, what.value, at, who.value, canonical(versions()), texts[1])
            head = (*head, canonical(list(rests_on)), digest(texts[0]))
            row = (*head, texts[0], next_link(before, head_of_row(head)))
            database.insert(self._db, row)
        return entry_of_row(row)

    def entry(self, number: int) -> Entry:
        """Return the entry of this number. Raises CaseError if there is none."""
        entries = self._select("WHERE number = ?", (number,))
        if not entries:
            raise CaseError(f"the case has no entry {number}; it has 1 to {self.last}")
        return entries[0]

    def entries(self, kind: Kind | None = None, after: int = 0) -> list[Entry]:
        """Return the entries in order: those of `kind`, or of all kinds, with a number larger than `after`."""
        if kind is None:
            return self._select("WHERE number > ? ORDER BY number", (after,))
        return self._select("WHERE kind = ? AND number > ? ORDER BY number", (_one_of(Kind, kind).value, after))

    def latest(self, kind: Kind, where: Mapping[str, Any] | None = None) -> Entry | None:
        """Return the last entry of a kind whose content has the items of `where`; None if there is none."""
        wanted = (where or {}).items()
        entries = self.entries(kind)
        return next((entry for entry in reversed(entries) if all(entry.content.get(k) == v for k, v in wanted)), None)

    def _tail(self) -> tuple[int, str]:
        """Return the number and chain hash of the last entry."""
        row = self._db.execute("SELECT number, chain FROM entries ORDER BY number DESC LIMIT 1").fetchone()
        return row or (0, first_link(self.number))

    def _select(self, condition: str, values: tuple[Any, ...]) -> list[Entry]:
        columns = ", ".join((*HEAD, "content", "chain"))
        with self._reading():
            rows = self._db.execute(f"SELECT {columns} FROM entries {condition}", values).fetchall()  # noqa: S608
        return [entry_of_row(row) for row in rows]

    @contextmanager
    def _reading(self) -> Generator[None]:
        with self._lock, errors_explained(self.folder / JOURNAL):
            yield


def _one_of(names: type[_Named], name: str) -> _Named:
    """Return the member of this name. Raises CaseError if there is none."""
    try:
        return names(name)
    except ValueError:
        raise CaseError(
            f"{name!r} is not one of {', '.join(names)}; a case accepts no other name, and no person's name"
        ) from None


def _writable(file: Path) -> sqlite3.Connection:
    db = connect(file, "rw")
    with closed_on_error(db):
        version = database.check_version(db)
        database.refuse_unwritable(db)
        if version < database.VERSION:
            database.back_up(db, file.with_name(f"journal-schema-{version}.sqlite"))
            database.migrate(db)
        use_write_ahead_log(db)
    return db


def _read_only(file: Path) -> sqlite3.Connection:
    """Open a journal for reading. SQLite writes beside the file even to read it: from a read-only folder, and for an
    older version, a copy in memory is read."""
    db = _readable(file)
    with closed_on_error(db):
        if database.check_version(db) == database.VERSION:
            db.execute("PRAGMA query_only = 1")
            return db
    with closing(db):
        copy = memory_copy(db)
    with closed_on_error(copy):
        database.migrate(copy)
        copy.execute("PRAGMA query_only = 1")
    return copy


def _readable(file: Path) -> sqlite3.Connection:
    try:
        return connect(file, "rw")
    except sqlite3.OperationalError:
        return _copy(file)


def _copy(file: Path) -> sqlite3.Connection:
    """Return a copy of the journal and its log in memory. Raises OSError, sqlite3.Error."""
    with scratch_folder() as place:
        for suffix in ("", "-wal", "-journal"):
            beside = file.with_name(file.name + suffix)
            if beside.is_file():
                (place / beside.name).write_bytes(beside.read_bytes())
        with closing(connect(place / file.name, "rw")) as db:
            return memory_copy(db)
