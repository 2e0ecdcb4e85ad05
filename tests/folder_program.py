"""Writes results into folders and is killed at every step of it: `folder_program.py DIR`, one JSON line a kill.

A step is an operation on a file or folder, as Python's audit events and the calls of the C library tell them.
"""

import json
import os
import signal
import sys
from pathlib import Path

from sightline import atomic
from sightline.atomic import write_folder

EVENTS = ("open", "os.rename", "os.mkdir", "os.remove", "os.rmdir", "os.link", "ctypes.dlsym", "ctypes.call_function")
OLD, NEW = (
    {f"{name}": f"{word} {name}".encode() for name in ("plan.json", "report.html", "views/pa.csv")}
    for word in ("old", "new")
)


def read(folder: Path) -> dict[str, str]:
    return {str(file.relative_to(folder)): file.read_text() for file in sorted(folder.rglob("*")) if file.is_file()}


def killed_at(step: int, out: Path) -> bool:
    """Whether the new result was still being written at that step."""
    child = os.fork()
    if child == 0:
        left = [step]

        def audit(event: str, _: object) -> None:
            if event in EVENTS:
                left[0] -= 1
                if left[0] <= 0:
                    os.kill(os.getpid(), signal.SIGKILL)

        sys.addaudithook(audit)
        write_folder(out, NEW)
        os._exit(0)
    return os.WIFSIGNALED(os.waitpid(child, 0)[1])


def main(place: Path, kind: str) -> None:
    if kind == "shared without exchange":
        atomic._exchange = lambda *_: False
    step, going = 0, True
    while going:
        step += 1
        out = place / f"{step}" / "out"
        out.parent.mkdir(parents=True)
        if kind != "missing":
            write_folder(out, OLD)
        if kind.startswith("shared"):
            (out / "mine.txt").write_text("mine")
        going = killed_at(step, out)
        print(json.dumps(read(out)), flush=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2])
