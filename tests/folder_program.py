"""Writes results into folders and is killed at every step of it: `folder_program.py DIR`, one JSON line a kill.

A step is an operation on a file or folder, as Python's audit events and the calls of the C library tell them.
"""

import json
import os
import signal
import sys
from pathlib import Path

from sightline.common.atomic import MANIFEST, write_folder

EVENTS = ("open", "os.rename", "os.mkdir", "os.remove", "os.rmdir", "os.link")
OLD, NEW, AGAIN = (
    {name: f"{word} {name}".encode() for name in ("plan.json", "report.html", f"{word}/pa.csv")}
    for word in ("old", "new", "again")
)


def read(folder: Path) -> dict[str, str]:
    files = (file for file in sorted(folder.rglob("*")) if file.is_file() and file.name != MANIFEST)
    return {str(file.relative_to(folder)): file.read_text() for file in files}


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
    step, going = 0, True
    while going:
        step += 1
        out = place / f"{step}" / "out"
        out.parent.mkdir(parents=True)
        if kind != "missing":
            write_folder(out, OLD)
        going = killed_at(step, out)
        held = [read(folder) for folder in (out, out.with_name("out.old")) if folder.exists()]
        write_folder(out, AGAIN)  # the next run works
        names = sorted(path.name for path in out.parent.iterdir() if path.name[0] != ".")
        print(json.dumps([held, read(out), names]), flush=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2])
