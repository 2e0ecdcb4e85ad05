"""A live view: the newest frame of a source at any time, frozen or averaged when asked."""

from collections import deque
from threading import Condition, Thread
from types import TracebackType
from typing import Self

from sightline.errors import SightlineError, SourceError
from sightline.imaging.average import average
from sightline.imaging.radiograph import Radiograph
from sightline.imaging.source import Frame, Source

_LONGEST = 64  # frames that may be averaged: 64 of 1024² take 128 MiB


class LiveView:
    """Reads a source in a thread of its own while it is entered. What ended the source is raised to whoever waits."""

    def __init__(self, source: Source) -> None:
        self._source = source
        self._frames: deque[Frame] = deque(maxlen=1)
        self._error: SightlineError | None = None
        self._changed = Condition()
        self._leaving = False

    def __enter__(self) -> Self:
        Thread(target=self._run, name="live view", daemon=True).start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        with self._changed:
            self._leaving = True
            self._changed.notify_all()
        self._source.close()

    @property
    def newest(self) -> Frame | None:
        """The last frame that came; None before the first."""
        with self._changed:
            return self._frames[-1] if self._frames else None

    def freeze(self, timeout_s: float = 5.0) -> Frame:
        """The next frame that comes. Raises SourceError, or what ended the source."""
        return self._next(1, timeout_s)[0]

    def average(self, count: int, timeout_s: float = 10.0) -> Radiograph:
        """The mean of the next frames. Raises MovedRefusedError where something moved, and as `freeze` does."""
        return average([frame.image for frame in self._next(min(max(count, 1), _LONGEST), timeout_s)])

    def _next(self, count: int, timeout_s: float) -> list[Frame]:
        frames: list[Frame] = []
        with self._changed:
            last = self._frames[-1].number if self._frames else 0
            while len(frames) < count:
                came = self._changed.wait_for(lambda last=last: self._is_new(last), timeout_s)
                if came and self._frames and self._frames[-1].number > last:
                    frames.append(self._frames[-1])
                    last = frames[-1].number
                elif self._error is not None:
                    raise self._error
                else:
                    raise SourceError(f"the source gave no image within {timeout_s:g} s; look at its cable")
        return frames

    def _is_new(self, last: int) -> bool:
        return self._leaving or self._error is not None or bool(self._frames and self._frames[-1].number > last)

    def _run(self) -> None:
        try:
            for frame in self._source:
                with self._changed:
                    if self._leaving:
                        return
                    self._frames.append(frame)
                    self._changed.notify_all()
            error: SightlineError = SourceError("the source has ended; open it again")
        except SightlineError as raised:
            error = raised
        with self._changed:
            self._error = error
            self._changed.notify_all()
