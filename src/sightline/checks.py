"""A check: a figure held against its limit, with a sentence for the person who must act on it."""

from collections.abc import Iterable
from dataclasses import dataclass


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


def failed(checks: Iterable[Check]) -> tuple[Check, ...]:
    """The checks that did not pass, in their order."""
    return tuple(check for check in checks if not check.passed)
