"""Failing disks and jumping clocks while a program writes: it must refuse in one sentence and leave nothing incomplete.

From a random moment on the disk is full, read-only, or gone. Then it works again, and the next run must succeed.
"""

import os
import resource
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from datetime import datetime, timedelta, tzinfo
from errno import EIO, ENOSPC
from pathlib import Path
from tempfile import TemporaryDirectory
from unittest.mock import patch

import numpy as np

from campaigns.campaign import Campaign, Damage, Ended
from campaigns.kills import moment
from campaigns.programs import PROGRAMS, Steps, Told, in_a_child, not_finished, place_for
from sightline.case.journal import Actor, Case, Kind
from sightline.case.journal import case as journal

NOBODY = 65534  # root may write anywhere
LEAPS_S = (-86_400.0, -3_600.0, -60.0, -0.001, 0.0, 60.0, 86_400.0)


@dataclass
class Disk:
    """A disk that fails from some moment on, with `errno`: on creating files and folders or, if `gone`, on anything."""

    errno: int = 0
    gone: bool = False

    def fill(self) -> None:
        """Make creating and growing files fail."""
        self.errno = ENOSPC
        _let_no_file_grow()

    def vanish(self) -> None:
        """Make every operation fail."""
        self.errno, self.gone = EIO, True
        _let_no_file_grow()

    def refuse(self, event: str, flags: int) -> None:
        """Raise OSError, as the system would."""
        makes = event in ("os.mkdir", "os.link") or (event == "open" and flags & os.O_CREAT)
        if self.errno and (makes or self.gone):
            raise OSError(self.errno, os.strerror(self.errno))


def _let_no_file_grow() -> None:
    resource.setrlimit(resource.RLIMIT_FSIZE, (0, resource.getrlimit(resource.RLIMIT_FSIZE)[1]))


def all_of(place: Path) -> list[Path]:
    """Return a folder and its content, the folder last."""
    return [*place.rglob("*"), place]


def may_be_written(place: Path, *, written: bool) -> None:
    """Set whether a folder may be written."""
    for path in all_of(place):
        with suppress(FileNotFoundError):
            path.chmod((0o755 if written else 0o555) if path.is_dir() else (0o644 if written else 0o444))


def refusing(name: str, how: str) -> Damage:
    """Return the class of a program on a disk that becomes "full", "read-only" or "gone"."""
    program = PROGRAMS[name]

    def make(rng: np.random.Generator) -> Ended:
        kind, at = moment(name, rng, ("file", "journal"))
        with place_for(program) as place:

            def work() -> int:
                disk = Disk()
                acts = {
                    "full": disk.fill,
                    "gone": disk.vanish,
                    "read-only": lambda: may_be_written(place, written=False),
                }
                if how == "read-only" and os.geteuid() == 0:
                    for path in all_of(place):
                        os.chown(path, NOBODY, NOBODY)
                    os.setegid(NOBODY)
                    os.seteuid(NOBODY)
                Steps(kind, at, acts[how], disk.refuse).watch()
                return program.run(place)

            told = in_a_child(work)
            may_be_written(place, written=True)
            return judged(told, lambda: program.damage(place, told.out) or not_finished(program, place), f"{kind} {at}")

    return Damage(make)


def judged(told: Told, look: Callable[[], str], when: str) -> Ended:
    """Return how a run ended: a refusal is one sentence with exit code 2 or 3, and leaves complete data."""
    last = (told.err.strip().splitlines() or [""])[-1]
    refused = told.code in (2, 3) and last.startswith("sightline: ")
    if (told.code != 0 and not refused) or "a bug in Sightline" in told.err:
        return Ended("crash", f"exit code {told.code} at {when}: {last[-200:]}")
    wrong = look()
    if wrong:
        return Ended("lost", f"{wrong} ({when})")
    return Ended("refused", last.removeprefix("sightline: ")[:60], said=last) if refused else Ended("right")


class Leaping(datetime):
    """A clock that is set forward and back."""

    leap = timedelta()
    rng = np.random.default_rng()

    @classmethod
    def now(cls, tz: tzinfo | None = None) -> datetime:
        """Return the time that the clock shows."""
        cls.leap += timedelta(seconds=float(cls.rng.choice(LEAPS_S)))
        return datetime.now(tz) + cls.leap


def leaping(rng: np.random.Generator) -> Ended:
    """Record entries while the clock jumps: all must be there, in order, and the case must be intact."""
    Leaping.leap, Leaping.rng = timedelta(), rng
    with TemporaryDirectory() as folder, patch.object(journal, "datetime", Leaping):
        made: list[str] = []
        for _ in range(3):
            with Case.create(Path(folder) / "case", exist_ok=True) as case:
                made += [case.record(Kind.CHANGED, {"to": k}, by=Actor.APP).chain for k in range(4)]
        with Case.open(Path(folder) / "case") as case:
            held = [one.chain for one in case.entries()]
            if case.problems or held != made:
                return Ended("lost", "the case has a problem" if case.problems else "entries are lost or out of order")
    return Ended("right")


CLASSES = {f"{name}: {how}": refusing(name, how) for name in PROGRAMS for how in ("full", "read-only", "gone")}
CLASSES |= {"a case whose clock leaps": Damage(leaping)}
CAMPAIGN = Campaign("disks", "Disks that refuse and clocks that leap while programs write", CLASSES)
