"""Programs that append to a case, for campaigns that interrupt them: before, run, and the required state after.

A run is a process forked from this one, in which everything is imported. Tests interrupt the others at every step:
folders of results (tests/test_atomic.py), trials of a study (tests/studies/test_run.py).
"""

import os
import re
import sqlite3
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, contextmanager, redirect_stderr, redirect_stdout
from dataclasses import dataclass
from functools import cache, partial
from io import StringIO
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from sightline.case.journal import Actor, Case, Kind
from sightline.cli import commands
from sightline.cli.base import Output
from sightline.errors import SightlineError
from sightline.imaging import Radiograph, write_png

Write = Callable[[Path], int]  # writes into a folder, returns the exit code
SCHEMA_0 = Path(__file__).parents[1] / "tests/case/journal-schema-0.sql"
ITS_ORIGINAL = "2b4c342f5433ebe591a1da77e013d1b72475562d48578dca8b84bac6651c3cb9.png"
CHANGES = ("os.rename", "os.mkdir", "os.remove", "os.rmdir", "os.link", "os.chmod", "os.truncate")
IMAGES, ENTRIES = 3, 6


@dataclass(frozen=True)
class Child:
    """Exit code of a process, negative for a signal, and its output."""

    code: int
    out: str
    err: str


def in_a_child(work: Callable[[], int]) -> Child:
    """Run `work` in a forked process; return when it and its children have ended."""
    sys.stdout.flush()
    sys.stderr.flush()
    pipes = [os.pipe(), os.pipe()]
    child = os.fork()
    if child == 0:
        code = 1
        try:
            for number, (reading, writing) in enumerate(pipes, start=1):
                os.dup2(writing, number)
                os.close(reading)
                os.close(writing)
            sys.stdout, sys.stderr = (open(number, "w", buffering=1, closefd=False) for number in (1, 2))  # noqa: SIM115
            sys.dont_write_bytecode = True
            code = work()
        except BaseException as fault:
            os.write(2, f"Traceback: {type(fault).__name__}: {fault}\n".encode())
        finally:
            os._exit(code)
    for _, writing in pipes:
        os.close(writing)
    with ThreadPoolExecutor(2) as pool:
        written = pool.map(lambda ends: os.fdopen(ends[0], "rb").read().decode(errors="replace"), pipes)
    return Child(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), *written)


@dataclass
class Steps:
    """Counts a process's disk operations: `file`, Python's operations on files and folders; `journal`, instructions of
    SQLite's virtual machine.

    `act` is called at step `at` of one `kind`; `refuse` is called before each operation on a file, and may raise.
    """

    kind: str = ""
    at: int = 0
    act: Callable[[], None] = lambda: None
    refuse: Callable[[str, int], None] = lambda event, flags: None
    file: int = 0
    journal: int = 0

    def watch(self) -> None:
        """Start counting, until this process ends."""
        connect, sync = sqlite3.connect, os.fsync

        def watched(*args: Any, **options: Any) -> sqlite3.Connection:
            db = connect(*args, **options)
            db.set_progress_handler(partial(self._step, "journal"), 1)
            return db

        def synced(handle: int) -> None:
            self._file("os.fsync", 0)
            sync(handle)

        sqlite3.connect, os.fsync = watched, synced
        sys.addaudithook(self._audit)

    def _audit(self, event: str, given: tuple[Any, ...]) -> None:
        if event == "open":
            flags = given[2]
            if flags & (os.O_WRONLY | os.O_RDWR | os.O_CREAT) and not str(given[0]).startswith("/dev/"):
                self._file(event, flags)
        elif event in CHANGES:
            self._file(event, 0)

    def _file(self, event: str, flags: int) -> None:
        self._step("file")
        self.refuse(event, flags)

    def _step(self, kind: str) -> int:
        count = getattr(self, kind) + 1
        setattr(self, kind, count)
        if (kind, count) == (self.kind, self.at):
            self.act()
        return 0


def command(*words: object) -> int:
    """Run a command of Sightline in this process; return its exit code."""
    try:
        commands([str(word) for word in words])
    except SystemExit as end:
        return int(end.code or 0)
    return 0


def as_command(work: Callable[[], None]) -> int:
    """Run a function of the package with a command's error handling; return the exit code."""
    from typer import Exit

    try:
        with Output(json=False, quiet=True):
            work()
    except Exit as end:
        return end.exit_code
    return 0


def _image(number: int) -> Radiograph:
    rng = np.random.default_rng(number)
    return Radiograph(rng.integers(0, 65536, (60, 64), dtype=np.uint16), 65535.0)


@dataclass(frozen=True)
class Program:
    """A program that appends to the case in `case`, and acknowledges by lines "entry N: kept, HASH".

    `damage` returns what is lost or incomplete after the program has printed `said`, `missing` what an uninterrupted
    run has not done; "" if nothing.
    """

    write: Write
    before: str = "nothing"  # or "case", or one of "schema 0"

    def prepare(self, place: Path) -> None:
        """Create a case, and images next to it."""
        (place / "images").mkdir()
        for number in range(IMAGES):
            write_png(_image(number), place / "images" / f"{number}.png")
        if self.before == "case":
            with Case.create(place / "case") as case:
                for number in range(ENTRIES):
                    case.record(Kind.CHANGED, {"what": "side", "to": number}, by=Actor.SURGEON)
        elif self.before == "schema 0":
            (place / "case" / "originals").mkdir(parents=True)
            (place / "case" / "originals" / ITS_ORIGINAL).write_bytes(b"\t")
            with closing(sqlite3.connect(place / "case" / "journal.sqlite")) as db:
                db.executescript(SCHEMA_0.read_text("utf-8"))

    def damage(self, place: Path, said: str) -> str:
        """Check that earlier and acknowledged entries are there, and that the case is intact."""
        acknowledged = {int(n): name for n, name in re.findall(r"^entry (\d+): kept, (\w+)$", said, re.MULTILINE)}
        before = {"nothing": 0, "case": ENTRIES, "schema 0": 3}[self.before]
        try:
            if not Case.exists(place / "case"):
                return "" if not acknowledged and not before else "the case is gone"
            with Case.open(place / "case") as case:
                if case.problems:
                    return f"the case has a problem: {case.problems[0].sentence}"
                held = {e.number: str(e.content.get("original", e.chain))[:12] for e in case.entries()}
        except SightlineError as error:
            return f"the case cannot be opened: {error}"
        lost = [number for number, name in acknowledged.items() if held.get(number) != name]
        if lost or len(held) < before:
            return f"entries {lost or before} of {len(held)} are lost"
        return ""

    def missing(self, place: Path) -> str:
        with Case.open(place / "case") as case:
            held = [e.content["original"] for e in case.entries(Kind.ACQUIRED) if "pixels_sha256" in e.content]
            edits = len(case.entries(Kind.CHANGED))
        if self.write is append:
            return "" if edits >= 2 * ENTRIES else "entries that were to be appended"
        return "" if len(held) == len(set(held)) >= IMAGES else f"{len(held)} entries of {IMAGES} images"


def acquire(place: Path) -> int:
    """Run `sightline acquire folder`."""
    return command("acquire", "folder", place / "images", "--case", place / "case")


def acquire_beside_another(place: Path) -> int:
    """Run `acquire` while another process does the same."""
    other = os.fork()
    if other == 0:
        os._exit(acquire(place))
    code = acquire(place)
    ended = os.waitstatus_to_exitcode(os.waitpid(other, 0)[1])
    return code or max(ended, 0)  # below zero: the other was killed, as this one may be


def append(place: Path) -> int:
    """Record edits, as the app does."""

    def work() -> None:
        with Case.create(place / "case", exist_ok=True) as case:
            for number in range(2 * ENTRIES):
                made = case.record(Kind.CHANGED, {"what": "side", "to": number}, by=Actor.SURGEON)
                print(f"entry {made.number}: kept, {made.chain[:12]}", flush=True)

    return as_command(work)


PROGRAMS: dict[str, Program] = {
    "acquire folder, a new case": Program(acquire),
    "acquire folder": Program(acquire, "case"),
    "acquire folder, case of an older version": Program(acquire, "schema 0"),
    "two acquire folder at once": Program(acquire_beside_another, "case"),
    "edits of a case": Program(append, "case"),
}


@contextmanager
def place_for(program: Program) -> Iterator[Path]:
    """Yield a private folder, prepared for a run."""
    with TemporaryDirectory(prefix="sightline-campaign-") as folder:
        place = Path(folder)
        place.chmod(0o755)
        program.prepare(place)
        yield place


@cache
def extent(name: str) -> dict[str, int]:
    """Return the number of a program's steps of each kind, and the size of its largest file, bytes."""
    program = PROGRAMS[name]
    with place_for(program) as place, redirect_stdout(StringIO()), redirect_stderr(StringIO()):
        program.write(place)  # once in this process, so that children need not import again
    with place_for(program) as place:

        def counted() -> int:
            steps = Steps()
            steps.watch()
            code = program.write(place)
            os.write(1, f"\nsteps {steps.file} {steps.journal}\n".encode())
            return code

        child = in_a_child(counted)
        assert child.code == 0 and not program.missing(place), (name, child)
        file, journal = map(int, re.findall(r"^steps (\d+) (\d+)$", child.out, re.MULTILINE)[0])
        largest = max((path.stat().st_size for path in place.rglob("*") if path.is_file()), default=1)
    return {"file": file, "journal": journal, "byte": largest}


def not_finished(program: Program, place: Path) -> str:
    """Run the program again without interruption; return what is wrong, or ""."""
    child = in_a_child(lambda: program.write(place))
    if child.code != 0:
        return f"the next run fails: {(child.err or child.out).strip().splitlines()[-1:]}"
    return program.damage(place, child.out) or program.missing(place)


def moment(name: str, rng: np.random.Generator, kinds: tuple[str, ...]) -> tuple[str, int]:
    """Return a random kind of step of a program, and its number."""
    last = {kind: number for kind, number in extent(name).items() if number and kind in kinds}
    kind = str(rng.choice(list(last)))
    if kind == "byte":
        return kind, int(np.exp(rng.uniform(0.0, np.log(last[kind]))))
    return kind, int(rng.integers(1, last[kind] + 1))


def interrupted(
    name: str,
    rng: np.random.Generator,
    kinds: tuple[str, ...],
    prepare: Callable[[str, int, Path], None],
    restore: Callable[[Path], None] = lambda place: None,
) -> tuple[Child, str, str]:
    """Return a run of a program, what is lost after it or after the next run, and the moment of its interruption.

    `prepare` is called in the process with the moment and the folder, `restore` when it has ended.
    """
    program, (kind, at) = PROGRAMS[name], moment(name, rng, kinds)
    with place_for(program) as place:

        def work() -> int:
            prepare(kind, at, place)
            return program.write(place)

        child = in_a_child(work)
        restore(place)
        return child, program.damage(place, child.out) or not_finished(program, place), f"{kind} {at}"
