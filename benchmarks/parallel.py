"""Work on all cores."""

from collections.abc import Callable, Iterable
from typing import Any

from sightline.studies.workers import local_workers


def in_parallel(function: Callable[[Any], Any], arguments: Iterable[Any]) -> list[Any]:
    """`function` of each argument on all cores, one thread each, in order."""
    with local_workers() as workers:
        return list(workers.executor.map(function, arguments, chunksize=4))
