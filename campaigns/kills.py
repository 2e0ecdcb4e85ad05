"""Programs killed while they write: acknowledged data stays, each folder is complete or old, and the next run works.

The moment is random: an operation on a file or folder, an instruction of SQLite's virtual machine, or a written byte.
"""

import os
import resource
import signal

import numpy as np

from campaigns.campaign import Campaign, Damage, Ended
from campaigns.programs import PROGRAMS, Steps, in_a_child, moment, not_finished, place_for


def killed(name: str) -> Damage:
    """Return the class of one program."""
    program = PROGRAMS[name]

    def make(rng: np.random.Generator) -> Ended:
        kind, at = moment(name, rng, ("file", "journal", "byte"))

        def work() -> int:
            if kind == "byte":  # the kernel kills the process while it writes a longer file
                resource.setrlimit(resource.RLIMIT_FSIZE, (at, at))
                signal.signal(signal.SIGXFSZ, signal.SIG_DFL)
            else:
                Steps(kind, at, lambda: os.kill(os.getpid(), signal.SIGKILL)).watch()
            return program.run(place)

        with place_for(program) as place:
            child = in_a_child(work)
            if child.code > 0:
                return Ended("crash", f"it fails at {kind} {at}: {child.err.strip()[-200:]}")
            wrong = program.damage(place, child.out) or not_finished(program, place)
        return Ended("lost", f"{wrong} ({kind} {at})") if wrong else Ended("right")

    return Damage(make)


CAMPAIGN = Campaign("kills", "Programs that are killed while they write", {name: killed(name) for name in PROGRAMS})
