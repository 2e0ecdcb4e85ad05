"""The program with a clock that tests can set on: python -m tests.app.clock_app FILE ARGUMENTS...

FILE holds by how many seconds the clock is ahead that the age of plans is read from. A live image is stale after
PATIENT_STALE_S: how fast a busy machine analyses one is a benchmark's matter.
"""

import sys
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

from sightline.app.session import readiness
from sightline.case.watch import analyser
from sightline.cli import main

PATIENT_STALE_S = 5.0


def set_ahead(file: Path, seconds: float) -> None:
    """Set the clock: the program that reads it never finds the file empty."""
    new = file.with_suffix(".new")
    new.write_text(str(seconds))
    new.replace(file)


class _Clock(datetime):
    """`now` is ahead by what the file says."""

    file = Path()

    @classmethod
    def now(cls, tz: Any = None) -> datetime:
        return datetime.now(tz) + timedelta(seconds=float(cls.file.read_text()))


if __name__ == "__main__":
    _Clock.file = Path(sys.argv.pop(1))
    readiness.datetime = _Clock
    analyser.STALE_S = PATIENT_STALE_S
    main()
