"""Images that appear as files in a folder, acquired once they are complete. No message names a file, because file names
may hold patients' names."""

import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from sightline.case.acquire.acquirer import Acquirer, News, Tell, news_of
from sightline.common.bounded import MAX_FILE_BYTES, regular_file
from sightline.errors import CaseError, ImageError, UnusableInputError
from sightline.imaging.dicom import claims_image
from sightline.imaging.formats import FORMAT_NAMES, SUFFIXES, ReadBy, format_of

SETTLED_S = 1.0  # [ours] a file is read once unchanged for this time: network folders write in bursts
GIVE_UP_S = 30 * SETTLED_S  # an incomplete file is refused once unchanged for this time
SCAN_S = 0.5  # between two scans


@dataclass
class _File:
    """A file: its size and modification time, since when they are unchanged (monotonic s), and whether it is done.

    `reported`: it was reported as waiting. `unusable`: it claims to be an image and was refused.
    """

    number: int
    stamp: tuple[int, int]
    since_s: float
    done: bool = False
    reported: bool = False
    unusable: bool = False


def check_folder(folder: Path) -> None:
    """Raise UnusableInputError if there is no such folder. Call it before a case is created for the folder."""
    if not folder.is_dir():
        raise UnusableInputError("there is no such folder; name the folder that images are written to")


class Folder:
    """A folder of images. Files are numbered as they are found; files of one scan in the order of their names.

    Raises UnusableInputError if there is no such folder.
    """

    def __init__(self, folder: Path, acquirer: Acquirer, tell: Tell) -> None:
        check_folder(folder)
        self._folder, self._acquirer, self._tell = folder, acquirer, tell
        self._files: dict[Path, _File] = {}

    def take_all(self) -> None:
        """Acquire every image that is there now, sub-folders included; other files are reported. Raises CaseError."""
        for path, file in self._pending(time.monotonic()):
            self._take(path, file, final=True)

    def scan(self, now_s: float) -> None:
        """Acquire the files that have settled by `now_s` (monotonic). After a disk error a file waits for the next
        scan."""
        for path, file in self._pending(now_s):
            quiet_s = now_s - file.since_s
            if quiet_s < SETTLED_S:
                continue
            try:
                self._take(path, file, final=quiet_s >= GIVE_UP_S)
            except CaseError as error:
                if not file.reported:
                    file.reported = True
                    self._tell(News("refused", f"file {file.number}: waits, since {error}"))

    @property
    def waiting(self) -> int:
        """The number of files that were neither acquired nor refused."""
        return sum(not file.done for file in self._files.values())

    @property
    def unusable(self) -> int:
        """The number of refused files that claim to be images, by content or name."""
        return sum(file.unusable for file in self._files.values())

    def _pending(self, now_s: float) -> Iterator[tuple[Path, _File]]:
        """Scan the folder; yield the files that are not done."""
        there = set()
        for path, stamp in _files(self._folder):
            there.add(path)
            file = self._files.get(path)
            if file is None:
                file = self._files[path] = _File(len(self._files) + 1, stamp, now_s)
            elif file.stamp != stamp:
                self._files[path] = file = _File(file.number, stamp, now_s)
            if not file.done:
                yield path, file
        for path in self._files.keys() - there:
            self._files[path].done, self._files[path].unusable = True, False

    def _take(self, path: Path, file: _File, *, final: bool) -> None:
        """Acquire a file. If `final`, report what is wrong with it; otherwise it may still be incomplete."""
        claims = path.suffix.lower() in SUFFIXES
        try:
            data = _read(path)
            if _stamp(path) != file.stamp:
                return  # it changed meanwhile; the next scan sees that
            known = format_of(data)
            if known is None:
                raise ImageError(f"it is not a {FORMAT_NAMES} file")
            claims = known.reader is not ReadBy.DICOM or claims_image(path)
            news = news_of(self._acquirer.take(data, known.suffixes[0], how={"source": "folder"}))
        except (ImageError, OSError) as error:
            if final:
                file.done = True
                file.unusable = claims
                why = error.strerror if isinstance(error, OSError) else error
                self._tell(News("refused", f"file {file.number} ({file.stamp[0]} bytes): {why}"))
            return
        file.done = True
        self._tell(news)


def _files(folder: Path) -> Iterator[tuple[Path, tuple[int, int]]]:
    """Yield the plain files under a folder with their stamps, sorted by name; no links and no hidden files."""
    for path in sorted(folder.rglob("*")):
        hidden = any(part.startswith(".") for part in path.relative_to(folder).parts)
        if hidden or path.is_symlink():
            continue
        try:
            if path.is_file():
                yield path, _stamp(path)
        except OSError:  # removed meanwhile
            continue


def _stamp(path: Path) -> tuple[int, int]:
    """Return the size in bytes and the modification time in ns."""
    stat = path.stat()
    return stat.st_size, stat.st_mtime_ns


def _read(path: Path) -> bytes:
    """Return a file's bytes. Raises ImageError if it is too large or empty, OSError."""
    size = path.stat().st_size
    if size > MAX_FILE_BYTES:
        raise ImageError(f"the limit is {MAX_FILE_BYTES} bytes: export single images")
    if size == 0:
        raise ImageError("it is empty; export the image again")
    with regular_file(path) as file:
        return file.read(size)  # not the limit: `read` allocates the whole size asked for
