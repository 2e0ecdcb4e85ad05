"""What a study is, and what it hands on: figures with their intervals, tables, pictures, findings."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np

Values = dict[str, Any]  # one trial: plain numbers, lists of them, words; None where something was refused


@dataclass(frozen=True)
class Figure:
    """One measured number with its 95 % interval, which says how far the number of trials leaves it open.

    `value` is None where no trial gave any. `number`: of the trials or targets behind it.
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


@dataclass(frozen=True)
class Table:
    """Cells are words as people read them."""

    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    note: str = ""


@dataclass(frozen=True)
class Picture:
    """A drawing (`svg`) and the sentence under it."""

    title: str
    svg: str
    caption: str


@dataclass(frozen=True)
class Summary:
    """What a study found. `findings`: sentences; the first tables are printed, all stand on the page."""

    findings: tuple[str, ...]
    figures: tuple[Figure, ...]
    tables: tuple[Table, ...]
    pictures: tuple[Picture, ...] = field(default=())


class Study(Protocol):
    """One question asked of the twin, by many independent trials."""

    @property
    def name(self) -> str:
        """What the command line calls it."""
        ...

    @property
    def about(self) -> str:
        """One line of what it is."""
        ...

    @property
    def configuration(self) -> dict[str, Any]:
        """All that a trial depends on besides its generator, as JSON types."""
        ...

    def trial(self, rng: np.random.Generator) -> Values:
        """One trial, from its own generator alone."""
        ...

    def summary(self, trials: Sequence[Values]) -> Summary:
        """What the trials, in their order, come to."""
        ...
