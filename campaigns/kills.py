"""Programs killed while they write: acknowledged entries stay, folders are complete or old, and the next run works.

The programs are those of tests/case/test_journal_killed.py and tests/test_atomic.py, which kill them at a few steps and
have the disks that are full, read-only or faulty. Here the step is random: an operation on a file or folder, or an
instruction of SQLite's virtual machine.
"""

import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from tests.case.test_journal_killed import CREATE_STEPS, PROGRAM, RECORD_STEPS, Acknowledged, killed_at_step
from tests.folder_program import AGAIN, NEW, OLD, killed_at, read

from campaigns.campaign import Campaign, Damage, Ended
from sightline.common.atomic import write_folder

KILLS = 3  # of the same case
FOLDER_STEPS = 60  # about as many as writing a folder takes
OLD_TEXT, NEW_TEXT, AGAIN_TEXT = ({name: data.decode() for name, data in one.items()} for one in (OLD, NEW, AGAIN))
Kill = Callable[[Path, np.random.Generator], str]  # in an empty folder; returns what is lost


def new_case(place: Path, rng: np.random.Generator) -> str:
    """Kill while a case is created."""
    return _killed(place, rng, 1)


def case(place: Path, rng: np.random.Generator) -> str:
    """Kill while entries are recorded."""
    return _killed(place, rng, CREATE_STEPS)


def _killed(place: Path, rng: np.random.Generator, first: int) -> str:
    acknowledged = Acknowledged()
    for _ in range(KILLS):
        step = first + int(rng.integers(CREATE_STEPS + 10 * RECORD_STEPS))
        killed_at_step(place / "case", int(rng.integers(1 << 30)), step, acknowledged)
    return _whole(place, acknowledged)


def at_any_time(place: Path, rng: np.random.Generator) -> str:
    """Kill at an instant of the clock."""
    acknowledged = Acknowledged()
    for _ in range(KILLS):
        seed, lines = rng.integers(1 << 30), rng.integers(3, 12)
        _killed_after(place / "case", int(seed), int(lines), float(rng.uniform(0.0, 0.01)), acknowledged)
    return _whole(place, acknowledged)


def _killed_after(folder: Path, seed: int, lines: int, seconds: float, acknowledged: Acknowledged) -> None:
    """Kill some time after it has written so many lines, whatever it does then."""
    command = [sys.executable, str(PROGRAM), str(folder), str(seed), str(1 << 60)]  # steps
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as program:
        assert program.stdout is not None
        for _ in range(lines):
            acknowledged.hear(program.stdout.readline())
        time.sleep(seconds)
        program.kill()
        acknowledged.hear(program.communicate(timeout=60)[0])


def _whole(place: Path, acknowledged: Acknowledged) -> str:
    killed_at_step(place / "case", 1, 2 * CREATE_STEPS, acknowledged)  # the next run
    try:
        acknowledged.all_there(place / "case")
    except AssertionError as lost:
        return str(lost) or "acknowledged entries"
    return ""


def folder(place: Path, rng: np.random.Generator) -> str:
    """Kill while new results replace old ones."""
    out = place / "out"
    write_folder(out, OLD)
    killed_at(int(rng.integers(1, FOLDER_STEPS)), out)
    held = [read(each) for each in (out, place / "out.old") if each.exists()]
    write_folder(out, AGAIN)
    if held not in ([OLD_TEXT], [NEW_TEXT], [NEW_TEXT, OLD_TEXT]):
        return "the folder is neither old nor new"
    return "" if read(out) == AGAIN_TEXT else "the next run has written something else"


def killed(kill: Kill) -> Damage:
    """Return the class of one program."""

    def make(rng: np.random.Generator) -> Ended:
        with TemporaryDirectory(prefix="sightline-campaign-") as place:
            lost = kill(Path(place), rng)
        return Ended("lost", lost) if lost else Ended("right")

    return Damage(make)


KINDS = {"a new case": new_case, "a case": case, "a case, at any time": at_any_time, "a folder of results": folder}
CAMPAIGN = Campaign("kills", "Programs killed while they write", {name: killed(kill) for name, kill in KINDS.items()})
