"""Shots while drilling: two images of a block, or of a frame fixed to the patient, at ALIGNED and at PAUSED show where
the wire goes, before it goes on; and the
live image, analysed as by `sightline watch`, with the plan drawn over it."""

import asyncio
from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING

import numpy as np

from sightline.app import texts
from sightline.app.plan.marks import GUIDE
from sightline.app.session.drilling_workflow import DrillingWorkflow
from sightline.app.session.planning import Planning
from sightline.app.session.rehearsing import Patient, shot_images
from sightline.app.session.seen import SeenImage, entry_of
from sightline.app.session.sent import SentPlan, found_again
from sightline.case.contents import CheckRequest, DrillShotRequest
from sightline.case.journal import Actor, Kind
from sightline.case.stages import record_changed, record_shot
from sightline.case.views import ALL_NAMES, SHOT_NAMES, ImageSlot
from sightline.common.checks import failed
from sightline.common.geometry.covariance import TWO_SIDED_95
from sightline.errors import RefusedError, RobotRefusedError, SetUpError, SightlineError, UnusableInputError
from sightline.frame import Frame
from sightline.planning.check.result import MIN_LANDMARKS
from sightline.planning.check.shot import ALIGNED, PAUSED, DrillShot
from sightline.planning.check.wires import Landmarks

STOP = "STOP"
_ON_PATIENT = "frame on patient"  # what a person's statement changes, in the journal


class Shots:
    """The shots of the wire that the robot drills. `found`: the newest one measured, for the robot's present state;
    `refused`: why it could not be measured."""

    def __init__(self, planning: Planning, drilling: DrillingWorkflow) -> None:
        self._planning, self._drilling = planning, drilling
        self._since: tuple[str, SentPlan | None, int] = "", None, 0  # state and plan, and the journal's last entry then
        self._asking: tuple[int, int] | None = None
        self._stood: tuple[tuple[int, int], np.ndarray] | None = None  # both images, and the robot's joints at them
        self._measured: tuple[object, ...] = ()
        self.found: DrillShot | None = None
        self.refused = ""
        self._stopping: DrillShot | None = None  # what was measured last in this state, if it says STOP
        self._said = planning.case.latest(Kind.CHANGED, where={"what": _ON_PATIENT})

    @property
    def on_patient(self) -> bool:
        """True if a person stated that the plan's frame was taken off the arm and is fixed to the patient; landmarks
        alone then tell where it is. New images of the plan end it: they register the robot by the frame on its arm."""
        images = self._planning.decisions.images
        taken = max((images[name] for name in ALL_NAMES if name in images), default=0)
        return self._said is not None and self._said.number > taken and bool(self._said.content["to"]["fixed"])

    @property
    def state(self) -> str:
        """The robot's state while it waits for a shot; empty at other times, with plates on the arm, which turn away,
        and while a guide holds no wire."""
        turned = self._planning.frame.solid is None and not self.on_patient
        return "" if turned or self._drilling.by_hand else self._waiting

    @property
    def _waiting(self) -> str:
        now = self._drilling.now
        return "" if now is None or now.lost or now.state not in (ALIGNED, PAUSED) else now.state

    @property
    def shown(self) -> str:
        """The robot's state in both images, if it is still in it; else empty."""
        held = self._since[:2] == (self._waiting, self._drilling.held)
        return self.state if held and self._stood is not None and self._stood[0] == self._numbers else ""

    @property
    def objection(self) -> str:
        """Why the robot must not drill on: what was measured last in its present state says STOP. Empty where it does
        not."""
        if self._stopping is None or self._since[:2] != (self._waiting, self._drilling.held):
            return ""
        verdict = self._stopping.verdict
        why = " ".join(check.sentence for check in failed(verdict.checks) if not check.missing)
        return f"The shot says STOP: {why}"

    @property
    def lacks_landmarks(self) -> bool:
        """True if the images are there, and fewer landmarks are found again than tell where a frame on the patient
        is."""
        return bool(self.shown) and self.on_patient and len(self._landmarks()) < MIN_LANDMARKS

    @property
    def measuring(self) -> bool:
        """True while the shot is being measured."""
        return bool(self._measured) and self.found is None and not self.refused

    def state_on_patient(self, *, fixed: bool) -> None:
        """Record a person's statement that the plan's frame is fixed to the patient, or on the arm again. Images of
        before do not count. Raises UnusableInputError while images are being taken, CaseError."""
        planning = self._planning
        planning.jobs.refuse_more()
        self._said = record_changed(planning.case, _ON_PATIENT, {"fixed": fixed}, by=Actor.SURGEON)
        self._since, self._stood = (*self._since[:2], self._said.number), None
        planning.jobs.notify()

    async def take_rehearsed(self) -> None:
        """Acquire both images of the rehearsed patient where the robot waits. Raises SightlineError."""
        planning, drilling, state = self._planning, self._drilling, self.state
        session, held, patient = drilling.session, drilling.held, planning.patient
        if session is None or held is None or patient is None or not state:
            raise RobotRefusedError(texts.SHOT_NOT_WAITING)
        wire, q = await session.simulated_wire(), await session.joints()
        kind = held.planned.decisions.kind
        wires = {key: earlier.wire.text() for key, earlier in planning.all_drilled.items() if key != kind}
        wires[kind] = wire.text()
        args = wires, q.tolist(), state, self.on_patient

        async def taken() -> dict[str, bytes]:
            try:
                return await planning.worker.do(shot_images, patient, *args)
            except SetUpError as error:
                raise RobotRefusedError(
                    "Decide by eye: this shot cannot be measured, because the field of the simulated "
                    "C-arm does not show the robot's wire and all landmarks together."
                ) from error

        files = await planning.jobs.during("taking the shot", taken)
        for name, data in files.items():
            await planning.take(data, ".dcm", image=ImageSlot(name, "shot"), by=Actor.DEMO)

    async def send_depth(self) -> None:
        """Send the measured depth to the robot. Raises RobotRefusedError, LinkError, CaseError."""
        if self.shown != PAUSED or self.found is None or self.found.decision != "GO":
            raise RobotRefusedError(texts.SHOT_NOT_WAITING)
        await self._drilling.send_shot_depth(self.found.depth_mm, TWO_SIDED_95 * self.found.depth_sd_mm)

    def update(self) -> None:
        """Note where the robot stands at new images, and start measuring where images or points are new."""
        jobs, case, held, state = self._planning.jobs, self._planning.case, self._drilling.held, self._waiting
        if self._since[:2] != (state, held):  # images of before show another moment
            self._since, self._asking, self._stood = (state, held, case.last), None, None
            self._stopping = None
        numbers, session = self._numbers, self._drilling.session
        new = numbers is not None and min(numbers) > self._since[2] and numbers != self._asking
        if self.state and new and session is not None and not session.now.activity:
            self._asking = numbers
            jobs.start(self._note())
        request = self._request()
        key = () if request is None else request[0]
        if key != self._measured:
            self._measured, self.found, self.refused = key, None, ""
            if request is not None:
                jobs.start(self._measure(*request))

    @property
    def _numbers(self) -> tuple[int, int] | None:
        """Numbers of both images; None before they are taken."""
        images = self._planning.decisions.images
        both = [images[name] for name in SHOT_NAMES if name in images]
        return (both[0], both[1]) if len(both) == len(SHOT_NAMES) else None

    async def _note(self) -> None:
        session, numbers, since = self._drilling.session, self._numbers, self._since
        q = None if session is None else await session.joints()
        if q is not None and numbers is not None and numbers == self._numbers and since == self._since:
            self._stood = numbers, q
            self._planning.jobs.notify()

    def _request(self) -> "tuple[tuple[object, ...], SentPlan, list[SeenImage], DrillShotRequest] | None":
        """Return key, plan, images and input of the measurement; None before all of them are there."""
        planning, drilling, held = self._planning, self._drilling, self._drilling.held
        seen = [image for image in map(planning.seen, SHOT_NAMES) if image is not None and image.view is not None]
        session, numbers = drilling.session, self._numbers
        if not self.shown or len(seen) < 2 or held is None or drilling.changed or session is None or numbers is None:
            return None
        if self.lacks_landmarks:
            return None
        state, target, plan = self.shown, session.target, held.plan
        guide = [planning.decisions.mark(spec.name) for spec in GUIDE] if state == ALIGNED else []
        if target is None or self._stood is None or not all(mark.complete(SHOT_NAMES) for mark in guide):
            return None
        picked = np.array([[mark.at(name) for mark in guide] for name in SHOT_NAMES]) if guide else None
        q, middle_mm = self._stood[1], plan.trajectory.points.xyz_mm.mean(axis=0)
        landmarks, moved = self._landmarks(), (None, None)
        if not self.on_patient:
            registered = target.registration
            movement, covariance = registered.robot.frame_moved(registered.q, q, middle_mm)
            moved = movement.as_matrix(), covariance
        check, tip_mm = CheckRequest(plan.kind.wire_mm, landmarks), target.depth_at(q)
        asked = DrillShotRequest(check, tip_mm, state == ALIGNED, *moved, picked)
        points = () if picked is None else picked.tobytes()
        return (held, *numbers, landmarks.checked_uv_px.tobytes(), points), held, seen, asked

    def _landmarks(self) -> Landmarks:
        """Return the landmarks of the plan that the robot holds, as far as they are found again."""
        held, now = self._drilling.held, self._planning.decisions
        return found_again(now if held is None else held.planned.decisions, now, SHOT_NAMES)

    async def _measure(
        self, key: tuple[object, ...], held: SentPlan, seen: list[SeenImage], asked: DrillShotRequest
    ) -> None:
        """Measure the shot and record the result or the refusal."""
        planning, wires = self._planning, held.planned.wires
        before = [image.calibrated for image in map(planning.seen, planning.names) if image is not None]
        planned = [image for image in before if image is not None]
        taken = [image.calibrated for image in seen if image.calibrated is not None]
        others = () if wires is None else wires.others_mm(held.plan.kind.wire.key)
        result: DrillShot | str
        try:
            result = await asyncio.to_thread(asked.shot, held.plan, planned, taken, others)
        except RefusedError as error:
            result = str(error)
        if key != self._measured:
            return  # the input has changed meanwhile
        self.found, self.refused = (None, result) if isinstance(result, str) else (result, "")
        if self.found is not None:
            self._stopping = self.found if self.found.decision == STOP else None
        case = planning.case
        try:
            entries = [entry_of(case, image) for image in seen]
            record_shot(case, case.entry(case.entry(held.number).rests_on[0]), entries, asked, result, by=Actor.APP)
        except SightlineError as error:
            self.found, self.refused = None, str(error)
        planning.jobs.notify()


if TYPE_CHECKING:
    from sightline.case.watch.analyser import TimedImage, Watched
    from sightline.case.watch.live import Watch

# Freshness is reported every 0.1 s; allow one period and 0.1 s of latency. If the reports stop, an image can show as
# current until it is STALE_S + LATE_S = 0.4 s old.
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
