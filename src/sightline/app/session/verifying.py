"""Step 5, Verify: two check images with the wires in the bone, each compared with its plan."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

from sightline.app.session.planning import Planning
from sightline.app.session.rehearsing import check_images
from sightline.app.session.seen import SeenImage, entry_of
from sightline.app.session.sent import SentPlan, found_again
from sightline.calibration import BeadView
from sightline.case.contents import CheckRequest
from sightline.case.journal import Actor
from sightline.case.stages import record_verified
from sightline.case.views import CHECK_NAMES, ImageSlot
from sightline.common.checks import Check
from sightline.errors import RefusedError, SightlineError, UnusableInputError
from sightline.from_images.pipeline import planned_search
from sightline.planning.check.result import CheckShot
from sightline.planning.check.shot import Landmarks, check_shot
from sightline.planning.procedures import kind as kind_of
from sightline.planning.wires import judge_measured

if TYPE_CHECKING:
    from sightline.detection.wire import WireShadow


class Verifying:
    """Verification of the drilled wires, all in the same two check images; each by its kind. `shots`: the comparison
    with its plan, once measured; `refusals`: why it could not be measured. `found`: the wire found in each check image,
    by image name. `shot`, `refused` and `wires`: these of the current wire."""

    def __init__(self, planning: Planning) -> None:
        self._planning = planning
        self._measured: dict[str, tuple[object, ...]] = {}
        self._taken: dict[tuple[str, ...], int] = {}  # how often the check images of the rehearsed wires were
        self._found_in: dict[tuple[int, SentPlan], WireShadow] = {}
        self.shots: dict[str, CheckShot] = {}
        self.refusals: dict[str, str] = {}
        self.found: dict[str, dict[str, WireShadow]] = {}

    @property
    def shot(self) -> CheckShot | None:
        """The comparison of the current wire with its plan."""
        return self.shots.get(self._planning.decisions.kind)

    @property
    def refused(self) -> str:
        """Why the current wire could not be measured."""
        return self.refusals.get(self._planning.decisions.kind, "")

    @property
    def wires(self) -> Mapping[str, "WireShadow"]:
        """The current wire in each check image."""
        return self.found.get(self._planning.decisions.kind, {})

    def relations(self) -> tuple[Check, ...]:
        """Return the checks of the relations between the wires as measured, those that can be made."""
        known = self._planning.planned
        shots = {kind_of(kind).wire.key: shot for kind, shot in self.shots.items()}
        if known is None or known.wires is None or len(shots) < 2 or not set(shots) <= set(known.wires.plans):
            return ()
        measured = judge_measured(known.wires, shots, known.decisions.side)
        return tuple(check for check in measured.checks if not check.missing)

    @property
    def shows_all(self) -> bool:
        """True if both check images were taken after the plan of the newest drilled wire was sent."""
        planning = self._planning
        seen = [planning.seen(name) for name in CHECK_NAMES]
        newest = max((planning.all_sent[kind].number for kind in planning.all_drilled), default=0)
        return all(image is not None and image.acquired.number > newest for image in seen)

    async def take_rehearsed(self) -> None:
        """Acquire both check images of the rehearsed patient, with all wires in the bone.

        Taken again, they show another place of the C-arm, as a refusal advises. Raises SightlineError.
        """
        planning = self._planning
        patient, drilled = planning.patient, planning.all_drilled
        if patient is None or not drilled:
            raise UnusableInputError("drill the wire first; then take the check images")
        wires = {kind: wire.wire.text() for kind, wire in drilled.items()}
        retake = self._taken.get(tuple(wires.values()), 0)
        files = await planning.jobs.during(
            "taking both check images", lambda: planning.worker.do(check_images, patient, wires, retake)
        )
        self._taken = {tuple(wires.values()): retake + 1}
        for name, data in files.items():
            await planning.take(data, ".dcm", image=ImageSlot(name, "check"), by=Actor.DEMO)

    def update(self) -> None:
        """Discard results whose images were replaced, and start measuring where images or landmarks are new."""
        asked = {request.kind: request for request in self._requests()}
        for kind in [kind for kind in self._measured if kind not in asked]:
            self._forget(kind)
        # A plan that was sent and not drilled is looked for only while a person asks about this wire.
        tried = {*self._planning.all_drilled, *self._measured, self._planning.decisions.kind}
        for kind, request in asked.items():
            if kind in tried and request.key != self._measured.get(kind):
                self._forget(kind)
                self._measured[kind] = request.key
                self._planning.jobs.start(self.measure(request))

    def _requests(self) -> "list[_CheckRequest]":
        """Return the input of each wire's measurement; none before both check images are calibrated."""
        planning = self._planning
        seen = [plan for plan in map(planning.seen, CHECK_NAMES) if plan is not None]
        views = planning.views(CHECK_NAMES)
        if views is None:
            return []
        # Images acquired before a plan was sent show another wire, or none.
        sent = [
            plan for plan in planning.all_sent.values() if all(image.acquired.number > plan.number for image in seen)
        ]
        now = planning.decisions
        return [
            _CheckRequest(plan, tuple(seen), views, found_again(plan.planned.decisions, now, CHECK_NAMES))
            for plan in sent
        ]

    def _forget(self, kind: str) -> None:
        """Discard the result of a wire."""
        self._measured.pop(kind, None)
        for results in (self.shots, self.refusals, self.found):
            results.pop(kind, None)

    @property
    def measuring(self) -> bool:
        """True while the current wire is found and compared."""
        kind = self._planning.decisions.kind
        return kind in self._measured and kind not in self.shots and kind not in self.refusals

    async def measure(self, request: "_CheckRequest") -> None:
        """Find a wire in both check images and compare."""
        try:
            await self._measure(request)
        except SightlineError as error:
            if self._is_asked(request):
                self.shots.pop(request.kind, None)
                self.refusals[request.kind] = str(error)
        self._planning.jobs.notify()

    def _is_asked(self, request: "_CheckRequest") -> bool:
        """Return False once the input has changed."""
        return request.key == self._measured.get(request.kind)

    async def _measure(self, request: "_CheckRequest") -> None:
        """Measure, and record the result or the refusal in the case, from which reports are made. Raises
        SightlineError."""
        try:
            wires = [await self._found(request, image) for image in request.seen]
            if not self._is_asked(request):
                return
            self.found[request.kind] = dict(zip(CHECK_NAMES, wires, strict=True))
            plan = request.sent.plan.to_check(request.sent.planned.views)
            self.shots[request.kind] = check_shot(plan, request.views, wires, landmarks=request.landmarks)
        except RefusedError as error:
            if self._is_asked(request):
                self._record(request, str(error))
            raise
        self._record(request, self.shots[request.kind])

    def _record(self, request: "_CheckRequest", result: CheckShot | str) -> None:
        case = self._planning.case
        sent = case.entry(request.sent.number)
        if not sent.rests_on:
            return  # sent by a version that did not record the plan
        first, second = (entry_of(case, image) for image in request.seen)
        measured = CheckRequest(request.sent.plan.kind.wire_mm, request.landmarks)
        record_verified(case, case.entry(sent.rests_on[0]), (first, second), measured, result, by=Actor.APP)

    async def _found(self, request: "_CheckRequest", seen: SeenImage) -> "WireShadow":
        """Return the wire in one image, cached."""
        from sightline.detection.wire import find_wire

        key = (seen.acquired.number, request.sent)
        if key not in self._found_in:
            view, beads, kind = seen.view, seen.beads, request.sent.plan.kind
            assert view is not None and beads is not None  # noqa: S101 - it is calibrated
            wires = request.sent.planned.wires
            others = () if wires is None else wires.others_mm(kind.wire.key)
            search = planned_search(request.sent.plan, view, others)
            image, covered = seen.image, search.covered_px
            find = partial(
                find_wire, image, search.expected, kind.wire_mm, beads, others=search.others, covered_px=covered
            )
            self._found_in[key] = await self._planning.worker.do(find)
        return self._found_in[key]


@dataclass(frozen=True, eq=False)
class _CheckRequest:
    """The input of a check shot's measurement."""

    sent: SentPlan
    seen: tuple[SeenImage, ...]
    views: tuple[BeadView, ...]
    landmarks: Landmarks

    @property
    def kind(self) -> str:
        """The wire's kind."""
        return self.sent.planned.decisions.kind

    @property
    def key(self) -> tuple[object, ...]:
        """Key that is equal for equal inputs."""
        numbers = (image.acquired.number for image in self.seen)
        return (self.sent, *numbers, self.landmarks.checked_uv_px.tobytes())
