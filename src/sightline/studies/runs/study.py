"""Studies and their results: estimates with intervals, tables, plots, findings."""

from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from typing import Any, Protocol

import numpy as np
from scipy.stats import beta, binom

from sightline.common.geometry.covariance import TWO_SIDED_95

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
        values = [getattr(self, item.name) for item in fields(self)]
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


_TAIL = 0.025


def quantile(name: str, values: np.ndarray, at: float, unit: str = "mm") -> Estimate:
    """Estimate the `at` quantile of independent values (N,), with order statistics as the 95 % interval.

    An end of the interval is None if N is too small.
    """
    ordered, n = np.sort(np.asarray(values, dtype=np.float64)), len(values)
    if n == 0:
        return Estimate(name, None, None, None, unit, 0)
    low, high = int(binom.ppf(_TAIL, n, at)) - 1, int(binom.ppf(1 - _TAIL, n, at))
    ends = [float(ordered[k]) if 0 <= k < n else None for k in (low, high)]
    return Estimate(name, float(np.quantile(ordered, at)), ends[0], ends[1], unit, n)


def share(name: str, hits: np.ndarray) -> Estimate:
    """Estimate the share of true values (N,), with the Clopper-Pearson interval."""
    n, k = len(hits), int(np.sum(hits))
    if n == 0:
        return Estimate(name, None, None, None, "", 0)
    low = float(beta.ppf(_TAIL, k, n - k + 1)) if k else 0.0
    high = float(beta.ppf(1 - _TAIL, k + 1, n - k)) if k < n else 1.0
    return Estimate(name, k / n, low, high, "", n)


def rms(name: str, groups: Sequence[np.ndarray], unit: str = "") -> Estimate:
    """Estimate the root mean square of all values, with a normal interval of the mean square over the trials.

    `groups`: the values of each trial, which may depend on each other.
    """
    kept = [np.mean(np.square(group)) for group in groups if len(group)]
    sizes = [len(group) for group in groups if len(group)]
    if not kept:
        return Estimate(name, None, None, None, unit, 0)
    weights = np.array(sizes) / np.sum(sizes)
    mean = float(weights @ kept)
    if len(kept) < 2:
        return Estimate(name, float(np.sqrt(mean)), None, None, unit, len(kept))
    half = TWO_SIDED_95 * float(np.sqrt(np.sum((weights * (np.array(kept) - mean)) ** 2) * len(kept) / (len(kept) - 1)))
    return Estimate(
        name, float(np.sqrt(mean)), float(np.sqrt(max(mean - half, 0.0))), float(np.sqrt(mean + half)), unit, len(kept)
    )
