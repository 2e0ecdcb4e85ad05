"""Studies and their results: estimates with intervals, tables, plots, findings."""

from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from typing import Any, Protocol

import numpy as np

Values = dict[str, Any]  # results of one trial: numbers, lists of them, texts; None for a refusal


@dataclass(frozen=True)
class Estimate:
    """One estimated value with its 95 % interval, which reflects the number of trials.

    `value` is None if no trial gave one. `number`: of trials or targets that it is estimated from.
    """

    name: str
    value: float | None
    low: float | None
    high: float | None
    unit: str
    number: int

    def __str__(self) -> str:
        if self.value is None:
            return "none"
        if self.low is None or self.high is None:
            return f"{self.value:.3g}"
        return f"{self.value:.3g} ({self.low:.3g} to {self.high:.3g})"


class EstimateGroup:
    """Base of dataclasses whose fields are estimates, tuples of estimates, or other values."""

    @property
    def estimates(self: Any) -> tuple[Estimate, ...]:
        """All estimates among the fields, in order."""
        values = [getattr(self, one.name) for one in fields(self)]
        every = [each for value in values for each in (value if isinstance(value, tuple) else (value,))]
        return tuple(each for each in every if isinstance(each, Estimate))


@dataclass(frozen=True)
class Table:
    """A table of texts for people."""

    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    note: str = ""


@dataclass(frozen=True)
class Plot:
    """A drawing (`svg`) and its caption."""

    title: str
    svg: str
    caption: str


@dataclass(frozen=True)
class Summary:
    """The results of a study. `findings`: sentences. The first tables are printed; the page shows all."""

    findings: tuple[str, ...]
    estimates: tuple[Estimate, ...]
    tables: tuple[Table, ...]
    plots: tuple[Plot, ...] = field(default=())


class Study(Protocol):
    """An experiment on the twin with many independent trials."""

    @property
    def name(self) -> str:
        """Its name on the command line."""
        ...

    @property
    def about(self) -> str:
        """One line that describes it."""
        ...

    @property
    def configuration(self) -> dict[str, Any]:
        """Everything that a trial depends on besides its generator, as JSON types."""
        ...

    def trial(self, rng: np.random.Generator) -> Values:
        """Run one trial, with no randomness but its own generator."""
        ...

    def summary(self, trials: Sequence[Values]) -> Summary:
        """Summarise trials, given in order."""
        ...
