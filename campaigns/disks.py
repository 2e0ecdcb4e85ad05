"""Failing disks and jumping clocks while a program writes: it must refuse in one sentence and leave nothing incomplete.

From a random moment on the disk is full, read-only, or gone. Then it works again, and the next run must succeed.
"""

import os
import resource
from contextlib import suppress
from dataclasses import dataclass
from datetime import datetime, timedelta, tzinfo
from errno import EIO, ENOSPC
from pathlib import Path
from tempfile import TemporaryDirectory
from unittest.mock import patch

import numpy as np

from campaigns.campaign import Campaign, Damage, Ended
from campaigns.programs import PROGRAMS, Steps, in_a_child, moment, not_finished, place_for
from sightline.case.journal import Actor, Case, Kind
from sightline.case.journal import case as journal

NOBODY = 65534  # root may write anywhere
LEAPS_S = (-86_400.0, -3_600.0, -60.0, -0.001, 0.0, 60.0, 86_400.0)


@dataclass
class Disk:
    """A disk that fails from some moment on, with `errno`: on creating files and folders or, if `gone`, on anything."""

    errno: int = 0
    gone: bool = False

    def fail(self, errno: int, gone: bool) -> None:
        """Begin to fail; no file can grow any more."""
        self.errno, self.gone = errno, gone
        resource.setrlimit(resource.RLIMIT_FSIZE, (0, resource.getrlimit(resource.RLIMIT_FSIZE)[1]))

    def refuse(self, event: str, flags: int) -> None:
        """Raise OSError, as the system would."""
        makes = event in ("os.mkdir", "os.link") or (event == "open" and flags & os.O_CREAT)
        if self.errno and (makes or self.gone):
            raise OSError(self.errno, os.strerror(self.errno))


def may_be_written(place: Path, *, written: bool) -> None:
    """Set whether a folder and its content may be written."""
    for path in (*place.rglob("*"), place):
        with suppress(FileNotFoundError):
            path.chmod((0o755 if written else 0o555) if path.is_dir() else (0o644 if written else 0o444))


def become_nobody(place: Path) -> None:
    """Give a folder to NOBODY, and become it."""
    for path in (*place.rglob("*"), place):
        os.chown(path, NOBODY, NOBODY)
    os.setegid(NOBODY)
    os.seteuid(NOBODY)


def refusing(name: str, how: str) -> Damage:
    """Return the class of a program on a disk that becomes "full", "read-only" or "gone".

    A refusal is one sentence with exit code 2 or 3, and leaves complete data."""
    program = PROGRAMS[name]

    def make(rng: np.random.Generator) -> Ended:
        kind, at = moment(name, rng, ("file", "journal"))
        with place_for(program) as place:

            def work() -> int:
                disk = Disk()
                acts = {
                    "full": lambda: disk.fail(ENOSPC, False),
                    "gone": lambda: disk.fail(EIO, True),
                    "read-only": lambda: may_be_written(place, written=False),
                }
                if how == "read-only" and os.geteuid() == 0:
                    become_nobody(place)
                Steps(kind, at, acts[how], disk.refuse).watch()
                return program.run(place)

            child = in_a_child(work)
            may_be_written(place, written=True)
            last = (child.err.strip().splitlines() or [""])[-1]
            refused = child.code in (2, 3) and last.startswith("sightline: ")
            if (child.code != 0 and not refused) or "a bug in Sightline" in child.err:
                return Ended("crash", f"exit code {child.code} at {kind} {at}: {last[-200:]}")
            if wrong := program.damage(place, child.out) or not_finished(program, place):
                return Ended("lost", f"{wrong} ({kind} {at})")
        return Ended("refused", last.removeprefix("sightline: ")[:60], said=last) if refused else Ended("right")

    return Damage(make)


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
            held = [entry.chain for entry in case.entries()]
            if case.problems or held != made:
                return Ended("lost", "the case has a problem" if case.problems else "entries are lost or out of order")
    return Ended("right")


CLASSES = {f"{name}: {how}": refusing(name, how) for name in PROGRAMS for how in ("full", "read-only", "gone")}
CLASSES |= {"a case whose clock leaps": Damage(leaping)}
CAMPAIGN = Campaign("disks", "Disks that refuse and clocks that leap while programs write", CLASSES)
