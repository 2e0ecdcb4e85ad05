"""Live image during drilling: analysed as by `sightline watch`, ten times a second, with the plan drawn over it."""

import asyncio
from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING

from sightline.app.session.planning import Planning
from sightline.app.session.rehearsing import Patient
from sightline.errors import UnusableInputError
from sightline.frame import Frame

if TYPE_CHECKING:
    from sightline.case.watch.analyser import TimedImage, Watched
    from sightline.case.watch.live import Watch

# Freshness is reported every 0.1 s; allow one period and 0.1 s of latency. If the reports stop, an image can show as
# current until it is STALE_S + LATE_S = 0.4 s old [ours].
LATE_S = 0.2
EVERY = 3  # of 30 images a second every third is processed, to leave processor time for the page [ours]


class Live:
    """The live image. `watch`: None while none is shown."""

    def __init__(self, planning: Planning) -> None:
        self._planning = planning
        self.watch: Watch | None = None
        self._starting = False

    async def start(self, source: str | None) -> None:
        """Watch a source by its name, or the rehearsed patient's C-arm if None. Raises SightlineError.

        The overlay shows the plan that was sent, or the current plan if none was sent. Movement is measured against the
        views of that plan.
        """
        from sightline.case.watch.live import Watch

        self._planning.frame.refuse_solid("a live image is watched by the plates of a frame")
        if self._starting:
            raise UnusableInputError("wait: the live image is already being started")
        self._starting = True
        try:
            await self.close()
            planning = self._planning
            images = await asyncio.to_thread(_opened, source, planning.patient)
            known = planning.planned if planning.sent is None else planning.sent.planned
            views = (planning.views() or ()) if known is None else known.views
            plan = None if known is None or known.plan is None else known.plan.trajectory
            self.watch = Watch(planning.frame, _Thinned(images), plan, views)
            self.watch.start()
        finally:
            self._starting = False
        self._planning.jobs.notify()

    async def close(self) -> None:
        """End the live image. A hanging source is awaited on another thread, so that the page and STOP keep working."""
        watch, self.watch = self.watch, None
        if watch is not None:
            self._planning.jobs.notify()
            await asyncio.to_thread(watch.close)

    def latest(self) -> "Watched | None":
        """Return the newest processed image."""
        return None if self.watch is None else self.watch.latest()


def fresh_s(watched: "Watched") -> float:
    """Return for how long, s, a page may show an image as current without another report; 0 for a stale one.

    Without further reports this ends when the image is STALE_S + LATE_S old.
    """
    from sightline.case.watch.analyser import STALE_S

    return 0.0 if watched.stale else STALE_S - watched.age_s + LATE_S


class _Thinned:
    """Every EVERY-th image of a source."""

    def __init__(self, source: "Iterable[TimedImage]") -> None:
        self._source = source

    def __iter__(self) -> "Iterator[TimedImage]":
        for k, shown in enumerate(self._source):
            if k % EVERY == 0:
                yield shown

    def close(self) -> None:
        """Close the source."""
        close = getattr(self._source, "close", None)
        if close is not None:
            close()


def _opened(source: str | None, patient: Patient | None) -> "Iterable[TimedImage]":
    from sightline.imaging.sources import open_source
    from sightline.rehearsal.stream import SimulatedFluoroscopy

    if source is not None:
        return open_source(source)
    if patient is None:
        raise UnusableInputError("no live image is connected; start the app with --live SOURCE")
    return SimulatedFluoroscopy(patient.seed, Frame.load(patient.frame))
