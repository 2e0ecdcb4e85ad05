"""A live source watched: one thread takes frames from it, another works on the newest."""

import time
from collections.abc import Iterable, Sequence
from threading import Condition, Thread
from typing import Self

from sightline.calibration import BeadView
from sightline.case.watch.eye import Eye, Shown, Watched, aged
from sightline.closing import Closing
from sightline.errors import SightlineError, UnusableInputError
from sightline.frame import Frame
from sightline.planning.trajectory import Trajectory

_END_S = 5.0  # what the frame that is being worked on may take, and then some


class Watch(Closing):
    """Two threads while it is entered or started: one takes frames from the source, one works on the newest.

    `plan`: the trajectory to draw. `references`: views calibrated at planning, against which movements are told while
    the C-arm stands as it stood then; without one of the view that is seen, the first half second is the place of rest.
    Raises UnusableInputError where a reference is of another frame or not of the smooth method.
    """

    def __init__(
        self,
        frame: Frame,
        source: Iterable[Shown],
        plan: Trajectory | None = None,
        references: Sequence[BeadView] = (),
    ) -> None:
        if any(view.frame_key != frame.fingerprint for view in references):
            raise UnusableInputError(
                "a view of planning is of another frame; watch with the frame that was planned with"
            )
        self._source = source
        self._eye = Eye(frame, plan, references)
        self._worker = Thread(target=self._work, name="watch: work", daemon=True)
        self._changed = Condition()
        self._waiting: tuple[Shown, float] | None = None  # and when it came
        self._came = self._taken = 0
        self._newest: Watched | None = None
        self._over = self._closing = self._at_rest = self._ended = False
        self._error: Exception | None = None

    def __enter__(self) -> Self:
        self.start()
        return self

    def start(self) -> None:
        """Begin."""
        Thread(target=self._read, name="watch: source", daemon=True).start()  # a driver may hang: it is left behind
        self._worker.start()

    def close(self) -> None:
        """End, and let go of the source."""
        with self._changed:
            self._closing = True
            self._changed.notify_all()
        if self._worker.is_alive():
            self._worker.join(_END_S)
        close = getattr(self._source, "close", None)
        if close is not None:
            close()

    def rest(self) -> None:
        """A person has looked: where frame and C-arm are now is where they are at rest. The alarm goes off."""
        with self._changed:
            self._at_rest = True

    @property
    def ended(self) -> bool:
        """Whether no frame will be worked on any more."""
        with self._changed:
            return self._ended

    @property
    def error(self) -> Exception | None:
        """What ended it before the source did."""
        with self._changed:
            return self._error

    @property
    def fault(self) -> str | None:
        """The same for people."""
        error = self.error
        if error is None:
            return None
        return str(error) if isinstance(error, SightlineError) else f"a bug in Sightline ({type(error).__name__})"

    def latest(self) -> Watched | None:
        """The newest frame that was worked on, and how old it is by now; None before the first."""
        with self._changed:
            newest = self._newest
        return None if newest is None else aged(newest, time.monotonic())

    def next(self, after: int, timeout_s: float) -> Watched | None:
        """The first that is newer than frame number `after`; None where none came in time."""
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
                    self._waiting = shown, time.monotonic()  # what waited is dropped: the newest counts
                    self._came += 1
                    self._changed.notify_all()
        except Exception as error:  # a thread's error is told to whoever asks
            self._fail(error)
        finally:
            with self._changed:
                self._over = True
                self._changed.notify_all()

    def _work(self) -> None:
        try:
            while (job := self._next_job()) is not None:
                watched = self._eye.look(*job)
                with self._changed:
                    self._newest = watched
                    self._changed.notify_all()
        except Exception as error:
            self._fail(error)
        finally:
            with self._changed:
                self._ended = True
                self._changed.notify_all()

    def _next_job(self) -> tuple[Shown, float, int, int] | None:
        """The newest frame, when it came, its number, and how many were dropped; None at the end."""
        with self._changed:
            self._changed.wait_for(lambda: self._waiting is not None or self._closing or self._over)
            if self._closing or self._waiting is None:
                return None
            (shown, came_s), self._waiting = self._waiting, None
            self._taken += 1
            if self._at_rest:
                self._at_rest = False
                self._eye.rest()
            return shown, came_s, self._came, self._came - self._taken

    def _fail(self, error: Exception) -> None:
        with self._changed:
            self._error = self._error or error
            self._changed.notify_all()
