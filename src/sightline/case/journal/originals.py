"""Files of a case as they came, named after what is in them, written once and never touched again."""

import os
from contextlib import suppress
from hashlib import file_digest
from pathlib import Path
from stat import S_IRGRP, S_IROTH, S_IRUSR
from threading import get_ident

from sightline.atomic import sync_folder
from sightline.bounded import regular_file
from sightline.case.canonical import digest
from sightline.case.journal.entry import ORIGINAL, SUFFIXES
from sightline.errors import CaseError
from sightline.imaging import suffix_of

FOLDER = "originals"
_SHOWN = 12  # letters of a hash that tell one file of a case from another
_START = 132  # bytes that tell what a file is


def name_of(data: bytes, suffix: str) -> str:
    """`<sha256><suffix>`. Raises CaseError on a suffix that no image, table of beads or frame has."""
    if suffix not in SUFFIXES:
        raise CaseError(
            f"a file ending in {suffix!r} cannot be kept in a case; its originals are {', '.join(SUFFIXES)}"
        )
    return digest(data) + suffix


def short(name: str) -> str:
    """An original's name as people are told it."""
    return name[:_SHOWN] + Path(name).suffix


def called(path: Path) -> str:
    """A file of beads or of an image as a case would call it, shortly: its own name may be a patient's."""
    with regular_file(path) as file:
        suffix = suffix_of(file.read(_START)) or ".csv"
        file.seek(0)
        return file_digest(file, "sha256").hexdigest()[:_SHOWN] + suffix


def keep(folder: Path, name: str, data: bytes) -> None:
    """Write an original, whole and on the disk when this returns. Raises OSError; then nothing has its name."""
    target = folder / name
    if is_whole(target):
        return
    scratch = folder / f".{name}.{os.getpid()}.{get_ident()}.part"
    try:
        with scratch.open("wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        scratch.chmod(S_IRUSR | S_IRGRP | S_IROTH)
        scratch.replace(target)
        sync_folder(folder)
    finally:
        with suppress(OSError):
            scratch.unlink(missing_ok=True)


def is_whole(path: Path) -> bool:
    """Whether the file is there and holds what its name says. Raises OSError where it cannot be read."""
    return path.is_file() and digest(path.read_bytes()) == path.name[:64]


def path_of(folder: Path, name: str) -> Path:
    """The file of an original. Raises CaseError where there is none of this name."""
    path = folder / name
    if not (ORIGINAL.fullmatch(name) and path.is_file()):
        raise CaseError("the case has no such original; `sightline case check` says what is missing")
    return path
