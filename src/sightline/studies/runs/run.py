"""Run a study: do the missing trials, record each when it finishes, summarise all."""

import json
import os
import signal
import threading
from collections import Counter
from collections.abc import Callable, Generator
from concurrent.futures import FIRST_COMPLETED, CancelledError, Executor, Future, ProcessPoolExecutor, wait
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from hashlib import sha256
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np

import sightline
from sightline.common.closing import end_with_parent
from sightline.errors import RefusedError, UnusableInputError
from sightline.imaging.quiet import Quiet
from sightline.studies.runs.study import Study, Summary, Values

# Matrices are small, so threads of the linear algebra cost more than they save.
_LINEAR_ALGEBRA = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")
_THREADS = (*_LINEAR_ALGEBRA, "NUMBA_NUM_THREADS")
_quiet = Quiet("ignore", "distributed", "tornado", all_threads=True)  # our messages replace Dask's tracebacks
PATIENCE_S = 10.0  # time limit for a scheduler's answer, and for its first worker [ours]


@dataclass(frozen=True)
class Workers:
    """An `executor` that runs `number` trials at a time. `lost`: exceptions of a future whose worker died."""

    executor: Executor
    number: int
    lost: tuple[type[BaseException], ...]


@contextmanager
def local_workers(number: int | None = None) -> Generator[Workers]:
    """Context of local worker processes, one thread each; default: one process per core."""
    from concurrent.futures.process import BrokenProcessPool

    number = number or os.cpu_count() or 1
    with _one_thread():  # the variables are read when a process first imports numpy
        pool = ProcessPoolExecutor(number, mp_context=get_context("spawn"), initializer=_settle)
        try:
            _start_all(pool, number)
            yield Workers(pool, number, (BrokenProcessPool,))
        finally:
            pool.shutdown(cancel_futures=True)


@contextmanager
def cluster_workers(address: str) -> Generator[Workers]:
    """Context of the workers of a Dask scheduler, which must have the same code. Raises UnusableInputError."""
    try:
        from distributed import Client
        from distributed.scheduler import KilledWorker
    except ImportError:
        raise UnusableInputError(
            "--scheduler needs the package distributed: pip install 'sightline[studies]'; without it, leave "
            "--scheduler out and the processes of this machine do the work"
        ) from None
    with _quiet():
        try:
            client = Client(address, timeout=PATIENCE_S, set_as_default=False)
        except (OSError, ValueError) as error:
            raise UnusableInputError(
                f"no scheduler answers at {address} ({type(error).__name__}); start one with `dask scheduler`, and "
                "give the address that it prints"
            ) from error
        try:
            number = _refuse_other_code(client, address)
            yield Workers(client.get_executor(), number, (KilledWorker,))
        finally:
            client.close(timeout=PATIENCE_S)


def _refuse_other_code(client, address: str) -> int:
    """Return the number of trials that the cluster does at a time. Raises UnusableInputError if it has no workers, or
    if they have other code or use several threads for linear algebra."""
    try:
        client.wait_for_workers(1, timeout=PATIENCE_S)
    except TimeoutError:
        raise UnusableInputError(
            f"the scheduler at {address} has no workers; start some with `dask worker {address}`"
        ) from None
    try:
        digests = client.run(code_digest)  # sent by name, so it raises if a worker has no such function
    except (ImportError, AttributeError):
        digests = {"all": None}
    other = [worker for worker, digest in digests.items() if digest != code_digest()]
    if other:
        raise UnusableInputError(
            f"workers of {address} have no Sightline or another version ({', '.join(other)}): their trials must not be "
            "mixed with these; install the same version there"
        )
    threaded = [worker for worker, single in client.run(one_threaded).items() if not single]
    if threaded:
        raise UnusableInputError(
            f"workers of {address} may do linear algebra on several threads ({', '.join(threaded)}), which changes the "
            f"last digits: start them with {'=1 '.join(_LINEAR_ALGEBRA)}=1, as `dask worker` does by itself"
        )
    return sum(client.nthreads().values())


def one_threaded() -> bool:
    """Whether this process uses one thread for linear algebra, so that results are bit-identical."""
    return all(os.environ.get(name) == "1" for name in _LINEAR_ALGEBRA)


def _start_all(pool: Executor, number: int) -> None:
    """Start the processes of a pool out of reach of Ctrl-C; before `_settle` it would print a traceback."""
    if threading.current_thread() is not threading.main_thread():
        return  # only the main thread may set a signal's handler, and only it is interrupted
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)  # new processes inherit it
    try:
        for _ in range(number):
            pool.submit(int)
    finally:
        signal.signal(signal.SIGINT, before)


def _settle() -> None:
    """Make a worker process ignore Ctrl-C and end with its parent."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    end_with_parent()


@contextmanager
def _one_thread() -> Generator[None]:
    before = {name: os.environ.get(name) for name in _THREADS}
    os.environ.update(dict.fromkeys(before, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


TRIALS = "trials.jsonl"


@cache
def code_digest() -> str:
    """Return the digest of the package's source as this process found it, without parts that no trial uses. During
    development, equal versions may have different code."""
    root = Path(sightline.__file__).parent
    digest = sha256()
    for file in sorted(root.rglob("*.py")):
        if file.relative_to(root).parts[0] not in ("cli", "app"):
            digest.update(file.relative_to(root).as_posix().encode() + b"\0" + file.read_bytes())
    return digest.hexdigest()[:16]


def header(study: Study, seed: int) -> dict[str, Any]:
    """Return everything that determines the values of a trial, besides its number."""
    return {
        "study": study.name,
        "version": sightline.__version__,
        "code": code_digest(),
        "seed": seed,
        "configuration": study.configuration,
    }


@dataclass(frozen=True)
class Record:
    """The file of one study, and its `finished` trials: values by number."""

    file: Path
    finished: dict[int, Values]

    @staticmethod
    def open(folder: Path, expected: dict[str, Any]) -> "Record":
        """Open the record of a folder, or create it.

        Raises UnusableInputError if it cannot be written, or holds trials of anything else than `expected`.
        """
        file = folder / TRIALS
        try:
            folder.mkdir(parents=True, exist_ok=True)
            text = file.read_bytes() if file.exists() else b""
            whole = text[: text.rfind(b"\n") + 1]
            if len(whole) < len(text):
                os.truncate(file, len(whole))
        except OSError as error:
            raise _unusable(file, error) from error
        record = Record(file, {})
        if not whole:
            record._append([expected])
            return record
        try:
            recorded, *lines = [json.loads(line) for line in whole.splitlines()]
            record.finished.update({line["trial"]: line["values"] for line in lines})
        except (ValueError, KeyError, TypeError):
            raise UnusableInputError(
                f"{file} is not a record of trials; delete it, or name another folder with --out"
            ) from None
        _refuse_other(recorded, json.loads(json.dumps(expected)), file)
        return record

    def add(self, values: dict[int, Values]) -> None:
        """Record finished trials; they are on the disk when this returns. Raises UnusableInputError."""
        self._append([{"trial": trial, "values": each} for trial, each in values.items()])
        self.finished.update(values)

    def _append(self, lines: list[dict[str, Any]]) -> None:
        text = "".join(json.dumps(line, allow_nan=False) + "\n" for line in lines)
        try:
            with self.file.open("ab") as file:
                file.write(text.encode())
                file.flush()
                os.fsync(file.fileno())
        except OSError as error:
            raise _unusable(self.file, error) from error


def _unusable(file: Path, error: OSError) -> UnusableInputError:
    return UnusableInputError(
        f"cannot write {file}: {error.strerror}; finished trials are kept: make room, or name another folder with "
        "--out, and run the command again"
    )


def _refuse_other(recorded: Any, expected: dict[str, Any], file: Path) -> None:
    """Refuse a record of another study, seed, configuration or code: their trials must not be mixed."""
    if recorded == expected:
        return
    recorded = recorded if isinstance(recorded, dict) else {}
    names = [name for name in expected if recorded.get(name) != expected[name]]
    details = "; ".join(
        f"{name} {recorded.get(name)!r} there, {expected[name]!r} now"
        if name != "configuration"
        else _difference(recorded.get(name), expected[name])
        for name in names
    )
    raise UnusableInputError(
        f"{file} holds trials that these must not be mixed with ({details}); delete it, or name another folder with "
        "--out"
    )


def _difference(there: Any, now: dict[str, Any]) -> str:
    there = there if isinstance(there, dict) else {}
    differ = sorted(name for name in {*there, *now} if there.get(name) != now.get(name))
    return f"another configuration: {', '.join(differ)}"


# Trials submitted ahead per worker: it never waits, and an interruption loses few [ours].
AHEAD = 3
# A trial that was running when this many workers died is taken as the cause [ours].
MAX_DEATHS = 3


@dataclass(frozen=True)
class Result:
    """The result of a run. `head`: what determines it; `trials`: how many were summarised."""

    head: dict[str, Any]
    trials: int
    summary: Summary

    def document(self) -> dict[str, Any]:
        """Return the result as JSON types, without the plots."""
        return {
            **self.head,
            "trials": self.trials,
            "findings": list(self.summary.findings),
            "figures": [vars(estimate) for estimate in self.summary.estimates],
            "tables": [vars(table) for table in self.summary.tables],
        }


@dataclass(frozen=True)
class StudyRun:
    """The first `trials` trials of a study, some of which may be finished already.

    Trial k draws from `default_rng([seed, k])`, so its values do not depend on the worker or on other trials.
    """

    study: Study
    trials: int
    seed: int
    record: Record

    @staticmethod
    def open(study: Study, trials: int, seed: int, folder: Path) -> "StudyRun":
        """Open a run with the trials recorded in `folder`. Raises UnusableInputError if they are of another study."""
        if trials < 1:
            raise UnusableInputError(f"{trials} trials give no result; give at least one")
        return StudyRun(study, trials, seed, Record.open(folder, header(study, seed)))

    @property
    def missing(self) -> list[int]:
        """Numbers of the trials that are not finished."""
        return [k for k in range(self.trials) if k not in self.record.finished]

    def do(
        self, scheduler: str | None = None, workers: int | None = None, advance: Callable[[], None] = lambda: None
    ) -> None:
        """Do the missing trials in local processes (`workers` of them; default: one per core) or on the Dask cluster of
        `scheduler`. `advance` is called once per trial. Trials of a worker that died are repeated by new workers.

        Raises UnusableInputError; RefusedError if workers keep dying.
        """
        deaths = Counter[int]()  # by trial: workers that died while it was running
        while self.missing:
            with local_workers(workers) if scheduler is None else cluster_workers(scheduler) as hired:
                deaths.update(self._until_a_death(hired, deaths, advance))
            deadly = [trial for trial in self.missing if deaths[trial] >= MAX_DEATHS]
            if deadly:
                raise RefusedError(
                    f"{MAX_DEATHS} workers died of trial {deadly[0]}: too little memory, or a bug; {self._kept}"
                )

    def result(self) -> Result:
        """Return the result of all trials, once none is missing."""
        values = [self.record.finished[k] for k in range(self.trials)]
        return Result(header(self.study, self.seed), self.trials, self.study.summary(values))

    @property
    def _kept(self) -> str:
        return f"{len(self.record.finished)} finished trials are kept; run the same command to continue"

    def _until_a_death(self, hired: Workers, deaths: Counter[int], advance: Callable[[], None]) -> list[int]:
        """Do trials until none is left or a worker dies; return the trials that were running when it died."""
        fresh = [trial for trial in self.missing if trial not in deaths]
        todo = iter(fresh or sorted(self.missing, key=lambda trial: deaths[trial]))
        limit = AHEAD * hired.number if fresh else 1  # suspects run one at a time, to identify the one that kills
        running: dict[Future[Values], int] = {}
        try:
            while True:
                while len(running) < limit and (trial := next(todo, None)) is not None:
                    running[hired.executor.submit(one_trial, self.study, self.seed, trial)] = trial
                if not running:
                    return []
                self._keep(running, advance)
        except hired.lost:
            return list(running.values())
        except CancelledError:
            raise UnusableInputError(f"the scheduler is gone; {self._kept}") from None

    def _keep(self, running: dict[Future[Values], int], advance: Callable[[], None]) -> None:
        """Wait for some running trials and record those that succeeded; raise the exception of one that failed."""
        finished = wait(running, return_when=FIRST_COMPLETED).done
        done = [future for future in running if future in finished]  # in a defined order, for the record
        good = [future for future in done if not future.cancelled() and future.exception() is None]
        if good:
            self.record.add({running.pop(future): future.result() for future in good})
        for _ in good:
            advance()
        for future in done:
            future.result()


def one_trial(study: Study, seed: int, trial: int) -> Values:
    """Run one trial, in a worker."""
    return study.trial(np.random.default_rng([seed, trial]))
