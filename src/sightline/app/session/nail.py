"""The nail of a plan looked for in the images, on another thread, whenever its strokes, clicks or images change."""

import asyncio
from collections.abc import Callable
from typing import TypeAlias

from sightline.app.plan.holes import NAIL, HolesFound
from sightline.app.session.failures import report
from sightline.app.session.jobs import Jobs
from sightline.calibration import BeadView
from sightline.from_images.interlocking import NailDrawn
from sightline.imaging import Radiograph

DrawnOn: TypeAlias = tuple[NailDrawn, tuple[BeadView, ...], tuple[Radiograph, ...]]


class NailInImages:
    """What the images show of the nail as drawn. `searching`: it is being looked for."""

    def __init__(self, drawn_on: Callable[[], DrawnOn | None], jobs: Jobs) -> None:
        """`drawn_on`: returns the nail as it is drawn now, and the calibrated images; None without one."""
        self._drawn_on, self._jobs = drawn_on, jobs
        self._found: HolesFound | None = None
        self.searching = False

    @property
    def found(self) -> HolesFound | None:
        """What was found of the nail as it is drawn now; None while it is searched for, and without one."""
        found, now = self._found, self._drawn_on()
        return found if found is not None and now is not None and found.is_of(*now[:2]) else None

    def update(self) -> None:
        """Start the search where the nail as drawn was not looked for. Must run on the event loop."""
        if not self.searching and self.found is None and (now := self._drawn_on()) is not None:
            self.searching = True
            self._jobs.start(self._search(now))

    async def _search(self, now: DrawnOn) -> None:
        try:
            self._found = await asyncio.to_thread(HolesFound.find, *now, self._found)
        except Exception as error:  # a defect; searching again would not help
            self._found = HolesFound(*now, refused={NAIL: report(error)})
        self.searching = False
        self._jobs.notify()  # and again, if it was drawn differently meanwhile
