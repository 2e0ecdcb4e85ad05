"""Watch a live source: one thread receives images, another analyses the newest."""

import time
from collections.abc import Iterable, Sequence
from threading import Condition, Thread
from typing import Self

from sightline.calibration import BeadView
from sightline.case.watch.analyser import LiveAnalyser, TimedImage, Watched, aged
from sightline.common.closing import Closing
from sightline.errors import SightlineError, UnusableInputError
from sightline.frame import Frame
from sightline.planning.points.trajectory import Trajectory

_END_S = 5.0  # time for the image in work, with a margin


class Watch(Closing):
    """Runs two threads while it is entered or started: one receives images from the source, one analyses the newest.

    `plan`: the trajectory to draw. `references`: views calibrated at planning, against which movement is measured while
    the C-arm stands as it did then; without a reference for a view, its first half second defines the rest position.
    Raises UnusableInputError if a reference belongs to another frame or is not of the smooth method.
    """

    def __init__(
        self,
        frame: Frame,
        source: Iterable[TimedImage],
        plan: Trajectory | None = None,
        references: Sequence[BeadView] = (),
    ) -> None:
        if any(view.frame_key != frame.fingerprint for view in references):
            raise UnusableInputError("a reference view belongs to another frame; watch with the frame of the plan")
        self._source = source
        self._analyser = LiveAnalyser(frame, plan, references)
        self._worker = Thread(target=self._work, name="watch: work", daemon=True)
        self._changed = Condition()
        self._waiting: tuple[TimedImage, float] | None = None  # and its monotonic time of arrival
        self._came = self._taken = 0
        self._newest: Watched | None = None
        self._over = self._closing = self._at_rest = self._ended = False
        self._error: Exception | None = None

    def __enter__(self) -> Self:
        self.start()
        return self

    def start(self) -> None:
        """Start both threads."""
        Thread(target=self._read, name="watch: source", daemon=True).start()  # never joined: a driver may hang
        self._worker.start()

    def close(self) -> None:
        """Stop, and close the source."""
        with self._changed:
            self._closing = True
            self._changed.notify_all()
        if self._worker.is_alive():
            self._worker.join(_END_S)
        close = getattr(self._source, "close", None)
        if close is not None:
            close()

    def rest(self) -> None:
        """Take the present position of frame and C-arm as rest, once a person has checked it. This clears the alarm."""
        with self._changed:
            self._at_rest = True

    @property
    def ended(self) -> bool:
        """Whether no further image will be analysed."""
        with self._changed:
            return self._ended

    @property
    def error(self) -> Exception | None:
        """The error that stopped it before the source ended; None if there is none."""
        with self._changed:
            return self._error

    @property
    def fault(self) -> str | None:
        """The error as text for people; None if there is none."""
        error = self.error
        if error is None:
            return None
        return str(error) if isinstance(error, SightlineError) else f"a bug in Sightline ({type(error).__name__})"

    def latest(self) -> Watched | None:
        """Return the newest result with its present age; None before the first."""
        return self.next(0, 0.0)

    def next(self, after: int, timeout_s: float) -> Watched | None:
        """Wait for a result of an image newer than number `after`; return None if none came in time."""
        with self._changed:
            self._changed.wait_for(lambda: self._is_newer(after) or self._ended, timeout_s)
            newest = self._newest if self._is_newer(after) else None
        return None if newest is None else aged(newest, time.monotonic())

    def _is_newer(self, after: int) -> bool:
        return self._newest is not None and self._newest.number > after

    def _read(self) -> None:
        try:
            for shown in self._source:
                with self._changed:
                    if self._closing:
                        return
                    self._waiting = shown, time.monotonic()  # replaces an image that still waits
                    self._came += 1
                    self._changed.notify_all()
        except Exception as error:  # kept for `error`, since a thread has no caller
            self._fail(error)
        finally:
            with self._changed:
                self._over = True
                self._changed.notify_all()

    def _work(self) -> None:
        try:
            while (job := self._next_job()) is not None:
                watched = self._analyser.look(*job)
                with self._changed:
                    self._newest = watched
                    self._changed.notify_all()
        except Exception as error:
            self._fail(error)
        finally:
            with self._changed:
                self._ended = True
                self._changed.notify_all()

    def _next_job(self) -> tuple[TimedImage, float, int, int] | None:
        """Wait for the newest image; return it, its arrival time, its number and the count of dropped ones; None at the
        end."""
        with self._changed:
            self._changed.wait_for(lambda: self._waiting is not None or self._closing or self._over)
            if self._closing or self._waiting is None:
                return None
            (shown, came_s), self._waiting = self._waiting, None
            self._taken += 1
            if self._at_rest:
                self._at_rest = False
                self._analyser.rest()
            return shown, came_s, self._came, self._came - self._taken

    def _fail(self, error: Exception) -> None:
        with self._changed:
            self._error = self._error or error
            self._changed.notify_all()
