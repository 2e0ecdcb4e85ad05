"""Programs killed while they write: acknowledged entries stay, and the next run works.

The moment is random: an operation on a file or folder, an instruction of SQLite's virtual machine, or a written byte.
"""

import os
import resource
import signal
from functools import partial
from pathlib import Path

import numpy as np

from campaigns.campaign import Campaign, Damage, Ended
from campaigns.programs import PROGRAMS, Steps, interrupted


def killed(name: str, rng: np.random.Generator) -> Ended:
    """Kill one program."""

    def prepare(kind: str, at: int, _: Path) -> None:
        if kind == "byte":  # the kernel kills the process while it writes a longer file
            resource.setrlimit(resource.RLIMIT_FSIZE, (at, at))
            signal.signal(signal.SIGXFSZ, signal.SIG_DFL)
        else:
            Steps(kind, at, lambda: os.kill(os.getpid(), signal.SIGKILL)).watch()

    child, wrong, when = interrupted(name, rng, ("file", "journal", "byte"), prepare)
    if child.code > 0:
        return Ended("crash", f"it fails at {when}: {child.err.strip()[-200:]}")
    return Ended("lost", f"{wrong} ({when})") if wrong else Ended("right")


CLASSES = {name: Damage(partial(killed, name)) for name in PROGRAMS}
CAMPAIGN = Campaign("kills", "Programs that are killed while they write", CLASSES)
