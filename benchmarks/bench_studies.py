"""Speed of trials: of each study on one core, and with a second worker process.

Trials of some studies are points with noise, those of others render images and detect the beads in them.

Trials per second refer to the processor time of one thread, so that other load matters little. Parallel efficiency is
the wall time of the same trials with one worker over twice that with two warm workers; the best of three, because other
load can only lower it.
"""

import time

from benchmarks.rows import Row
from sightline.studies.catalogue import STUDIES
from sightline.studies.runs.run import Workers, local_workers, one_trial

TRIALS = {"points": 10, "images": 4}
IMAGES = ("fig15", "porcine")  # studies whose trials are of whole images
PARALLEL = {"points": "coverage", "images": "porcine"}  # the studies whose trials are shared between workers
SHARED = {"points": 60, "images": 12}


def run(quick: bool) -> list[Row]:
    """Return the rows of this benchmark."""
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
    """Return the wall time, s, of trials submitted one by one, as a study does."""
    _all(name, workers, range(1000, 1000 + 4 * workers.number))  # until every worker is running
    started = time.perf_counter()
    _all(name, workers, range(number))
    return time.perf_counter() - started


def _all(name: str, workers: Workers, trials: range) -> None:
    given = [workers.executor.submit(one_trial, STUDIES[name], 3, trial) for trial in trials]
    for future in given:
        future.result()
