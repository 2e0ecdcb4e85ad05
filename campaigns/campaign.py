"""What all campaigns share: classes of damage, single tries, the table of how tries ended, and a record of runs."""

import hashlib
import importlib
import json
import traceback
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sightline.errors import SightlineError
from sightline.studies.runs.study import Summary, Table, Values, share

# How a try may end. "wrong": GO, with an error above 1.5 times the stated 95 % bound, although all observations
# together differ by 5 standard deviations or more from those of the undamaged case; "weak": by 2 to 5; "unseen": less.
# "lost": acknowledged data is missing or incomplete. "unsafe": a robot moved or did not stop when it must not, or the
# app disclosed or changed what it must not. The last four are defects.
ENDINGS = ("refused", "NO-GO", "incomplete", "right", "unseen", "weak", "wrong", "crash", "lost", "unsafe")
DEFECTS = ENDINGS[6:]
GOES = ("right", "unseen", "weak", "wrong")


@dataclass(frozen=True)
class Ended:
    """How one try ended, why, for a plan the larger error of its end points over its 95 % bound, and the full message
    of a refusal."""

    how: str
    why: str = ""
    ratio: float | None = None
    said: str = ""


@dataclass(frozen=True)
class Damage:
    """One class of damage. `make` does one try, or raises what the program raises.

    `cause`: words of which a refusal must contain one to name the true cause.
    """

    make: Callable[[np.random.Generator], Ended]
    cause: tuple[str, ...] = ()


def attempt(make: Callable[[np.random.Generator], Ended], rng: np.random.Generator) -> Ended:
    """Return how one try ended; an exception is a refusal if it is a SightlineError, else a crash."""
    try:
        return make(rng)
    except SightlineError as refusal:
        return Ended("refused", type(refusal).__name__, said=str(refusal))
    except Exception as fault:
        last = traceback.extract_tb(fault.__traceback__)[-1]
        why = f"{type(fault).__name__} in {Path(last.filename).name}:{last.lineno}"
        return Ended("crash", why, said=str(fault)[:200])


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
        """Return the result of one try of a random class; "named": whether a refusal names the cause, None without a
        refusal or an expected cause."""
        name = str(rng.choice(list(self.classes)))
        ended, cause = attempt(self.classes[name].make, rng), self.classes[name].cause
        named = None
        if cause and ended.how in ("refused", "NO-GO"):
            named = any(word in f"{ended.why} {ended.said}".lower() for word in cause)
        return {"class": name, **vars(ended), "named": named}

    def summary(self, trials: Sequence[Values]) -> Summary:
        """Return the table by class, and the defects."""
        rows = [_row(name, [each for each in trials if each["class"] == name]) for name in self.classes]
        defects = Counter((t["class"], t["how"], t["why"]) for t in trials if t["how"] in DEFECTS)
        findings = [f"{name}: {how} {count} times: {why}" for (name, how, why), count in defects.most_common()]
        columns = ("class", "tries", *ENDINGS, "largest error of a GO / bound", "cause named", "mostly for")
        return Summary(
            findings=tuple(findings) or ("No defect.",),
            estimates=tuple(
                share(f"{self.name}: {how}", np.array([t["how"] == how for t in trials])) for how in ENDINGS
            ),
            tables=(Table(self.about, columns, (*rows, _row("all", trials))),),
        )


def _row(name: str, tries: Sequence[Values]) -> tuple[str, ...]:
    ends = Counter(each["how"] for each in tries)
    ratios = [each["ratio"] for each in tries if each["how"] in GOES and each["ratio"] is not None]
    named = [each["named"] for each in tries if each["named"] is not None]
    why = Counter(each["why"] for each in tries if each["how"] in ("refused", "NO-GO", "incomplete"))
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


class Finished(dict[str, dict[str, Any]]):
    """Finished runs by their names, a line of JSON each, so that a stopped series goes on."""

    def __init__(self, file: Path, key: str = "run") -> None:
        self._file, self._key = file, key
        file.parent.mkdir(parents=True, exist_ok=True)
        lines = map(json.loads, file.read_text().splitlines() if file.exists() else [])
        super().__init__({line[key]: line for line in lines})

    def add(self, name: str, **values: Any) -> None:
        """Record a run."""
        self[name] = {self._key: name, **values}
        with self._file.open("a") as file:
            file.write(json.dumps(self[name]) + "\n")
