"""Checks: a value against its limit, with a sentence for the user."""

from collections.abc import Iterable
from dataclasses import dataclass
from math import radians

# An entry point within the bone, such as a nail's wall, lies at least so far in it: four standard deviations of a
# planned entry along the wire. At most: half of a large femur above the knee [ours].
CLEAR_MM, MAX_BEFORE_MM = 2.0, 40.0


@dataclass(frozen=True)
class Check:
    """One named check.

    `name` is a key of docs/refusals.md; `figure` (the value) and `limit` are in `unit`. `figure` is None where the
    check is not a measurement, or the value could not be measured; in the latter case the check fails.
    """

    name: str
    passed: bool
    figure: float | None
    limit: float | None
    unit: str
    sentence: str


@dataclass(frozen=True)
class Limits:
    """Limits of a procedure: of the predicted 95 % errors of position and direction.

    `beyond_mm`: how far the drill goes past the end point. `before_mm`: bone begins up to this far before the entry
    point, which then lies in the bone; 0: the entry lies on the bone. The defaults are what the paper reached with its
    robot [paper].
    """

    position_mm: float = 1.0
    direction_rad: float = radians(0.6)
    beyond_mm: float = 0.0
    before_mm: float = 0.0

    @property
    def through_walls(self) -> bool:
        """Whether the drill passes both of its points within the bone, as through a nail's walls."""
        return self.before_mm > 0 and self.beyond_mm > 0


def failed(checks: Iterable[Check]) -> tuple[Check, ...]:
    """Return the failed checks, in order."""
    return tuple(check for check in checks if not check.passed)


def error_check(name: str, what: str, error_95: float, limit: float, unit: str, *, advice: str) -> Check:
    """Return the check of a 95 % error against its limit; a failure's sentence ends with `advice`."""
    passed = error_95 <= limit
    if passed:
        sentence = (
            f"With 95 % probability the error of the {what} is less than {error_95:.2f} {unit} (limit {limit:.2f} "
            f"{unit})."
        )
    else:
        shown = max(error_95, limit + 0.01)  # never rounded down to the limit that it exceeds
        sentence = (
            f"The 95 % error of the {what}, {shown:.2f} {unit}, is above its limit of {limit:.2f} {unit}; {advice}."
        )
    return Check(name, passed, error_95, limit, unit, sentence)
