"""The original files of a case: named after the hash of their content, written once and never changed."""

from hashlib import file_digest
from pathlib import Path
from stat import S_IRGRP, S_IROTH, S_IRUSR

from sightline.case.canonical import digest
from sightline.case.journal.entry import ORIGINAL, SUFFIXES
from sightline.common.atomic import replace_file, sync_folder
from sightline.common.bounded import regular_file
from sightline.errors import CaseError
from sightline.imaging.formats import format_of_file

FOLDER = "originals"
_SHORT = 12  # leading digits of a hash: enough to tell the files of one case apart


def name_of(data: bytes, suffix: str) -> str:
    """Return `<sha256><suffix>`. Raises CaseError unless `suffix` is that of an image, a table of beads or a frame."""
    if suffix not in SUFFIXES:
        raise CaseError(f"a case cannot keep a file ending in {suffix!r}; it keeps {', '.join(SUFFIXES)}")
    return digest(data) + suffix


def short(name: str) -> str:
    """Return an original's name shortened for people: the first digits of its hash, and its suffix."""
    return name[:_SHORT] + Path(name).suffix


def anonymous_name(path: Path) -> str:
    """Return the short name that a case would give an image or a table of beads; the file's own may be a patient's."""
    known = format_of_file(path)
    with regular_file(path) as file:
        return short(file_digest(file, "sha256").hexdigest() + (known.suffixes[0] if known else ".csv"))


def keep(folder: Path, name: str, data: bytes) -> None:
    """Write an original atomically; it is on the disk when this returns. Raises OSError; then no file has its name."""
    if not is_whole(folder / name):
        replace_file(folder / name, data, mode=S_IRUSR | S_IRGRP | S_IROTH)
        sync_folder(folder)


def is_whole(path: Path) -> bool:
    """Whether the file exists and matches the hash in its name. Raises OSError if it cannot be read."""
    return path.is_file() and digest(path.read_bytes()) == path.name[:64]


def path_of(folder: Path, name: str) -> Path:
    """Return the file of an original. Raises CaseError if there is none of this name."""
    path = folder / name
    if not (ORIGINAL.fullmatch(name) and path.is_file()):
        raise CaseError("the case has no such original; run `sightline case check` to see what is missing")
    return path
