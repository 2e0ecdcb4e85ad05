"""Work on all cores, with progress and the time left; what is done can be kept, so that a stopped run goes on."""

import pickle
from collections.abc import Callable, Iterable
from concurrent.futures import as_completed
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from sightline.studies.run import code_digest, local_workers

KEPT = Path("out/bench")  # results by benchmark and by the digest of the program's code


def in_parallel(function: Callable[[Any], Any], arguments: Iterable[Any], keep: str | None = None) -> list[Any]:
    """Return `function` of each argument, in order, computed on all cores with one thread each.

    `keep`: name under which results are kept when they are done. The same call, by the same code of the program, does
    only what is missing. Delete KEPT after a change of the benchmark itself.
    """
    cases = list(arguments)
    file = None if keep is None else KEPT / f"{keep}-{code_digest()[:12]}.pickle"
    known = {} if file is None else _read(file)
    keys = [k if file is None else repr(case) for k, case in enumerate(cases)]
    missing = {key: case for key, case in zip(keys, cases, strict=True) if key not in known}
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with (
        local_workers() as workers,
        Progress(*columns, TimeRemainingColumn(), console=Console(stderr=True), transient=True) as progress,
    ):
        bar = progress.add_task(keep or "trials", total=len(missing))
        futures = {workers.executor.submit(function, case): key for key, case in missing.items()}
        for future in as_completed(futures):
            known[futures[future]] = future.result()
            if file is not None:
                with file.open("ab") as out:
                    pickle.dump((futures[future], future.result()), out)
            progress.advance(bar)
    return [known[key] for key in keys]


def _read(file: Path) -> dict[Any, Any]:
    """Return the results of a file, and cut off a last one that was written in part."""
    file.parent.mkdir(parents=True, exist_ok=True)
    file.touch()
    known, end = {}, 0
    with file.open("rb+") as kept:
        try:
            while True:
                key, value = pickle.load(kept)  # noqa: S301 - written by `in_parallel`
                known[key], end = value, kept.tell()
        except (EOFError, pickle.UnpicklingError):
            kept.truncate(end)
    return known
