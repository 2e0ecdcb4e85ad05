"""A rule of a frame's design, and the check that it gives."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from sightline.checks import Check
from sightline.frame.model import Frame

Values = Iterator[tuple[str, float | None]]  # (place, value; None where it cannot be measured)


@dataclass(frozen=True)
class Rule:
    """The rule of a check: `measure` yields a value for every place of a frame; `limit` applies to the worst."""

    name: str
    measure: Callable[[Frame], Values]
    at_least: bool
    limit: float
    unit: str
    meaning: str
    advice: str


def judge(rules: tuple[Rule, ...], frame: Frame) -> tuple[Check, ...]:
    """Return a check of each rule that applies to some place of the frame."""
    measured = ((rule, list(rule.measure(frame))) for rule in rules)
    return tuple(_judge(rule, values) for rule, values in measured if values)


def _judge(rule: Rule, values: list[tuple[str, float | None]]) -> Check:
    """Return the check of the worst place; a place that cannot be measured is the worst."""
    sign = 1 if rule.at_least else -1
    where, value = min(values, key=lambda entry: -np.inf if entry[1] is None else sign * entry[1])
    passed = value is not None and sign * value >= sign * rule.limit
    sentence = f"{where}: {rule.meaning}" if passed else f"{where}: {rule.advice}"
    return Check(rule.name, passed, None if value is None else float(value), rule.limit, rule.unit, sentence)
