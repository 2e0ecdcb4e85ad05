"""Image sources opened by name: a device number, a stream's address, a video, a multi-frame run, a folder of images."""

import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

from sightline.errors import UnusableInputError
from sightline.imaging.formats import is_image
from sightline.imaging.source import Run, Source, SourceFrame
from sightline.imaging.video import VideoSource

IMAGES_PER_S = 30.0  # playback rate of files: that of a C-arm's video


def open_source(name: str, *, invert: bool = False) -> Source:
    """Open the source called `name`; files are played at IMAGES_PER_S.

    `invert`: each image is inverted, as by `read_image`. Raises UnusableInputError, ImageError, SourceError.
    """
    source = _source(name)
    return Inverted(source) if invert else source


def _source(name: str) -> Source:
    if name.isdecimal() or "://" in name:
        return VideoSource(int(name) if name.isdecimal() else name)
    path = Path(name)
    if path.is_dir():
        return Paced(_Folder(path))
    if not path.is_file():
        raise UnusableInputError(
            f"there is no file or folder {name}; name one, a device by its number, or a stream by its address"
        )
    return Paced(Run(path) if is_image(path) else VideoSource(name))


class Paced:
    """Stored images played at IMAGES_PER_S, each stamped with the time at which it is played."""

    def __init__(self, source: Source) -> None:
        self._source = source

    def __iter__(self) -> Iterator[SourceFrame]:
        start = time.monotonic()
        for k, frame in enumerate(self._source):
            time.sleep(max(0.0, start + k / IMAGES_PER_S - time.monotonic()))
            yield replace(frame, stamped_s=time.time())

    def close(self) -> None:
        """Close the source."""
        self._source.close()


class Inverted:
    """A source whose images are inverted."""

    def __init__(self, source: Source) -> None:
        self._source = source

    def __iter__(self) -> Iterator[SourceFrame]:
        for frame in self._source:
            yield replace(frame, image=frame.image.inverted())

    def close(self) -> None:
        """Close the source."""
        self._source.close()


class _Folder:
    """The images of a folder in the order of their names; hidden files and other files are skipped.

    Raises UnusableInputError for a folder without an image.
    """

    def __init__(self, folder: Path) -> None:
        self._files = [path for path in sorted(folder.iterdir()) if path.name[0] != "." and is_image(path)]
        if not self._files:
            raise UnusableInputError("the folder holds no image; name the folder of the frames")

    def __iter__(self) -> Iterator[SourceFrame]:
        frames = (frame for path in self._files for frame in Run(path))
        for number, frame in enumerate(frames, 1):
            yield replace(frame, number=number)

    def close(self) -> None:
        """Do nothing: no file is kept open."""
