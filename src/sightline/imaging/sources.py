"""Sources of images: video, runs of frames, folders, opened by name.

OpenCV reads video (frame grabber, capture card, file, stream) in a thread that may hang.
"""

import atexit
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from queue import Empty, Full, Queue
from threading import Event, Thread
from typing import Any, Protocol

import cv2
import numpy as np

from sightline.errors import ImageError, SourceError, UnusableInputError
from sightline.imaging.files import frames_in, in_order, read_image
from sightline.imaging.formats import is_image
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
    """The frames of image files: one of each, or those of a multi-frame DICOM run. Raises ImageError."""

    def __init__(self, *files: Path) -> None:
        self._files = [(file, frames_in(file)) for file in files]

    def __iter__(self) -> Iterator[SourceFrame]:
        frames = ((file, index if count > 1 else None) for file, count in self._files for index in range(count))
        for number, (file, index) in enumerate(frames, 1):
            yield SourceFrame(read_image(file, index), number, time.time(), "run")

    def close(self) -> None:
        """Do nothing: no file is kept open."""


DEADLINE_S = 2.0  # [ours] fifty frame times without an image: the device hangs or is gone
RETRY_S = 10 * DEADLINE_S  # time to reconnect a cable
_AGAIN_S = 0.5  # between attempts
_WAITING = 2  # frames in the queue: a live source drops the oldest, a file waits
# A grey image after a colour encoder: its channels differ by at most _COLOUR of 255, but for this share of the pixels,
# coloured writing. More is a colour camera, whose brightness is no measure of X-rays [ours].
_COLOUR, _COLOURED = 24, 0.02

Opener = Callable[..., Any]  # of a place; returns an object with isOpened, read, get and release


class VideoSource:
    """Frames of `place`: a device's number, a file, or a stream's address. A live source gives its newest frame.

    A device that gives no image within `deadline_s` is opened again, for up to `retry_s`; `tell` receives a message.
    A thread reads the images; it is abandoned if the driver hangs. `crop`: left, top, width, height, px. Raises
    SourceError where the source cannot be opened or reopened, ImageError on a picture in colour.
    """

    def __init__(
        self,
        place: int | str,
        *,
        crop: tuple[int, int, int, int] | None = None,
        deadline_s: float = DEADLINE_S,
        retry_s: float = RETRY_S,
        tell: Callable[[str], None] = lambda _: None,
        opener: Opener = cv2.VideoCapture,
    ) -> None:
        self._place, self._crop, self._opener, self._tell = place, crop, opener, tell
        self._deadline_s, self._retry_s = deadline_s, retry_s
        self._live = isinstance(place, int) or not Path(place).is_file()
        self._number = 0
        self._reader = self._opened()

    def __iter__(self) -> Iterator[SourceFrame]:
        while True:
            got = self._reader.next(self._deadline_s)
            if got is None and self._reader.ended and not self._live:
                return
            if got is None:
                self._come_back("gave no image" if not self._reader.ended else "was unplugged or ended")
                continue
            pixels, stamped_s = got
            self._number += 1
            image = Radiograph(self._cropped(luma(pixels)), 255.0 if pixels.dtype == np.uint8 else 65535.0)
            yield SourceFrame(image, self._number, stamped_s, "video", pixel_aspect=self._reader.pixel_aspect)

    def close(self) -> None:
        """Release the source; wait for a picture that is being read."""
        self._reader.stop(DEADLINE_S)

    def _opened(self) -> "_Reader":
        reader = _Reader(self._opener, self._place, self._live)
        if not reader.opened(self._deadline_s):
            reader.stop()
            raise SourceError("the video source cannot be opened; check its cable, its number and who else uses it")
        return reader

    def _come_back(self, why: str) -> None:
        """Reopen the source. Raises SourceError after `retry_s`."""
        self._tell(f"the video source {why}; opening it again")
        self._reader.stop()
        end = time.monotonic() + self._retry_s
        while True:
            time.sleep(min(_AGAIN_S, self._retry_s))
            try:
                self._reader = self._opened()
            except SourceError:
                if time.monotonic() >= end:
                    raise SourceError(
                        f"the video source {why} and did not come back within {self._retry_s:g} s; check its cable"
                    ) from None
            else:
                self._tell("the video source is back")
                return

    def _cropped(self, pixels: np.ndarray) -> np.ndarray:
        if self._crop is None:
            return pixels
        left, top, width, height = self._crop
        if left < 0 or top < 0 or left + width > pixels.shape[1] or top + height > pixels.shape[0]:
            raise ImageError(f"the crop reaches beyond the {pixels.shape[1]} x {pixels.shape[0]} pixels of the video")
        return np.ascontiguousarray(pixels[top : top + height, left : left + width])


def luma(pixels: np.ndarray) -> np.ndarray:
    """Return the grey picture (H, W) of (H, W), (H, W, 1) or (H, W, 3); channels may differ by an encoder's error.

    Raises ImageError on a picture in colour.
    """
    if pixels.ndim == 2 or pixels.shape[2] == 1:
        return pixels.reshape(pixels.shape[:2])
    sample = pixels[::8, ::8].astype(np.int32)
    if (np.ptp(sample, axis=2) > _COLOUR * (np.iinfo(pixels.dtype).max // 255)).mean() > _COLOURED:
        raise ImageError("the video is in colour; choose the input that the C-arm's monitor has")
    return cv2.cvtColor(pixels, cv2.COLOR_BGR2GRAY)


class _Reader:
    """A thread that opens and reads a capture.

    Python aborts if it exits while a thread is within OpenCV; so it waits for the thread, if the driver does not hang.
    """

    def __init__(self, opener: Opener, place: int | str, live: bool) -> None:
        self.pixel_aspect: float | None = None
        self._live = live
        self._frames: Queue[tuple[np.ndarray, float]] = Queue(_WAITING)
        self._is_open, self._over, self._stop = Event(), Event(), Event()
        self._thread = Thread(target=self._run, args=(opener, place), name="video", daemon=True)
        atexit.register(self.stop, DEADLINE_S)
        self._thread.start()

    @property
    def ended(self) -> bool:
        """Whether no more pictures will come."""
        return self._over.is_set() and self._frames.empty()

    def opened(self, timeout_s: float) -> bool:
        """Wait until the capture is open, for at most `timeout_s`; return whether it is."""
        end = time.monotonic() + timeout_s
        while not self._is_open.wait(0.01) and not self._over.is_set() and time.monotonic() < end:
            pass
        return self._is_open.is_set()

    def next(self, timeout_s: float) -> tuple[np.ndarray, float] | None:
        """Return the next picture and its time of arrival; None where none came in time, or none will."""
        end = time.monotonic() + timeout_s
        while not self.ended:
            try:
                return self._frames.get(timeout=max(0.0, min(0.05, end - time.monotonic())))
            except Empty:
                if time.monotonic() >= end:
                    return None
        return None

    def stop(self, wait_s: float = 0.0) -> None:
        """Ask the thread to end, which it does after its next picture; wait for it for at most `wait_s`."""
        self._stop.set()
        self._thread.join(wait_s)

    def _run(self, opener: Opener, place: int | str) -> None:
        capture = None
        try:
            capture = opener(place)
            if not capture.isOpened():
                return
            self.pixel_aspect = _aspect(capture)
            self._is_open.set()
            while not self._stop.is_set():
                good, pixels = capture.read()
                if not good or pixels is None:
                    return
                self._put((pixels, time.time()))
        except cv2.error:  # the driver's message does not help the user
            return
        finally:
            self._over.set()
            if capture is not None:
                capture.release()
            atexit.unregister(self.stop)

    def _put(self, picture: tuple[np.ndarray, float]) -> None:
        """Queue a picture: a live source drops the oldest one, a file waits."""
        while not self._stop.is_set():
            with suppress(Full):
                self._frames.put(picture, timeout=0.0 if self._live else 0.05)
                return
            if self._live:
                with suppress(Empty):
                    self._frames.get_nowait()


def _aspect(capture: Any) -> float | None:
    wide, high = capture.get(cv2.CAP_PROP_SAR_NUM), capture.get(cv2.CAP_PROP_SAR_DEN)
    return wide / high if wide > 0 and high > 0 else None


IMAGES_PER_S = 30.0  # playback rate of files: that of a C-arm's video


def open_source(name: str, *, invert: bool = False) -> Source:
    """Open the source called `name`: a device number, a stream's address, a video, an image file or a folder of images.

    Files are played at IMAGES_PER_S. Of a folder the images are played `in_order`; hidden and other files are skipped.
    `invert`: each image is inverted, as by `read_image`.
    Raises UnusableInputError, ImageError, SourceError.
    """
    source = _source(name)
    return _Played(source, _inverted(source)) if invert else source


def _source(name: str) -> Source:
    if name.isdecimal() or "://" in name:
        return VideoSource(int(name) if name.isdecimal() else name)
    path = Path(name)
    if not path.is_dir() and not path.is_file():
        raise UnusableInputError(
            f"no file or folder {name} exists; name one, a device by its number, or a stream by its address"
        )
    files = in_order(path) if path.is_dir() else [path]
    images = [file for file in files if is_image(file)]
    if path.is_dir() and not images:
        raise UnusableInputError("the folder holds no image; name the folder of the frames")
    stored = Run(*images) if images else VideoSource(name)
    return _Played(stored, _paced(stored))


@dataclass(frozen=True)
class _Played:
    """The frames of a source as a generator makes them."""

    source: Source
    frames: Iterator[SourceFrame]

    def __iter__(self) -> Iterator[SourceFrame]:
        return self.frames

    def close(self) -> None:
        self.source.close()


def _paced(source: Source) -> Iterator[SourceFrame]:
    """Yield frames at IMAGES_PER_S, each stamped with the time at which it is played."""
    start = time.monotonic()
    for k, frame in enumerate(source):
        time.sleep(max(0.0, start + k / IMAGES_PER_S - time.monotonic()))
        yield replace(frame, stamped_s=time.time())


def _inverted(source: Source) -> Iterator[SourceFrame]:
    for frame in source:
        yield replace(frame, image=frame.image.inverted())
