"""Run a study: do the missing trials, record each when it finishes, summarise all."""

from collections import Counter
from collections.abc import Callable
from concurrent.futures import FIRST_COMPLETED, CancelledError, Future, wait
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sightline.errors import RefusedError, UnusableInputError
from sightline.studies.record import Record, header
from sightline.studies.study import Study, Summary, Values
from sightline.studies.workers import Workers, cluster_workers, local_workers

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
