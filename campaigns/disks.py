"""Failing disks while a program writes: it must refuse in one sentence and leave nothing incomplete.

From a random moment on the disk is full, read-only, or gone. Then it works again, and the next run must succeed.
"""

import os
import resource
from contextlib import suppress
from errno import EIO, ENOSPC
from functools import partial
from pathlib import Path

import numpy as np

from campaigns.campaign import Campaign, Damage, Ended
from campaigns.programs import PROGRAMS, Steps, interrupted

NOBODY = 65534  # root may write anywhere
FAULTS = {"full": ENOSPC, "gone": EIO, "read-only": 0}


def may_be_written(place: Path, *, written: bool = True) -> None:
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


def refusing(name: str, how: str, rng: np.random.Generator) -> Ended:
    """Run a program on a disk that fails. A refusal is one sentence with exit code 2 or 3."""

    def prepare(kind: str, at: int, place: Path) -> None:
        failing = False

        def fail() -> None:
            nonlocal failing
            if how == "read-only":
                may_be_written(place, written=False)
            else:
                failing = True
                resource.setrlimit(resource.RLIMIT_FSIZE, (0, resource.getrlimit(resource.RLIMIT_FSIZE)[1]))

        def refuse(event: str, flags: int) -> None:
            makes = event in ("os.mkdir", "os.link") or (event == "open" and flags & os.O_CREAT)
            if failing and (makes or how == "gone"):
                raise OSError(FAULTS[how], os.strerror(FAULTS[how]))

        if how == "read-only" and os.geteuid() == 0:
            become_nobody(place)
        Steps(kind, at, fail, refuse).watch()

    child, wrong, when = interrupted(name, rng, ("file", "journal"), prepare, may_be_written)
    last = (child.err.strip().splitlines() or [""])[-1]
    refused = child.code in (2, 3) and last.startswith("sightline: ")
    if (child.code != 0 and not refused) or "a bug in Sightline" in child.err:
        return Ended("crash", f"exit code {child.code} at {when}: {last[-200:]}")
    if wrong:
        return Ended("lost", f"{wrong} ({when})")
    return Ended("refused", last.removeprefix("sightline: ")[:60], said=last) if refused else Ended("right")


CLASSES = {f"{name}: {how}": Damage(partial(refusing, name, how)) for name in PROGRAMS for how in FAULTS}
CAMPAIGN = Campaign("disks", "Disks that refuse while programs write", CLASSES)
