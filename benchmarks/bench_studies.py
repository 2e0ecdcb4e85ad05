"""How fast trials are done: each study's on one core, and what a second worker process adds.

Trials per second count the processor time of one thread, so that other work on the machine matters little. Parallel
efficiency is the wall time of the same trials with one worker over twice that with two, workers warm; the best of
three, since other work can only lower it.
"""

import time

from benchmarks.rows import Row
from sightline.studies.catalogue import STUDIES
from sightline.studies.run import one_trial
from sightline.studies.workers import Workers, local_workers

TRIALS = 10
PARALLEL = "coverage"  # the study whose trials are shared between workers
SHARED = 60


def run(quick: bool) -> list[Row]:
    """The rows of this benchmark."""
    number = TRIALS // 5 if quick else TRIALS
    rows = [
        Row("studies, points", f"{name}: trials per second and core", f"{_per_second(name, number):.2f}")
        for name in STUDIES
    ]
    efficiency = max(_efficiency(SHARED // 5 if quick else SHARED) for _ in range(1 if quick else 3))
    what = f"{PARALLEL}: parallel efficiency of two processes"
    return [*rows, Row("studies, points", what, f"{efficiency:.2f}")]


def _per_second(name: str, number: int) -> float:
    one_trial(STUDIES[name], 1, 0)  # compiles and fills caches
    started = time.process_time()
    for trial in range(number):
        one_trial(STUDIES[name], 2, trial)
    return number / (time.process_time() - started)


def _efficiency(number: int) -> float:
    with local_workers(1) as one:
        alone = _seconds(one, number)
    with local_workers(2) as two:
        return alone / (2 * _seconds(two, number))


def _seconds(workers: Workers, number: int) -> float:
    """Wall time of trials that are handed out one by one, as a study does."""
    _all(workers, range(1000, 1000 + 4 * workers.number))  # every worker has begun
    started = time.perf_counter()
    _all(workers, range(number))
    return time.perf_counter() - started


def _all(workers: Workers, trials: range) -> None:
    given = [workers.executor.submit(one_trial, STUDIES[PARALLEL], 3, trial) for trial in trials]
    for future in given:
        future.result()
