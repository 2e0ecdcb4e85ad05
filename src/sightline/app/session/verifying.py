"""Step 5, Verify: two check images with the wire in the bone, compared with the plan."""

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
from sightline.case.contents import CheckRequest
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
    """Verification of the drilled wire. `shot`: the comparison with the plan, once measured; `refused`: why it could
    not be measured. `wires`: the wire found in each check image, by image name."""

    def __init__(self, planning: Planning) -> None:
        self._planning = planning
        self._measured: tuple[object, ...] = ()
        self._found_in: dict[tuple[int, SentPlan], WireShadow] = {}
        self.shot: CheckShot | None = None
        self.refused = ""
        self.wires: dict[str, WireShadow] = {}

    async def take_rehearsed(self) -> None:
        """Acquire both check images of the rehearsed patient. Raises SightlineError."""
        planning = self._planning
        patient, drilled = planning.patient, planning.drilled
        if patient is None or drilled is None:
            raise UnusableInputError("drill the wire first; then take the check images")
        text = drilled.wire.text()
        files = await planning.jobs.during(
            "taking both check images", lambda: planning.worker.do(check_images, patient, text)
        )
        for name, data in files.items():
            await planning.take(data, ".dcm", image=f"check-{name}", by=Actor.DEMO)

    def update(self) -> None:
        """Discard a result whose images were replaced, and start measuring if images or landmarks are new."""
        request = self._request()
        if request is None and self._measured:
            self._forget()
        if request is not None and request.key != self._measured:
            self._planning.jobs.start(self.measure())

    def _request(self) -> "_CheckRequest | None":
        """Return the input of the measurement; None before both check images are calibrated."""
        planning, sent = self._planning, self._planning.sent
        seen = [planning.seen(name) for name in CHECK_NAMES]
        views = planning.views(CHECK_NAMES)
        if sent is None or views is None:
            return None
        then, now = sent.planned.decisions, planning.decisions
        told = planning.case.latest(Kind.SENT)
        if told is None or any(one is None or one.acquired.number < told.number for one in seen):
            return None  # images acquired before this plan was sent show another wire, or none
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
        return _CheckRequest(sent, tuple(one for one in seen if one is not None), views, landmarks)

    def _forget(self) -> None:
        """Discard the result."""
        self._measured, self.shot, self.refused, self.wires = (), None, "", {}

    async def measure(self) -> None:
        """Find the wire in both check images and compare."""
        request = self._request()
        if request is None:
            return
        self._forget()
        self._measured = request.key
        try:
            await self._measure(request)
        except SightlineError as error:
            if request.key == self._measured:
                self.shot, self.refused = None, str(error)
        self._planning.jobs.notify()

    async def _measure(self, request: "_CheckRequest") -> None:
        """Measure, and record the result or the refusal in the case, from which reports are made. Raises
        SightlineError."""
        try:
            wires = [await self._found(request, one) for one in request.seen]
            if request.key != self._measured:
                return  # the input has changed meanwhile
            self.wires = dict(zip(CHECK_NAMES, wires, strict=True))
            plan, before = request.sent.plan, request.sent.planned.views
            self.shot = check_shot(
                plan.trajectory,
                plan.picks,
                before,
                request.views,
                wires,
                landmarks=request.landmarks,
                limits=plan.kind.limits,
            )
        except RefusedError as error:
            if request.key == self._measured:
                self._record(request, str(error))
            raise
        self._record(request, self.shot)

    def _record(self, request: "_CheckRequest", found: CheckShot | str) -> None:
        case = self._planning.case
        told = case.latest(Kind.SENT)
        if told is None or not told.rests_on:
            return  # sent by a version that did not record the plan
        first, second = (entry_of(case, one) for one in request.seen)
        measured = CheckRequest(request.sent.plan.kind.wire_mm, request.landmarks)
        record_verified(case, case.entry(told.rests_on[0]), (first, second), measured, found, by=Actor.APP)

    async def _found(self, request: "_CheckRequest", seen: SeenImage) -> "WireShadow":
        """Return the wire in one image, cached."""
        from sightline.detection.wire import find_wire

        key = (seen.acquired.number, request.sent)
        if key not in self._found_in:
            assert seen.view is not None and seen.beads is not None  # noqa: S101 - it is calibrated
            kind = request.sent.plan.kind
            expected = expected_wire(seen.view, request.sent.plan.trajectory.points.xyz_mm, kind.limits.beyond_mm)
            beads, width = seen.beads, kind.wire_mm
            self._found_in[key] = await self._planning.worker.do(
                find_wire, seen.image, expected, width, beads.uv_px, beads.radius_px
            )
        return self._found_in[key]


@dataclass(frozen=True, eq=False)
class _CheckRequest:
    """The input of a check shot's measurement."""

    sent: SentPlan
    seen: tuple[SeenImage, ...]
    views: tuple[BeadView, ...]
    landmarks: Landmarks

    @property
    def key(self) -> tuple[object, ...]:
        """Key that is equal for equal inputs."""
        numbers = (one.acquired.number for one in self.seen)
        return (self.sent, *numbers, self.landmarks.checked_uv_px.tobytes())
