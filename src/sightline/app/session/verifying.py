"""The fifth step: two more images with the wire in the bone, and where it lies against the plan."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from sightline.app.plan.marks import CHECK_NAMES, names_of
from sightline.app.plan.planner import PICK_SD_PX
from sightline.app.session.planning import Planning
from sightline.app.session.rehearsing import check_images
from sightline.app.session.seen import SeenImage, entry_of
from sightline.app.session.sent import SentPlan
from sightline.calibration import BeadView
from sightline.case.contents import CheckAsked
from sightline.case.journal import Actor, Kind
from sightline.case.stages import record_verified
from sightline.case.views import NAMES
from sightline.errors import RefusedError, SightlineError, UnusableInputError
from sightline.planning.check_result import CheckShot
from sightline.planning.check_shot import Landmarks, check_shot
from sightline.planning.expected_wire import expected_wire

if TYPE_CHECKING:
    from sightline.detection.wire import WireShadow


class Verifying:
    """`shot`: the wire against the plan, once it was measured; `refused`: why it could not be. `wires`: what each check
    image shows, by the image's name."""

    def __init__(self, planning: Planning) -> None:
        self._planning = planning
        self._measured: tuple[object, ...] = ()
        self._found_in: dict[tuple[int, SentPlan], WireShadow] = {}
        self.shot: CheckShot | None = None
        self.refused = ""
        self.wires: dict[str, WireShadow] = {}

    async def take_rehearsed(self) -> None:
        """Both check images of the rehearsed patient. Raises SightlineError."""
        planning = self._planning
        patient, drilled = planning.patient, planning.drilled
        if patient is None or drilled is None:
            raise UnusableInputError("drill the wire first; then two more images show where it lies")
        text = drilled.wire.text()
        files = await planning.jobs.during(
            "taking both check images", lambda: planning.workshop.do(check_images, patient, text)
        )
        for name, data in files.items():
            await planning.take(data, ".dcm", image=f"check-{name}", by=Actor.DEMO)

    def update(self) -> None:
        """Forget a result of images that were replaced, and start to measure where images or landmarks are new."""
        asked = self._asked()
        if asked is None and self._measured:
            self._forget()
        if asked is not None and asked.key != self._measured:
            self._planning.jobs.start(self.measure())

    def _asked(self) -> "_Asked | None":
        """What there is to measure; None before both check images are calibrated."""
        planning, sent = self._planning, self._planning.sent
        seen = [planning.seen(name) for name in CHECK_NAMES]
        views = planning.views(CHECK_NAMES)
        if sent is None or views is None:
            return None
        then, now = sent.planned.decisions, planning.decisions
        told = planning.case.latest(Kind.SENT)
        if told is None or any(one is None or one.acquired.number < told.number for one in seen):
            return None  # images of before this plan was sent show another wire, or none
        names = [
            name
            for name in names_of(then.kind, "landmark")
            if then.mark(name).complete() and now.mark(name).complete(CHECK_NAMES)
        ]
        planned_px, checked_px = (
            np.array([[decisions.mark(name).at(image) for name in names] for image in images]).reshape(2, -1, 2)
            for decisions, images in ((then, NAMES), (now, CHECK_NAMES))
        )
        landmarks = Landmarks(planned_px, checked_px, PICK_SD_PX)
        return _Asked(sent, tuple(one for one in seen if one is not None), views, landmarks)

    def _forget(self) -> None:
        """What was measured holds no more."""
        self._measured, self.shot, self.refused, self.wires = (), None, "", {}

    async def measure(self) -> None:
        """Find the wire in both check images and compare."""
        asked = self._asked()
        if asked is None:
            return
        self._forget()
        self._measured = asked.key
        try:
            await self._measure(asked)
        except SightlineError as error:
            if asked.key == self._measured:
                self.shot, self.refused = None, str(error)
        self._planning.jobs.notify()

    async def _measure(self, asked: "_Asked") -> None:
        """Measured or refused, the case tells it: the last word is what a report repeats. Raises SightlineError."""
        try:
            wires = [await self._found(asked, one) for one in asked.seen]
            if asked.key != self._measured:
                return  # another was asked for meanwhile
            self.wires = dict(zip(CHECK_NAMES, wires, strict=True))
            plan, before = asked.sent.plan, asked.sent.planned.views
            self.shot = check_shot(
                plan.trajectory,
                plan.picks,
                before,
                asked.views,
                wires,
                landmarks=asked.landmarks,
                limits=plan.kind.limits,
            )
        except RefusedError as error:
            if asked.key == self._measured:
                self._record(asked, str(error))
            raise
        self._record(asked, self.shot)

    def _record(self, asked: "_Asked", found: CheckShot | str) -> None:
        case = self._planning.case
        told = case.latest(Kind.SENT)
        if told is None or not told.rests_on:
            return  # sent by a version that did not record its plan
        first, second = (entry_of(case, one) for one in asked.seen)
        measured = CheckAsked(asked.sent.plan.kind.wire_mm, asked.landmarks)
        record_verified(case, case.entry(told.rests_on[0]), (first, second), measured, found, by=Actor.APP)

    async def _found(self, asked: "_Asked", seen: SeenImage) -> "WireShadow":
        """The wire in one image, looked for once."""
        from sightline.detection.wire import find_wire

        key = (seen.acquired.number, asked.sent)
        if key not in self._found_in:
            assert seen.view is not None and seen.beads is not None  # noqa: S101 - it is calibrated
            kind = asked.sent.plan.kind
            expected = expected_wire(seen.view, asked.sent.plan.trajectory, kind.limits.beyond_mm)
            beads, width = seen.beads, kind.wire_mm
            self._found_in[key] = await self._planning.workshop.do(
                find_wire, seen.image, expected, width, beads.uv_px, beads.radius_px
            )
        return self._found_in[key]


@dataclass(frozen=True, eq=False)
class _Asked:
    """All that a check shot is measured from."""

    sent: SentPlan
    seen: tuple[SeenImage, ...]
    views: tuple[BeadView, BeadView]
    landmarks: Landmarks

    @property
    def key(self) -> tuple[object, ...]:
        """Equal for two that come to the same."""
        numbers = (one.acquired.number for one in self.seen)
        return (self.sent, *numbers, self.landmarks.checked_uv_px.tobytes())
