"""A program that fills a case and says what is acknowledged, until it kills itself: journal_program.py DIR SEED STEPS.

The steps are the file operations of an original, as Python sees them, and the instructions of SQLite's machine, among
them those of a commit.
"""

import os
import signal
import sqlite3
import sys
from pathlib import Path
from random import Random

from sightline.case.journal import Actor, Case, Kind
from sightline.case.journal import case as journal
from sightline.case.journal.entry import versions

EVENTS = ("open", "os.rename", "os.chmod", "os.remove", "os.mkdir")  # audit events of the operations that matter


class Fuse:
    """Burns down by one at each step; at the end the process is killed, as by the kernel."""

    def __init__(self, steps: int) -> None:
        self.left = steps

    def step(self, *_: object) -> int:
        self.left -= 1
        if self.left <= 0:
            os.kill(os.getpid(), signal.SIGKILL)
        return 0

    def audit(self, event: str, _: object) -> None:
        if event in EVENTS:
            self.step()


def say(*words: object) -> None:
    os.write(1, (" ".join(map(str, words)) + "\n").encode())


def main(folder: Path, seed: int, steps: int) -> None:
    versions()  # slow once, and no part of what is killed
    fuse, rng = Fuse(steps), Random(seed)  # noqa: S311 - no secret
    connect = journal.connect

    def watched(file: Path, mode: str) -> sqlite3.Connection:
        db = connect(file, mode)
        db.set_progress_handler(fuse.step, 1)
        return db

    journal.connect = watched
    sys.addaudithook(fuse.audit)
    case = Case.create(folder, exist_ok=True)  # as `acquire` and the app do
    say("ready", case.number)
    while True:
        data = rng.randbytes(rng.randrange(1, 20_000))
        name = case.keep(data, ".dcm")
        say("kept", name)
        made = case.record(Kind.ACQUIRED, {"original": name, "text": data[:2000].hex()}, by=Actor.DEMO)
        say("recorded", made.number, made.chain)


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3]))
