"""The program as tests need it: python -m tests.app.program FOLDER ARGUMENTS...

FOLDER/ahead.txt holds by how many seconds the clock is ahead that the age of plans is read from. The worker begins once
FOLDER/go is there, as after compilation. Planning images are those in FOLDER/images, which are rendered once for all
tests. A live image is stale after PATIENT_STALE_S: how fast a busy machine analyses one is a benchmark's matter.
"""

import sys
import time
from collections.abc import Sequence
from datetime import datetime, timedelta
from functools import partial
from pathlib import Path
from typing import Any

from sightline.app.session import planning, readiness, rehearsing
from sightline.app.session.jobs import warm_up
from sightline.case.views import NAMES
from sightline.case.watch import analyser
from sightline.cli import main

PATIENT_STALE_S = 5.0


def prepare(folder: Path, images: Path) -> None:
    """Fill FOLDER, without the file that lets the worker begin."""
    set_ahead(folder, 0.0)
    (folder / "images").symlink_to(images)


def set_ahead(folder: Path, seconds: float) -> None:
    """Set the clock: the program that reads it never finds the file empty."""
    new = folder / "ahead.new"
    new.write_text(str(seconds))
    new.replace(folder / "ahead.txt")


class _Clock(datetime):
    """`now` is ahead by what the file says."""

    file = Path()

    @classmethod
    def now(cls, tz: Any = None) -> datetime:
        return datetime.now(tz) + timedelta(seconds=float(cls.file.read_text()))


def wait_and_warm_up(folder: Path) -> None:
    while not (folder / "go").exists():
        time.sleep(0.05)
    warm_up()


def images(folder: Path, patient: rehearsing.Patient, names: Sequence[str] = NAMES) -> dict[str, bytes]:
    return {name: (folder / "images" / f"demo_{name}.dcm").read_bytes() for name in names}


if __name__ == "__main__":
    from tests.app import program  # the worker imports it by this name

    place = Path(sys.argv.pop(1))
    _Clock.file = place / "ahead.txt"
    readiness.datetime = _Clock
    analyser.STALE_S = PATIENT_STALE_S
    planning.warm_up = partial(program.wait_and_warm_up, place)
    rehearsing.images = partial(program.images, place)
    main()
