"""What all benchmarks share: rows of values beside limit and peer, trials on all cores, and times."""

import pickle
import sys
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import as_completed
from dataclasses import dataclass
from functools import partial
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from scipy.stats import chi2

from sightline.errors import SightlineError
from sightline.studies.runs.run import code_digest, local_workers

KEPT = Path("out/bench")  # results by function and by the digest of its code and of the program's
WARM_UP = 2  # runs that are not timed
ARCADIS = Path(__file__).parents[2] / "shared" / "data" / "arcadis"  # real images, no part of the repository


@dataclass(frozen=True)
class Row:
    """A value beside what is asked, and what a peer has in the same run. `met` is None where nothing is asked."""

    group: str
    name: str
    value: str
    unit: str = ""
    asked: str = ""
    peer: str = ""
    met: bool | None = None


class Rows(list[Row]):
    """The rows of one group."""

    def __init__(self, group: str) -> None:
        super().__init__()
        self.group = group

    def add(self, name: str, value: str, asked: str = "", met: bool | None = None, *, peer: str = "") -> None:
        """Add a value that is a text, with its unit in it."""
        self.append(Row(self.group, name, value, "", asked, peer, None if met is None else bool(met)))

    def number(
        self, name: str, values: Any, form: str = ".3f", unit: str = "", *,
        most: float = np.inf, least: float = -np.inf, peer: str = "",
    ) -> None:  # fmt: skip
        """Add one or several numbers, all of which must be at most `most` and at least `least`."""
        numbers = np.atleast_1d(values)
        low, high = (f"{limit:.5g}" for limit in (least, most))
        asked = f"{low}-{high}" if np.isfinite([least, most]).all() else f"<= {high}" if most < np.inf else ""
        asked = asked or (f">= {low}" if least > -np.inf else "")
        met = bool(((numbers >= least) & (numbers <= most)).all()) if asked else None
        asked += f" {unit}" if asked and unit else ""
        text = " / ".join(format(value, form) for value in numbers)
        self.append(Row(self.group, name, text, unit, asked, peer, met))

    def none(self, name: str, count: int, of: str = "", *, peer: str = "") -> None:
        """Add a count that must be zero."""
        self.add(name, f"{count}{f' of {of}' if of else ''}", "0", count == 0, peer=peer)

    def covers(self, name: str, squares: Any, limits: Mapping[float, float], least: int = 1, *, dof: int = 3) -> None:
        """Add how many errors lie in their stated ellipsoids of the probabilities that `limits` names.

        `squares` (N,): squared Mahalanobis lengths of errors; `limits`: allowed difference from each stated share.
        With fewer than `least` errors nothing is shown to be met.
        """
        squares, level = np.asarray(squares), list(limits)
        shares = [float(np.mean(squares <= chi2.ppf(p, dof))) if len(squares) else np.nan for p in level]
        met = len(squares) >= least and all(abs(s - p) <= limits[p] for s, p in zip(shares, level, strict=True))
        asked = " / ".join(f"±{100 * limit:.1f}" for limit in limits.values()) + " %"
        name = f"{name} ({len(squares):,}): {' / '.join(f'{100 * p:.0f}' for p in level)} % ellipsoids cover"
        text = " / ".join(f"{100 * share:.1f}" for share in shares)
        self.append(Row(self.group, name, text, "%", asked, "" if len(squares) >= least else f"below {least}", met))


class Refusal(str):
    """Why a trial gave no result."""

    __slots__ = ()


def trials(function: Callable[[Any], Any], cases: Iterable[Any]) -> list[Any]:
    """Return `function` of each case, in order, on all cores with one thread each; a Refusal for a SightlineError.

    Results are kept when they are done: the same call, by the same code of program and benchmark, does what is missing.
    """
    whole = function if isinstance(function, partial) else partial(function)
    module = Path(sys.modules[whole.func.__module__].__file__ or "").read_bytes()
    code = sha256(module + code_digest().encode()).hexdigest()[:12]
    file = KEPT / f"{whole.func.__module__}.{whole.func.__qualname__}-{code}.pickle"
    cases = {repr((whole.args, whole.keywords, case)): case for case in cases}
    known = _read(file)
    missing = {key: case for key, case in cases.items() if key not in known}
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with (
        local_workers() as workers,
        Progress(*columns, TimeRemainingColumn(), console=Console(stderr=True), transient=True) as progress,
    ):
        bar = progress.add_task(whole.func.__qualname__, total=len(missing))
        futures = {workers.executor.submit(_tried, function, case): key for key, case in missing.items()}
        for future in as_completed(futures):
            known[futures[future]] = future.result()
            with file.open("ab") as kept:
                pickle.dump((futures[future], future.result()), kept)
            progress.advance(bar)
    return [known[key] for key in cases]


def _tried(function: Callable[[Any], Any], case: Any) -> Any:
    try:
        return function(case)
    except SightlineError as error:
        return Refusal(f"{type(error).__name__}: {error}")


def _read(file: Path) -> dict[Any, Any]:
    """Return the results of a file, and cut off a last one that was written in part."""
    file.parent.mkdir(parents=True, exist_ok=True)
    file.touch()
    known, end = {}, 0
    with file.open("rb+") as kept:
        try:
            while True:
                key, value = pickle.load(kept)  # noqa: S301 - written by `trials`
                known[key], end = value, kept.tell()
        except (EOFError, pickle.UnpicklingError):
            kept.truncate(end)
    return known


def finished(results: Sequence[Any]) -> tuple[list[Any], str]:
    """Return the results that are not refused, and "K of N" that are; print why."""
    for reason in (each for each in results if isinstance(each, Refusal)):
        print(f"refused: {reason}")
    done = [each for each in results if not isinstance(each, Refusal)]
    return done, f"{len(results) - len(done)} of {len(results)}"


def columns(results: Sequence[Any]) -> dict[str, np.ndarray]:
    """Return the values of records of the same keys that are not refused, as one array for each key."""
    records = [record for record in results if not isinstance(record, Refusal)]
    return {key: np.array([record[key] for record in records]) for key in (records[0] if records else ())}


def times_ms(
    programs: Mapping[str, Callable[[], object]],
    runs: int,
    clock: Callable[[], float] = time.perf_counter,
) -> dict[str, np.ndarray]:
    """Return the times (runs,), ms, of programs that alternate, so that a load on the machine affects all equally."""
    taken: dict[str, list[float]] = {name: [] for name in programs}
    for _ in range(runs + WARM_UP):
        for name, program in programs.items():
            started = clock()
            program()
            taken[name].append(1e3 * (clock() - started))
    return {name: np.array(values[WARM_UP:]) for name, values in taken.items()}


def time_ms(program: Callable[[], object], runs: int, clock: Callable[[], float] = time.perf_counter) -> np.ndarray:
    """Return the times (runs,), ms, of one program."""
    return times_ms({"": program}, runs, clock)[""]


def spread(values: Any, unit: str, form: str = ".3f") -> str:
    """Return median and 95 % quantile of values, as text."""
    return " / ".join(format(value, form) for value in np.quantile(np.asarray(values), (0.5, 0.95))) + f" {unit}"


def rms(values: Any) -> float:
    """Return the root of the mean square."""
    return float(np.sqrt(np.mean(np.square(values))))


def mahalanobis2(error: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """Return the squared lengths (...) of errors (..., D) over their covariances (..., D, D)."""
    return (error * np.linalg.solve(covariance, error[..., None])[..., 0]).sum(axis=-1)
