"""Running a study: trials that are missing are done, kept as they are finished, and summed up."""

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

# Trials handed out at a time, for each worker: it never waits, and an interruption loses few [ours].
AHEAD = 3
# Workers that die this often with the same trial die of it, not by accident [ours].
MOST_DEATHS = 3


@dataclass(frozen=True)
class Result:
    """What a run of a study came to: `head` says what it follows from, `trials` how many were summed up."""

    head: dict[str, Any]
    trials: int
    summary: Summary

    def document(self) -> dict[str, Any]:
        """As JSON types, without the pictures."""
        return {
            **self.head,
            "trials": self.trials,
            "findings": list(self.summary.findings),
            "figures": [vars(figure) for figure in self.summary.figures],
            "tables": [vars(table) for table in self.summary.tables],
        }


@dataclass(frozen=True)
class Run:
    """The first `trials` trials of a study, some of which may be finished already.

    Trial k draws from `default_rng([seed, k])`: its values depend neither on who does it nor on what else is done.
    """

    study: Study
    trials: int
    seed: int
    record: Record

    @staticmethod
    def open(study: Study, trials: int, seed: int, folder: Path) -> "Run":
        """With the trials that `folder` has. Raises UnusableInputError, where they are of something else."""
        if trials < 1:
            raise UnusableInputError(f"{trials} trials say nothing; give at least one")
        return Run(study, trials, seed, Record.open(folder, header(study, seed)))

    @property
    def missing(self) -> list[int]:
        """The trials that are not finished."""
        return [k for k in range(self.trials) if k not in self.record.finished]

    def do(
        self, scheduler: str | None = None, workers: int | None = None, advance: Callable[[], None] = lambda: None
    ) -> None:
        """Do what is missing, by local processes (as many as cores unless `workers` tells) or the Dask cluster of
        `scheduler`; `advance` is called once for each. Trials whose worker died are done again by new ones.

        Raises UnusableInputError; RefusedError where workers keep dying.
        """
        deaths = Counter[int]()  # of workers that had the trial in hand
        while self.missing:
            with local_workers(workers) if scheduler is None else cluster_workers(scheduler) as hired:
                deaths.update(self._until_a_death(hired, deaths, advance))
            deadly = [trial for trial in self.missing if deaths[trial] >= MOST_DEATHS]
            if deadly:
                raise RefusedError(
                    f"{MOST_DEATHS} workers died of trial {deadly[0]}: too little memory, or a bug; {self._kept}"
                )

    def result(self) -> Result:
        """Of all trials, once none is missing."""
        values = [self.record.finished[k] for k in range(self.trials)]
        return Result(header(self.study, self.seed), self.trials, self.study.summary(values))

    @property
    def _kept(self) -> str:
        return f"{len(self.record.finished)} finished trials are kept; the same command goes on from there"

    def _until_a_death(self, hired: Workers, deaths: Counter[int], advance: Callable[[], None]) -> list[int]:
        """Do trials until none is left or a worker dies; then, those that it may have died of."""
        fresh = [trial for trial in self.missing if trial not in deaths]
        todo = iter(fresh or sorted(self.missing, key=lambda trial: deaths[trial]))
        most = AHEAD * hired.number if fresh else 1  # one alone shows which it is that kills
        running: dict[Future[Values], int] = {}
        try:
            while True:
                while len(running) < most and (trial := next(todo, None)) is not None:
                    running[hired.executor.submit(one_trial, self.study, self.seed, trial)] = trial
                if not running:
                    return []
                self._keep(running, advance)
        except hired.lost:
            return list(running.values())
        except CancelledError:
            raise UnusableInputError(f"the scheduler is gone; {self._kept}") from None

    def _keep(self, running: dict[Future[Values], int], advance: Callable[[], None]) -> None:
        """Wait for some of the trials in hand, and keep those that went well; raises what another raised."""
        finished = wait(running, return_when=FIRST_COMPLETED).done
        done = [future for future in running if future in finished]  # a set has no order, the record has one
        good = [future for future in done if not future.cancelled() and future.exception() is None]
        if good:
            self.record.add({running.pop(future): future.result() for future in good})
        for _ in good:
            advance()
        for future in done:
            future.result()


def one_trial(study: Study, seed: int, trial: int) -> Values:
    """What a worker does."""
    return study.trial(np.random.default_rng([seed, trial]))
