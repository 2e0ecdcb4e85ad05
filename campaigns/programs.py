"""Programs that write, for campaigns that interrupt them: the state before, the run, and the required state after.

A run is a process forked from this one, in which everything is imported and slow results are already computed.
"""

import json
import os
import re
import sqlite3
import sys
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, contextmanager, redirect_stderr, redirect_stdout
from dataclasses import dataclass
from functools import cache, partial
from io import StringIO
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Protocol
from unittest.mock import patch

import numpy as np

from campaigns.points import World
from sightline.case.acquire import folder as acquire_folder
from sightline.case.journal import Actor, Case, Kind
from sightline.case.journal.case import JOURNAL
from sightline.cli import commands
from sightline.cli.base import Output
from sightline.common import atomic
from sightline.detection.csv_files import write_observations
from sightline.errors import SightlineError
from sightline.frame import Frame
from sightline.imaging import Radiograph, write_png
from sightline.studies.runs.run import Record
from sightline.studies.scenes import VIEWS

Work = Callable[[], int]
Write = Callable[[Path], int]  # writes a folder, returns the exit code
Files = Mapping[str, bytes]
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


def in_a_child(work: Work) -> Child:
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


class Program(Protocol):
    """A program that writes into an otherwise empty folder `place`.

    `prepare` makes the state before, `run` returns the exit code. `damage` returns what is lost or incomplete after the
    program has printed `said`, `missing` what an uninterrupted run has not done; "" if nothing.
    """

    def prepare(self, place: Path) -> None: ...
    def run(self, place: Path) -> int: ...
    def damage(self, place: Path, said: str) -> str: ...
    def missing(self, place: Path) -> str: ...


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


def contents(folder: Path) -> dict[str, bytes]:
    """Return all files by their paths in a folder; of a case only its number of entries, because its names vary.

    A killed process leaves its scratch file, which is no result.
    """
    files = sorted(file for file in folder.rglob("*") if file.is_file() and file.parent.name != "originals")
    files = [file for file in files if file.name != atomic.MANIFEST and file.suffix != ".part"]
    return {
        str(file.relative_to(folder)): _entries(file) if file.name == JOURNAL else file.read_bytes() for file in files
    }


def _entries(journal: Path) -> bytes:
    try:
        with Case.open(journal.parent, read_only=True) as case:
            return f"{case.last} entries, {len(case.problems)} problems".encode()
    except SightlineError:
        return journal.read_bytes()


@dataclass(frozen=True)
class Results:
    """A program that writes results into the folder `out`. `before`: "nothing", or "old" results."""

    writer: Callable[[], Write]  # computes what is slow, once
    before: str = "old"

    def prepare(self, place: Path) -> None:
        if self.before == "old":
            atomic.write_folder(place / "out", self._old)

    def run(self, place: Path) -> int:
        return self.writer()(place / "out")

    def damage(self, place: Path, said: str) -> str:
        """Check for old or new results, in out.old between two renames, and for reported files."""
        folder = place / "out" if (place / "out").exists() else place / "out.old"
        held, new = contents(folder), _results_of(self.writer)
        if "written: " in said and held != new:
            return "what it said to be written is not there"
        return "" if held in (self._old, new) else "the folder is neither old nor new"

    def missing(self, place: Path) -> str:
        held = contents(place / "out")
        same = all(held.get(name) == data for name, data in _results_of(self.writer).items())
        return "" if same else "the new results"

    @property
    def _old(self) -> Files:
        names = _results_of(self.writer) if self.before == "old" else ()
        return {name: b"old " + name.encode() for name in names}


@cache
def _results_of(writer: Callable[[], Write]) -> Files:
    """Return the results of an uninterrupted run."""
    write = writer()
    with TemporaryDirectory() as folder:
        child = in_a_child(lambda: write(Path(folder) / "out"))
        assert child.code == 0, child
        return contents(Path(folder) / "out")


@cache
def plan() -> Write:
    """Return the writer of the results of `sightline plan --out`, which are computed once, here."""
    documents: dict[str, bytes] = {}

    def keep(_: Path, given: Files) -> list[Path]:
        documents.update(given)
        return []

    def both(uv: np.ndarray) -> dict[str, list[float]]:
        return {name: row.round(2).tolist() for name, row in zip(VIEWS, uv, strict=True)}

    with TemporaryDirectory() as name, patch.object(atomic, "write_folder", keep):
        folder, world = Path(name), World.draw(np.random.default_rng(3))
        clicks, picks = world.clicks, folder / "picks.json"
        marks = [{"name": name, **both(clicks.landmarks[:, k])} for k, name in enumerate(clicks.names)]
        wires = {"guide-wire": {"entry": both(clicks.wire[:, 0]), "end": both(clicks.wire[:, 1])}}
        content = {"schema": "sightline-picks/1", "wires": wires, "head": both(clicks.head), "landmarks": marks}
        picks.write_text(json.dumps(content))
        beads = write_observations(list(world.observations.values()), folder / "beads.csv")
        options = ("--picks", picks, "--side", clicks.side, "--out", folder, "--quiet")
        assert command("plan", beads, beads, *options) == 0

    def write(folder: Path) -> int:
        def work() -> None:
            for file in atomic.write_folder(folder, documents):
                print(f"written: {file}", flush=True)

        return as_command(work)

    return write


@cache
def _image(seed: str | int) -> Radiograph:
    rng = np.random.default_rng(list(str(seed).encode()))
    return Radiograph(rng.integers(0, 65536, (60, 64), dtype=np.uint16), 65535.0)


@cache
def frame_file() -> Write:
    """Return the writer of a single file."""
    frame = Frame.load("gamma")

    def write(folder: Path) -> int:
        folder.mkdir(exist_ok=True)
        return as_command(lambda: frame.save(folder / "frame.json"))

    return write


@dataclass(frozen=True)
class Journal:
    """A program that appends to the case in `case`, and acknowledges by lines "entry N: kept, HASH"."""

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

    def run(self, place: Path) -> int:
        return self.write(place)

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


def watch(place: Path) -> int:
    """Run `sightline acquire folder --watch` for three polls without news; one image arrives late."""
    looks = iter(range(3))

    def pause(_: float) -> None:
        look = next(looks, None)
        if look is None:
            raise KeyboardInterrupt
        if look == 1:
            write_png(_image("late"), place / "images" / "late.png")

    with patch.object(acquire_folder, "SETTLED_S", 0.0), patch("time.sleep", pause):
        return command("acquire", "folder", place / "images", "--case", place / "case", "--watch")


def append(place: Path) -> int:
    """Record edits, as the app does."""

    def work() -> None:
        with Case.create(place / "case", exist_ok=True) as case:
            for number in range(2 * ENTRIES):
                made = case.record(Kind.CHANGED, {"what": "side", "to": number}, by=Actor.SURGEON)
                print(f"entry {made.number}: kept, {made.chain[:12]}", flush=True)

    return as_command(work)


@dataclass(frozen=True)
class Trials:
    """A study that records finished trials."""

    def prepare(self, place: Path) -> None:
        pass

    def run(self, place: Path) -> int:
        """Record the missing trials one by one."""

        def work() -> None:
            record = Record.open(place / "study", {"study": "one"})
            for trial in range(ENTRIES):
                if trial not in record.finished:
                    record.add({trial: {"value": trial}})
                    print(f"trial {trial}", flush=True)

        return as_command(work)

    def damage(self, place: Path, said: str) -> str:
        try:
            held = Record.open(place / "study", {"study": "one"}).finished
        except SightlineError as error:
            return f"the record cannot be opened: {error}"
        lost = [n for n in re.findall(r"^trial (\d+)$", said, re.MULTILINE) if int(n) not in held]
        return f"trials {', '.join(lost)} are lost" if lost else ""

    def missing(self, place: Path) -> str:
        return "" if len(Record.open(place / "study", {"study": "one"}).finished) == ENTRIES else "trials"


PROGRAMS: dict[str, Program] = {
    "acquire folder, a new case": Journal(acquire),
    "acquire folder": Journal(acquire, "case"),
    "acquire folder, case of an older version": Journal(acquire, "schema 0"),
    "acquire folder --watch": Journal(watch, "case"),
    "two acquire folder at once": Journal(acquire_beside_another, "case"),
    "edits of a case": Journal(append, "case"),
    "plan --out": Results(plan),
    "plan --out, no folder yet": Results(plan, "nothing"),
    "a frame file": Results(frame_file),
    "trials of a study": Trials(),
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
        program.run(place)  # once in this process, so that children need not import again
    with place_for(program) as place:

        def counted() -> int:
            steps = Steps()
            steps.watch()
            code = program.run(place)
            os.write(1, f"\nsteps {steps.file} {steps.journal}\n".encode())
            return code

        child = in_a_child(counted)
        assert child.code == 0 and not program.missing(place), (name, child)
        file, journal = map(int, re.findall(r"^steps (\d+) (\d+)$", child.out, re.MULTILINE)[0])
        largest = max((path.stat().st_size for path in place.rglob("*") if path.is_file()), default=1)
    return {"file": file, "journal": journal, "byte": largest}


def not_finished(program: Program, place: Path) -> str:
    """Run the program again without interruption; return what is wrong, or ""."""
    child = in_a_child(lambda: program.run(place))
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
