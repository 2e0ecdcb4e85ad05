"""A case whose program is killed at any instant, whose disk is full or read-only: nothing acknowledged is lost."""

import errno
import os
import shutil
import signal
import stat
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import pytest

from sightline.case.journal import Actor, Case, Kind, originals
from sightline.errors import CaseError

resource = pytest.importorskip("resource", reason="kills, forks and full disks of POSIX")

PROGRAM = Path(__file__).with_name("journal_program.py")
RECORD_STEPS = 65  # about as many as keeping and recording once takes
CREATE_STEPS = 600  # and creating a case


@dataclass
class Acknowledged:
    """What programs said was done, before they were killed."""

    kept: list[str] = field(default_factory=list)
    chains: dict[int, str] = field(default_factory=dict)

    def hear(self, said: str) -> None:
        for line in said.splitlines(keepends=True):
            words = line.split()
            if not line.endswith("\n"):
                return
            if words[0] == "kept":
                self.kept.append(words[1])
            elif words[0] == "recorded":
                self.chains[int(words[1])] = words[2]

    def all_there(self, folder: Path) -> int:
        """The number of entries. Opened as always, by nobody's hand repaired."""
        with Case.open(folder) as case:
            assert case.problems == ()
            entries = {entry.number: entry.chain for entry in case.entries()}
            assert self.chains.items() <= entries.items()
            assert all(originals.is_whole(case.original(name)) for name in self.kept)
            return len(entries)


def killed_at_step(folder: Path, seed: int, step: int, acknowledged: Acknowledged) -> None:
    command = [sys.executable, str(PROGRAM), *map(str, (folder, seed, step))]
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True, timeout=60, check=False)  # noqa: S603 - our own
    acknowledged.hear(done.stdout)
    assert done.returncode == -signal.SIGKILL


@pytest.mark.slow
def test_killed_at_steps_all_over_an_entry_nothing_acknowledged_is_lost(tmp_path: Path) -> None:
    """The same case is opened again and goes on after every kill. The campaign `kills` does so a thousand times."""
    acknowledged, folder = Acknowledged(), tmp_path / "case"
    Case.create(folder).close()
    for k, step in enumerate(range(400, 400 + 2 * RECORD_STEPS, 17)):
        killed_at_step(folder, k, step, acknowledged)
        found = acknowledged.all_there(folder)
        assert found <= len(acknowledged.chains) + k + 1  # at most one that was not acknowledged, each time
    assert len(acknowledged.chains) > 5


@pytest.mark.slow
def test_killed_while_it_is_created_a_case_is_there_or_can_be_created(tmp_path: Path) -> None:
    """Killed again and again in one folder: the same program, started again, comes as far as an uncut one."""
    found = set()
    for step in range(1, CREATE_STEPS, 110):
        folder, acknowledged = tmp_path / str(step), Acknowledged()
        killed_at_step(folder, 1, step, acknowledged)
        journal = folder / "journal.sqlite"
        found.add((journal.is_file(), Case.exists(folder)))
        killed_at_step(folder, 1, CREATE_STEPS + 200, acknowledged)
        assert acknowledged.all_there(folder) >= 1
    assert found == {(False, False), (True, False), (True, True)}  # the steps reach from before to after


def test_what_a_power_cut_must_find_on_the_disk_is_synced(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """No test can cut the power: an original is synced before it has its name, its folder after, every commit too."""
    done = []
    sync, replace = os.fsync, Path.replace

    def synced(handle: int) -> None:
        done.append("folder synced" if stat.S_ISDIR(os.fstat(handle).st_mode) else "file synced")
        sync(handle)

    def named(path: Path, target: Path) -> Path:
        done.append("named")
        return replace(path, target)

    with Case.create(tmp_path / "case") as case:
        monkeypatch.setattr(os, "fsync", synced)
        monkeypatch.setattr(Path, "replace", named)
        case.keep(b"image", ".png")
        assert done == ["file synced", "named", "folder synced"]
        said = {name: case._db.execute(f"PRAGMA {name}").fetchone()[0] for name in ("journal_mode", "synchronous")}
        assert said == {"journal_mode": "wal", "synchronous": 3}  # EXTRA: with a log, a sync at every commit


def fill(case: Case, entries: int = 3) -> None:
    for k in range(entries):
        name = case.keep(b"image %d" % k, ".png")
        case.record(Kind.ACQUIRED, {"original": name}, by=Actor.RECEIVER)


@pytest.fixture
def case(tmp_path: Path) -> Iterator[Case]:
    with Case.create(tmp_path / "case") as one:
        fill(one)
        yield one


def goes_on(case: Case) -> None:
    """As it was before, and as it is after reopening, a further entry can be recorded."""
    assert all(check.passed for check in case.check())
    assert case.last == 3
    assert case.record(Kind.CHANGED, {}, by=Actor.SURGEON).number == 4
    with Case.open(case.folder) as again:
        assert again.problems == ()
        assert [entry.number for entry in again.entries()] == [1, 2, 3, 4]


@contextmanager
def largest_file(size: int) -> Iterator[None]:
    """No file of this process may become larger: to a program, a full disk."""
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, limits[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)


def test_a_disk_that_takes_no_more_is_said_and_loses_nothing(case: Case) -> None:
    size = (case.folder / "journal.sqlite").stat().st_size
    with largest_file(size):
        with pytest.raises(CaseError, match="entries already recorded are safe"):
            case.record(Kind.CHANGED, {"long": "x" * 100_000}, by=Actor.SURGEON)
        with pytest.raises(CaseError, match="entries already recorded are safe"):
            case.keep(b"x" * (size + 1), ".dcm")
    assert len(list((case.folder / "originals").iterdir())) == 3
    goes_on(case)


def test_a_full_database_is_said_and_loses_nothing(case: Case) -> None:
    """SQLite's own word for a full disk."""
    pages = case._db.execute("PRAGMA page_count").fetchone()[0]
    case._db.execute(f"PRAGMA max_page_count = {pages}")
    with pytest.raises(CaseError, match="the disk is full; free some space"):
        case.record(Kind.CHANGED, {"long": "x" * 100_000}, by=Actor.SURGEON)
    case._db.execute("PRAGMA max_page_count = 1000000")
    goes_on(case)


@pytest.mark.parametrize("operation", ["fsync", "open"])
def test_an_original_that_finds_no_space_leaves_nothing(case: Case, monkeypatch, operation: str) -> None:
    def full(*_: object) -> int:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as patch:
        if operation == "fsync":
            patch.setattr(os, "fsync", full)
        else:
            patch.setattr(Path, "open", full)
        with pytest.raises(CaseError, match=r"No space left.*entries already recorded are safe"):
            case.keep(b"another image", ".png")
    assert len(list((case.folder / "originals").iterdir())) == 3
    goes_on(case)


@contextmanager
def read_only(folder: Path) -> Iterator[None]:
    """Nobody in this block may write there; root becomes nobody for it."""
    for path in (*folder.rglob("*"), folder):
        path.chmod(0o555 if path.is_dir() else 0o444)
    was = os.geteuid()
    if was == 0:
        os.seteuid(65534)
    try:
        yield
    finally:
        os.seteuid(was)
        for path in (folder, *folder.rglob("*")):
            path.chmod(0o755 if path.is_dir() else 0o644)


def test_a_case_that_cannot_be_written_is_said_at_once_and_can_be_read() -> None:
    with tempfile.TemporaryDirectory() as place:
        Path(place).chmod(0o755)
        folder = Path(place) / "case"
        with Case.create(folder) as case:
            fill(case)
        with read_only(folder):
            with pytest.raises(CaseError, match="cannot be written"):
                Case.open(folder)
            with pytest.raises(CaseError, match="cannot be read or written"):
                Case.create(folder / "new")
            with Case.open(folder, read_only=True) as reader:
                assert reader.problems == ()
                assert reader.last == 3
                with pytest.raises(CaseError, match="cannot be written"):
                    reader.record(Kind.CHANGED, {}, by=Actor.APP)
                with pytest.raises(CaseError, match="cannot be read or written"):
                    reader.keep(b"image", ".png")
        with Case.open(folder) as case:
            goes_on(case)


def cut_off(case: Case) -> Path:
    """The folder as it is while an entry is half written, and others are in the log alone: what a kill leaves."""
    case.record(Kind.CHANGED, {"number": 4}, by=Actor.SURGEON)
    copy = case.folder.with_name("cut off")
    with Case.open(case.folder) as other:
        other._db.execute("PRAGMA cache_size = 1")  # so that pages leave the memory before the commit
        other._db.execute("BEGIN")
        other._db.execute(
            "INSERT INTO entries SELECT number + 10, kind, at, by, versions, settings, rests_on, content_sha256, "
            "hex(randomblob(50000)), chain FROM entries"
        )
        shutil.copytree(case.folder, copy, ignore=shutil.ignore_patterns("*-shm"))
        other._db.execute("ROLLBACK")
    assert (copy / "journal.sqlite-wal").stat().st_size > 100_000
    return copy


@pytest.mark.parametrize("reading", [True, False])
def test_what_was_half_written_is_taken_back_on_opening_and_nothing_else(case: Case, reading: bool) -> None:
    folder = cut_off(case)
    with Case.open(folder, read_only=reading) as again:
        assert again.problems == ()
        assert again.last == 4
    assert [file.name for file in sorted(folder.iterdir())] == ["journal.sqlite", "originals"]


def test_what_was_half_written_is_taken_back_where_nothing_can_be_written(case: Case) -> None:
    with tempfile.TemporaryDirectory() as place:
        Path(place).chmod(0o755)
        folder = Path(shutil.move(cut_off(case), place))
        with read_only(folder), Case.open(folder, read_only=True) as again:
            assert again.problems == ()
            assert again.last == 4


def test_a_program_that_keeps_writing_is_waited_for_and_then_named(case: Case, monkeypatch) -> None:
    case._db.execute("PRAGMA busy_timeout = 50")
    with Case.open(case.folder) as other:
        other._db.execute("BEGIN IMMEDIATE")
        with pytest.raises(CaseError, match="another program keeps writing"):
            case.record(Kind.CHANGED, {}, by=Actor.APP)
        other._db.execute("ROLLBACK")
    goes_on(case)
