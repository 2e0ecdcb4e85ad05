"""Images that appear as files in a folder: taken once they are whole. No file is named: names hold patients' names."""

import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from sightline.bounded import regular_file
from sightline.case.acquire.acquirer import Acquirer, News, Tell, news_of
from sightline.errors import CaseError, ImageError, UnusableInputError
from sightline.imaging import suffix_of
from sightline.imaging.limits import MAX_FILE_BYTES

SETTLED_S = 1.0  # [ours] without a change of size or time before a file is looked at: network folders write in bursts
GIVE_UP_S = 30.0  # [ours] without a change before a file that is no whole image is told of
SCAN_S = 0.5  # between two looks
_START = 132  # bytes that tell what a file is


@dataclass
class _Seen:
    """A file: its size and time of change, since when these are so (monotonic s), whether all was done with it."""

    number: int
    stamp: tuple[int, int]
    since_s: float
    done: bool = False
    told: bool = False


def check_folder(folder: Path) -> None:
    """Raises UnusableInputError where there is no such folder; to be asked before a case is created for it."""
    if not folder.is_dir():
        raise UnusableInputError("there is no such folder; name the folder that images are written to")


class Folder:
    """A folder of images. Files are numbered as they are found, those found together in the order of their names.

    Raises UnusableInputError where there is no such folder.
    """

    def __init__(self, folder: Path, acquirer: Acquirer, tell: Tell) -> None:
        check_folder(folder)
        self._folder, self._acquirer, self._tell = folder, acquirer, tell
        self._files: dict[Path, _Seen] = {}

    def take_all(self) -> None:
        """Every image that is there now, sub-folders too; what is no image is told of. Raises CaseError."""
        for path, seen in self._look(time.monotonic()):
            self._take(path, seen, final=True)

    def scan(self, now_s: float) -> None:
        """Take what has settled by `now_s` (monotonic). What a full disk refuses stays for the next scan."""
        for path, seen in self._look(now_s):
            quiet_s = now_s - seen.since_s
            if quiet_s < SETTLED_S:
                continue
            try:
                self._take(path, seen, final=quiet_s >= GIVE_UP_S)
            except CaseError as error:
                if not seen.told:
                    seen.told = True
                    self._tell(News("refused", f"file {seen.number}: waits, since {error}"))

    @property
    def waiting(self) -> int:
        """Files that are there and were neither taken nor told of."""
        return sum(not seen.done for seen in self._files.values())

    def _look(self, now_s: float) -> Iterator[tuple[Path, _Seen]]:
        """Files that are not done with, as they are now."""
        there = set()
        for path, stamp in _files(self._folder):
            there.add(path)
            seen = self._files.get(path)
            if seen is None:
                seen = self._files[path] = _Seen(len(self._files) + 1, stamp, now_s)
            elif seen.stamp != stamp:
                self._files[path] = seen = _Seen(seen.number, stamp, now_s)
            if not seen.done:
                yield path, seen
        for path, seen in self._files.items():
            seen.done |= path not in there

    def _take(self, path: Path, seen: _Seen, *, final: bool) -> None:
        """`final`: say what is wrong with it; otherwise it may still be being written."""
        try:
            data = _read(path)
            if _stamp(path) != seen.stamp:
                return  # it changed meanwhile: the next look sees that
            suffix = suffix_of(data[:_START])
            if suffix is None:
                raise ImageError("it is no DICOM, PNG, TIFF, BMP or NumPy file")
            news = news_of(self._acquirer.take(data, suffix, how={"source": "folder"}))
        except (ImageError, OSError) as error:
            if final:
                seen.done = True
                why = error.strerror if isinstance(error, OSError) else error
                self._tell(News("refused", f"file {seen.number} ({seen.stamp[0]} bytes): {why}"))
            return
        seen.done = True
        self._tell(news)


def _files(folder: Path) -> Iterator[tuple[Path, tuple[int, int]]]:
    """Plain files under a folder with their stamps, by name; no links, and none that begin with a dot."""
    for path in sorted(folder.rglob("*")):
        hidden = any(part.startswith(".") for part in path.relative_to(folder).parts)
        if hidden or path.is_symlink():
            continue
        try:
            if path.is_file():
                yield path, _stamp(path)
        except OSError:  # gone meanwhile
            continue


def _stamp(path: Path) -> tuple[int, int]:
    stat = path.stat()
    return stat.st_size, stat.st_mtime_ns


def _read(path: Path) -> bytes:
    """Raises ImageError on what is too large or empty, OSError."""
    size = path.stat().st_size
    if size > MAX_FILE_BYTES:
        raise ImageError(f"the limit is {MAX_FILE_BYTES} bytes: export single images")
    if size == 0:
        raise ImageError("it is empty; export the image again")
    with regular_file(path) as file:
        return file.read(size)  # room is made for all that is asked for
