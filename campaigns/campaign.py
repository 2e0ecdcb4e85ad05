"""Campaigns: classes of damage, single tries, and the table of how tries ended."""

import hashlib
import importlib
import traceback
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sightline.errors import SightlineError
from sightline.studies.study import Summary, Table, Values, share

# How a try may end. "wrong": GO, with an error above 1.5 times the stated 95 % bound, although all observations
# together differ by 5 standard deviations or more from those of the undamaged case; "weak": by 2 to 5; "unseen": less.
# "lost": acknowledged data is missing or incomplete. "unsafe": a robot moved or did not stop when it must not, or the
# app disclosed or changed what it must not. The last four are defects.
ENDINGS = ("refused", "NO-GO", "incomplete", "right", "unseen", "weak", "wrong", "crash", "lost", "unsafe")
DEFECTS = ENDINGS[6:]
GOES = ("right", "unseen", "weak", "wrong")


@dataclass(frozen=True)
class Ended:
    """How one try ended, why, and for a plan the larger error of its end points over its 95 % bound."""

    how: str
    why: str = ""
    ratio: float | None = None
    said: str = ""  # the full message of a refusal


@dataclass(frozen=True)
class Damage:
    """One class of damage. `make` does one try, or raises what the program raises.

    `cause`: words of which a refusal must contain one to name the true cause.
    """

    make: Callable[[np.random.Generator], Ended]
    cause: tuple[str, ...] = ()


@dataclass(frozen=True)
class Campaign:
    """A study (`sightline.studies`) whose trials are tries of random classes."""

    name: str
    about: str
    classes: Mapping[str, Damage]

    @property
    def configuration(self) -> dict[str, Any]:
        """The classes, and a hash of the campaigns' code."""
        code = b"".join(file.read_bytes() for file in sorted(Path(__file__).parent.glob("*.py")))
        return {"classes": list(self.classes), "campaigns": hashlib.sha256(code).hexdigest()[:16]}

    def __reduce__(self) -> tuple[Callable[[str], "Campaign"], tuple[str]]:
        """Pickle by name, because closures cannot be pickled."""
        return called, (self.name,)

    def trial(self, rng: np.random.Generator) -> Values:
        """Return the result of one try of a random class."""
        name = str(rng.choice(list(self.classes)))
        ended = attempt(self.classes[name].make, rng)
        return {"class": name, **vars(ended), "named": _names_cause(self.classes[name], ended)}

    def summary(self, trials: Sequence[Values]) -> Summary:
        """Return the table by class, and the defects."""
        rows = [self._row(name, [one for one in trials if one["class"] == name]) for name in self.classes]
        total = self._row("all", list(trials))
        defects = [one for one in trials if one["how"] in DEFECTS]
        shares = [share(f"{self.name}: {how}", np.array([one["how"] == how for one in trials])) for how in ENDINGS]
        told = Counter((one["class"], one["how"], one["why"]) for one in defects)
        findings = [f"{name}: {how} {count} times: {why}" for (name, how, why), count in told.most_common()]
        columns = ("class", "tries", *ENDINGS, "largest error of a GO / bound", "cause named", "mostly for")
        return Summary(
            findings=tuple(findings) or ("No defect.",),
            estimates=tuple(shares),
            tables=(Table(self.about, columns, (*rows, total)),),
        )

    def _row(self, name: str, tries: list[Values]) -> tuple[str, ...]:
        ends = Counter(one["how"] for one in tries)
        ratios = [one["ratio"] for one in tries if one["how"] in GOES and one["ratio"] is not None]
        named = [one["named"] for one in tries if one["named"] is not None]
        why = Counter(one["why"] for one in tries if one["how"] in ("refused", "NO-GO", "incomplete"))
        return (
            name,
            str(len(tries)),
            *(str(ends[how] or "") for how in ENDINGS),
            f"{max(ratios):.2f}" if ratios else "",
            f"{sum(named) / len(named):.0%}" if named else "",
            why.most_common(1)[0][0] if why else "",
        )


def called(name: str) -> Campaign:
    """Return the campaign of a module in this folder."""
    return importlib.import_module(f"campaigns.{name}").CAMPAIGN


def attempt(make: Callable[[np.random.Generator], Ended], rng: np.random.Generator) -> Ended:
    """Return how one try ended; an exception is a refusal if it is a SightlineError, else a crash."""
    try:
        return make(rng)
    except SightlineError as refusal:
        return Ended("refused", type(refusal).__name__, said=str(refusal))
    except Exception as fault:
        last = traceback.extract_tb(fault.__traceback__)[-1]
        return Ended(
            "crash", f"{type(fault).__name__} in {Path(last.filename).name}:{last.lineno}", said=str(fault)[:200]
        )


def _names_cause(damage: Damage, ended: Ended) -> bool | None:
    """Return whether a refusal names the cause; None without a refusal or an expected cause."""
    if not damage.cause or ended.how not in ("refused", "NO-GO"):
        return None
    return any(word in f"{ended.why} {ended.said}".lower() for word in damage.cause)
