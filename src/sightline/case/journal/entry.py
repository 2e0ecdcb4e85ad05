"""One entry of a case: what happened, when, by whom, with which software, on what it rests."""

import os
import re
from dataclasses import dataclass
from datetime import datetime
from enum import StrEnum
from functools import cache
from importlib.metadata import version
from platform import machine, python_version, system
from typing import Any

from sightline import __version__
from sightline.case.canonical import canonical, digest
from sightline.errors import CaseError
from sightline.estimator import ESTIMATOR

# What can be kept, by its suffix: images, observations, frames.
SUFFIXES = (".dcm", ".png", ".tif", ".tiff", ".bmp", ".npy", ".csv", ".json")
_ENDING = f"(?:{'|'.join(map(re.escape, SUFFIXES))})"
ORIGINAL = re.compile(f"[0-9a-f]{{64}}{_ENDING}")
_END = re.compile(f'{_ENDING}"', re.IGNORECASE)
# A string of JSON that ends like a file. Slow, so only where there is such an end.
_FILE = re.compile(rf'"((?:[^"\\]|\\.)*{_ENDING})"', re.IGNORECASE)


class Kind(StrEnum):
    """What an entry tells of."""

    ACQUIRED = "acquired"
    DETECTED = "detected"
    LABELLED = "labelled"
    CALIBRATED = "calibrated"
    PLANNED = "planned"
    CHANGED = "changed"
    SENT = "sent"
    DRILLED = "drilled"
    VERIFIED = "verified"


class Actor(StrEnum):
    """Who or what did it: roles and programs. The list is closed, so that no person's name gets into a case."""

    SURGEON = "surgeon"
    RADIOGRAPHER = "radiographer"
    ASSISTANT = "assistant"
    ENGINEER = "engineer"
    APP = "app"
    COMMAND = "command"
    DEMO = "demo"
    ROBOT = "robot"
    RECEIVER = "receiver"  # of images over a network


@dataclass(frozen=True, eq=False)
class Entry:
    """One row of the journal; `number` counts from 1 and orders entries whatever the clock says.

    `at`: UTC. `rests_on`: numbers of the entries that it was made from. `content_sha256`: of the canonical JSON of
    `content`. `chain`: of the entry before and of all that is in this one.
    """

    number: int
    kind: Kind
    at: datetime
    by: Actor
    versions: dict[str, str]
    settings: dict[str, Any]
    content: dict[str, Any]
    rests_on: tuple[int, ...]
    content_sha256: str
    chain: str


def link(before: str, head: dict[str, Any]) -> str:
    """The chain's next hash: of the hash before and of an entry's head, which holds the hash of its content."""
    return digest(before + canonical(head))


def originals_in(text: str) -> set[str]:
    """Names of originals in a JSON text, where they are strings of their own.

    Raises CaseError on a string that ends like any other file's name: such names often hold a patient's.
    """
    found = set(_FILE.findall(text)) if _END.search(text) else set()
    if not all(ORIGINAL.fullmatch(name) for name in found):
        raise CaseError("a case never holds the name of a file; keep the file and write its original's name")
    return found


@cache
def versions() -> dict[str, str]:
    """The software that computes here, the kind of machine, and its threads: what results depend on to the bit."""
    from llvmlite.binding import get_host_cpu_name  # for which the kernels are compiled

    names = ("numpy", "scipy", "numba", "opencv-python-headless", "pydicom", "python-gdcm")
    return {
        "sightline": __version__,
        "estimator": str(ESTIMATOR),
        "python": python_version(),
        **{name: version(name) for name in names},
        "machine": f"{system()} {machine()} {get_host_cpu_name()}",
        "blas threads": os.environ.get("OPENBLAS_NUM_THREADS") or str(os.cpu_count()),  # sums are split among them
    }
