"""The interface of sources of images: a camera, a video, a run of frames, a network link."""

import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from sightline.imaging.files import frames_in, read_image
from sightline.imaging.radiograph import Radiograph


@dataclass(frozen=True, eq=False)
class SourceFrame:
    """One image of a source. `number` counts arrivals from 1, independently of clocks.

    `stamped_s`: time of arrival; `sender_s`: the sender's time stamp; both in seconds since 1970. `pixel_aspect`: width
    over height of a pixel, as the source states it; nothing is resampled.
    """

    image: Radiograph
    number: int
    stamped_s: float
    source: str
    sender_s: float | None = None
    pixel_aspect: float | None = None


class Source(Protocol):
    """A source: `for frame in source:` until it ends. Raises SourceError where it stops giving images; never hangs."""

    def __iter__(self) -> Iterator[SourceFrame]:
        """Yield frames as they arrive."""
        ...

    def close(self) -> None:
        """Release the device or the link."""
        ...


class Run:
    """The frames of an image file: one, or those of a multi-frame DICOM run. Raises ImageError."""

    def __init__(self, file: Path) -> None:
        self._file, self._frames = file, frames_in(file)

    def __iter__(self) -> Iterator[SourceFrame]:
        for index in range(self._frames):
            image = read_image(self._file, index if self._frames > 1 else None)
            yield SourceFrame(image, index + 1, time.time(), "run")

    def close(self) -> None:
        """Do nothing: no file is kept open."""
