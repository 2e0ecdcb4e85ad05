"""The checks that a procedure's file may name, and the rule that names one with its limits and their source."""

from collections.abc import Mapping
from dataclasses import dataclass
from math import inf
from types import MappingProxyType
from typing import Annotated, Self

from pydantic import BaseModel, ConfigDict, Field, model_validator

from sightline.common.checks import CheckCode, code_key

HEAD_CENTRE, LESSER = "head-centre", "lesser-trochanter"

# [ours] beyond any length (mm) or angle (°) of a wire in a bone
Limit = Annotated[float, Field(allow_inf_nan=False, ge=-1e3, le=1e3)]
Text = Annotated[str, Field(min_length=1, max_length=400)]


class Strict(BaseModel):
    """A part of a procedure's file: unknown keys are refused."""

    model_config = ConfigDict(strict=True, extra="forbid", frozen=True)


@dataclass(frozen=True)
class KnownCheck:
    """A check that a file may name: the limits that it takes, their unit, the aids or landmarks that it needs.

    `needs`: alternatives, each a set of keys. `side`: whether a metric is judged only where the side is given.
    """

    limits: tuple[str, ...]
    unit: str
    needs: tuple[frozenset[str], ...]
    side: bool = True


def _known(limits: str, unit: str, *needs: str, side: bool = True) -> KnownCheck:
    return KnownCheck(tuple(limits.split()), unit, tuple(frozenset(one.split()) for one in needs), side)


CHECKS: Mapping[str, KnownCheck] = MappingProxyType(
    {
        "entry and end": _known("", "mm", "head", HEAD_CENTRE),
        "side": _known("", "mm", "head", HEAD_CENTRE),
        "head to entry": _known("low", "mm", "head", HEAD_CENTRE),
        "tip in head": _known("", "mm", "head"),
        "lateral of lesser trochanter": _known("low high", "mm", LESSER),
        "anterior of lesser trochanter": _known("low high", "mm", LESSER),
        "wire to shaft": _known("low high", "°", "shaft"),
        "entry below cortex": _known("high", "mm", "head shaft cortex", f"{HEAD_CENTRE} shaft cortex"),
        "entry outside cortex": _known("high", "mm", "head shaft cortex", f"{HEAD_CENTRE} shaft cortex"),
        "wire length": _known("low high", "mm"),
        "angle between views": _known("low", "°"),
        "tip-apex distance": _known("low high", "mm", "head neck"),
        "calcar tip-apex distance": _known("high", "mm", "head neck calcar"),
        "tip to bone along wire": _known("low high", "mm", "head"),
        "tip to bone nearest": _known("low", "mm", "head"),
        "wire in neck": _known("low", "mm", "outline"),
        "wire in sacral corridor": _known("low", "mm", "s1-corridor", side=False),
        "tip in sacral corridor": _known("low", "mm", "s1-corridor", side=False),
        "wire in pedicle": _known("low", "mm", "pedicle", side=False),
        "entry to pedicle": _known("low high", "mm", "pedicle", side=False),
        "tip behind front": _known("low", "mm", "front", side=False),
        "tip to endplates": _known("low", "mm", "upper-endplate lower-endplate", side=False),
        "wire to growth plate": _known("high", "°", "growth-plate", side=False),
        "wire off middle of growth plate": _known("high", "mm", "growth-plate", side=False),
        "tip beyond growth plate": _known("low", "mm", "growth-plate", side=False),
        "view directions": _known("", "°"),
    }
)
# The limit of these is the 95 % error of their own value: no clearance.
ABOVE_ERROR = (CheckCode.TIP_IN_HEAD,)
# They show whether an end of the wire lies in the bone, where the corridor says that it must.
END_CHECKS = {
    "entry": {"entry below cortex", "lateral of lesser trochanter", "entry to pedicle"},
    "end": {"tip in head", "tip to bone nearest", "tip behind front", "tip in sacral corridor"},
}
# Their lower limit is at least the room that the implant needs.
IN_CORRIDOR = ("wire in neck", "wire in sacral corridor", "wire in pedicle")


class CheckRule(Strict):
    """One check of the wire against the bone: its name in CHECKS, its limits, and their source.

    The checks named like a metric of the implant judge the metric's 95 % interval, which must lie within the limits.

    `required`: without what it needs the plan is incomplete; otherwise the check is left out. `of`: what the limits are
    those of, in the sentence of a wire's length.
    """

    check: str
    low: Limit | None = None
    high: Limit | None = None
    required: bool = False
    of: Annotated[str, Field(min_length=1, max_length=80)] = "the implants"
    source: Text

    @model_validator(mode="after")
    def _known(self) -> Self:
        if self.check not in CHECKS:
            raise ValueError(f"names the check {self.check!r}, which is not known; choose from {', '.join(CHECKS)}")
        takes = CHECKS[self.check].limits
        for name in ("low", "high"):
            if (getattr(self, name) is None) == (name in takes):
                raise ValueError(
                    f"is the check {self.check!r}, which takes {' and '.join(takes) or 'no limits'}; "
                    f"{'give' if name in takes else 'remove'} {name!r}"
                )
        if not self.range[0] < self.range[1]:
            raise ValueError(f"has the limits {self.low:g} to {self.high:g}; give a lower limit below the upper one")
        return self

    @property
    def code(self) -> CheckCode | None:
        """The code of the check that the rule names; None where the check is "entry at cortex"."""
        return next((code for code in CheckCode if code == code_key(self.check)), None)

    @property
    def range(self) -> tuple[float, float]:
        """The accepted values, infinite where there is no limit."""
        return -inf if self.low is None else self.low, inf if self.high is None else self.high
