"""A check: a figure held against its limit, with a sentence for the person who must act on it."""

from collections.abc import Iterable
from dataclasses import dataclass
from math import radians


@dataclass(frozen=True)
class Check:
    """One named check.

    `name` is a key of docs/refusals.md; `figure` and `limit` are in `unit`. `figure` is None where the check is no
    measurement, or where it could not be measured, and then the check fails.
    """

    name: str
    passed: bool
    figure: float | None
    limit: float | None
    unit: str
    sentence: str


@dataclass(frozen=True)
class Limits:
    """What a kind of trajectory allows: limits of the predicted 95 % errors, and `beyond_mm`, how far the drill goes
    past the end point. Defaults: what the paper reached with its robot [paper]."""

    position_mm: float = 1.0
    direction_rad: float = radians(0.6)
    beyond_mm: float = 0.0


def failed(checks: Iterable[Check]) -> tuple[Check, ...]:
    """The checks that did not pass, in their order."""
    return tuple(check for check in checks if not check.passed)
