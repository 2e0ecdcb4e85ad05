"""Programs killed while they write: acknowledged data stays, each folder is complete or old, and the next run works.

The moment is random: an operation on a file or folder, an instruction of SQLite's virtual machine, or a written byte.
"""

import os
import resource
import signal

import numpy as np

from campaigns.campaign import Campaign, Damage, Ended
from campaigns.programs import PROGRAMS, Steps, extent, in_a_child, not_finished, place_for


def doomed(kind: str, at: int) -> None:
    """Arrange that this process is killed at step `at` of a kind."""
    if kind == "byte":  # the kernel kills the process while it writes a longer file
        resource.setrlimit(resource.RLIMIT_FSIZE, (at, at))
        signal.signal(signal.SIGXFSZ, signal.SIG_DFL)
    else:
        Steps(kind, at, lambda: os.kill(os.getpid(), signal.SIGKILL)).watch()


def moment(
    name: str, rng: np.random.Generator, kinds: tuple[str, ...] = ("file", "journal", "byte")
) -> tuple[str, int]:
    """Return a random kind of step of a program, and its number."""
    all_of = {kind: last for kind, last in extent(name).items() if last and kind in kinds}
    kind = str(rng.choice(list(all_of)))
    if kind == "byte":
        return kind, int(np.exp(rng.uniform(0.0, np.log(all_of[kind]))))
    return kind, int(rng.integers(1, all_of[kind] + 1))


def killed(name: str) -> Damage:
    """Return the class of one program."""
    program = PROGRAMS[name]

    def make(rng: np.random.Generator) -> Ended:
        kind, at = moment(name, rng)

        def work() -> int:
            doomed(kind, at)
            return program.run(place)

        with place_for(program) as place:
            told = in_a_child(work)
            if told.code > 0:
                return Ended("crash", f"it fails at {kind} {at}: {told.err.strip()[-200:]}")
            wrong = program.damage(place, told.out) or not_finished(program, place)
        return Ended("lost", f"{wrong} ({kind} {at})") if wrong else Ended("right")

    return Damage(make)


CAMPAIGN = Campaign("kills", "Programs that are killed while they write", {name: killed(name) for name in PROGRAMS})
