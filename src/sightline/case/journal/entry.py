"""One entry of a case: what happened, when, who did it, with which software, and the entries it was made from."""

import json
import re
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from enum import StrEnum
from functools import cache
from importlib.metadata import version
from platform import machine, python_version, system
from typing import Any

from sightline import __version__
from sightline.case.canonical import canonical, digest
from sightline.common.estimator import ESTIMATOR
from sightline.errors import CaseError
from sightline.imaging.formats import SUFFIXES as IMAGE_SUFFIXES

# Suffixes of the files that a case keeps: images, observations, frames.
SUFFIXES = (*IMAGE_SUFFIXES, ".csv", ".json")
_ENDING = f"(?:{'|'.join(map(re.escape, SUFFIXES))})"
ORIGINAL = re.compile(f"[0-9a-f]{{64}}{_ENDING}")
_END = re.compile(f'{_ENDING}"', re.IGNORECASE)
# A JSON string that ends like a file name. It is slow, so _END is tried first.
_FILE = re.compile(rf'"((?:[^"\\]|\\.)*{_ENDING})"', re.IGNORECASE)


class Kind(StrEnum):
    """The step of the procedure that an entry records."""

    ACQUIRED = "acquired"
    DETECTED = "detected"
    LABELLED = "labelled"
    CALIBRATED = "calibrated"
    PLANNED = "planned"
    CHANGED = "changed"
    SENT = "sent"
    SHOT = "shot"  # while drilling, at the skin or at the pause
    DRILLED = "drilled"
    VERIFIED = "verified"


class Actor(StrEnum):
    """The role or program that acted. The list is closed, so that no person's name gets into a case."""

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
    """One row of the journal. `number` counts from 1 and orders the entries, independently of the clock.

    `at`: UTC. `rests_on`: numbers of the entries that it was made from. `content_sha256`: hash of the canonical JSON of
    `content`. `chain`: hash of the previous entry's `chain` and of everything in this entry.
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


def next_link(previous: str, head: dict[str, Any]) -> str:
    """Return the chain's next hash: of the previous hash and of the entry's head, which holds its content's hash."""
    return digest(previous + canonical(head))


def originals_in(text: str) -> set[str]:
    """Return the names of originals that occur as whole strings in a JSON text.

    Raises CaseError on a string that ends like any other file name: such names often hold a patient's name.
    """
    names = set(_FILE.findall(text)) if _END.search(text) else set()
    if not all(ORIGINAL.fullmatch(name) for name in names):
        raise CaseError("a case never holds the name of a file; keep the file and record the name of its original")
    return names


@cache
def versions() -> dict[str, str]:
    """Return the versions of the software and the kind of machine, on which the last bit of a result depends."""
    from llvmlite.binding import get_host_cpu_name  # numba compiles the kernels for this processor

    names = ("numpy", "scipy", "numba", "opencv-python-headless", "pydicom", "python-gdcm")
    return {
        "sightline": __version__,
        "estimator": str(ESTIMATOR),
        "python": python_version(),
        **{name: version(name) for name in names},
        "machine": f"{system()} {machine()} {get_host_cpu_name()}",
    }


# Columns that the hash chain covers, in the order of the table; `content` and `chain` follow them.
HEAD = ("number", "kind", "at", "by", "versions", "settings", "rests_on", "content_sha256")


def first_link(case_number: str) -> str:
    """Return the first hash of the chain."""
    return digest(f"sightline case {case_number}")


def head_of_row(row: Sequence[Any]) -> dict[str, Any]:
    """Return the columns of HEAD by name, with their texts as the database stores them."""
    return dict(zip(HEAD, row[: len(HEAD)], strict=True))


def entry_of_row(row: Sequence[Any]) -> Entry:
    """Return a row as an entry. Raises CaseError if the row is damaged."""
    number, kind, at, by, versions, settings, rests_on, content_sha256, content, chain = row
    try:
        return Entry(
            number=number,
            kind=Kind(kind),
            at=datetime.fromisoformat(at),
            by=Actor(by),
            versions=json.loads(versions),
            settings=json.loads(settings),
            content=json.loads(content),
            rests_on=tuple(json.loads(rests_on)),
            content_sha256=content_sha256,
            chain=chain,
        )
    except (TypeError, ValueError):
        raise CaseError(f"entry {number} of the case is damaged; run `sightline case check` for details") from None
