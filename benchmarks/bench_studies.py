"""How fast trials are done: each study's on one core, and what a second worker process adds.

Trials of some studies are points with noise, those of others render images and find the beads in them.

Trials per second count the processor time of one thread, so that other work on the machine matters little. Parallel
efficiency is the wall time of the same trials with one worker over twice that with two, workers warm; the best of
three, since other work can only lower it.
"""

import time

from benchmarks.rows import Row
from sightline.studies.catalogue import STUDIES
from sightline.studies.run import one_trial
from sightline.studies.workers import Workers, local_workers

TRIALS = {"points": 10, "images": 4}
IMAGES = ("fig8", "fig15", "porcine")  # studies whose trials are of whole images
PARALLEL = {"points": "coverage", "images": "fig8"}  # the studies whose trials are shared between workers
SHARED = {"points": 60, "images": 12}


def run(quick: bool) -> list[Row]:
    """The rows of this benchmark."""
    return [row for kind in PARALLEL for row in _rows(kind, quick)]


def _rows(kind: str, quick: bool) -> list[Row]:
    number, shared = (TRIALS[kind] // 4, SHARED[kind] // 5) if quick else (TRIALS[kind], SHARED[kind])
    names = [name for name in STUDIES if (name in IMAGES) == (kind == "images")]
    speeds = [
        Row(f"studies, {kind}", f"{name}: trials per second and core", f"{_per_second(name, number):.2f}")
        for name in names
    ]
    efficiency = max(_efficiency(PARALLEL[kind], shared) for _ in range(1 if quick else 3))
    what = f"{PARALLEL[kind]}: parallel efficiency of two processes"
    return [*speeds, Row(f"studies, {kind}", what, f"{efficiency:.2f}")]


def _per_second(name: str, number: int) -> float:
    one_trial(STUDIES[name], 1, 0)  # compiles and fills caches
    started = time.process_time()
    for trial in range(number):
        one_trial(STUDIES[name], 2, trial)
    return number / (time.process_time() - started)


def _efficiency(name: str, number: int) -> float:
    with local_workers(1) as one:
        alone = _seconds(name, one, number)
    with local_workers(2) as two:
        return alone / (2 * _seconds(name, two, number))


def _seconds(name: str, workers: Workers, number: int) -> float:
    """Wall time of trials that are handed out one by one, as a study does."""
    _all(name, workers, range(1000, 1000 + 4 * workers.number))  # every worker has begun
    started = time.perf_counter()
    _all(name, workers, range(number))
    return time.perf_counter() - started


def _all(name: str, workers: Workers, trials: range) -> None:
    given = [workers.executor.submit(one_trial, STUDIES[name], 3, trial) for trial in trials]
    for future in given:
        future.result()
