"""Work on all cores."""

from collections.abc import Callable, Iterable
from typing import Any

from sightline.studies.workers import local_workers


def in_parallel(function: Callable[[Any], Any], arguments: Iterable[Any]) -> list[Any]:
    """Return `function` of each argument, in order, computed on all cores with one thread each."""
    with local_workers() as workers:
        return list(workers.executor.map(function, arguments, chunksize=4))
