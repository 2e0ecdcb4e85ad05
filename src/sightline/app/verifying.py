"""The fifth step: two more images with the wire in the bone, and where it lies against the plan."""

from typing import TYPE_CHECKING

import numpy as np

from sightline.app.marks import CHECK_NAMES, names_of
from sightline.app.planner import PICK_SD_PX
from sightline.app.rehearsing import check_images
from sightline.app.seen import SeenImage
from sightline.case.entry import Actor, Kind
from sightline.case.views import NAMES
from sightline.detection.wire import WireShadow, find_wire
from sightline.errors import SightlineError, UnusableInputError
from sightline.planning.check_result import CheckShot
from sightline.planning.check_shot import Landmarks, check_shot
from sightline.planning.expected_wire import expected_wire

if TYPE_CHECKING:
    from sightline.app.procedure import Procedure


class Verifying:
    """`shot`: the wire against the plan, once it was measured; `refused`: why it could not be. `wires`: what each check
    image shows, by the image's name."""

    def __init__(self, procedure: "Procedure") -> None:
        self._procedure = procedure
        self._measured: tuple[object, ...] = ()
        self.shot: CheckShot | None = None
        self.refused = ""
        self.wires: dict[str, WireShadow] = {}

    async def take_rehearsed(self) -> None:
        """Both check images of the rehearsed patient. Raises SightlineError."""
        procedure = self._procedure
        patient, wire = procedure.patient, procedure.drilling.wire
        if patient is None or wire is None:
            raise UnusableInputError("drill the wire first; then two more images show where it lies")
        work = procedure.workshop.do(check_images, patient, wire.text())
        for name, data in (await procedure.during("taking both check images", work)).items():
            await procedure.take(data, ".dcm", image=f"check-{name}", by=Actor.DEMO)

    async def measure(self) -> None:
        """Find the wire in both check images and compare, if images, plan or landmarks are others than before."""
        procedure, sent = self._procedure, self._procedure.drilling.sent
        seen = [procedure.seen(name) for name in CHECK_NAMES]
        if sent is None or sent.plan is None or None in seen or any(one.view is None for one in seen if one):
            return
        names = [
            name
            for name in names_of(procedure.decisions.kind, "landmark")
            if sent.decisions.mark(name).complete() and procedure.decisions.mark(name).complete(CHECK_NAMES)
        ]
        planned_px, checked_px = (
            np.array([[decisions.mark(name).at(image) for name in names] for image in images]).reshape(2, -1, 2)
            for decisions, images in ((sent.decisions, NAMES), (procedure.decisions, CHECK_NAMES))
        )
        inputs = (sent, *(one.acquired.number for one in seen if one), checked_px.tobytes())
        if inputs == self._measured:
            return
        self._measured, self.shot, self.refused = inputs, None, ""
        try:
            views = [one.view for one in seen if one and one.view]
            for name, one in zip(CHECK_NAMES, seen, strict=True):
                assert one is not None  # noqa: S101
                self.wires[name] = await self._found(one)
            self.shot = check_shot(
                sent.plan.trajectory,
                sent.plan.picks,
                sent.views,
                views,
                [self.wires[name] for name in CHECK_NAMES],
                landmarks=Landmarks(planned_px, checked_px, PICK_SD_PX),
            )
            procedure.case.record(Kind.VERIFIED, self.shot.document(), by=Actor.APP)
        except SightlineError as error:
            self.refused = str(error)
        procedure.notify()

    async def _found(self, seen: SeenImage) -> WireShadow:
        sent = self._procedure.drilling.sent
        assert sent is not None and sent.plan is not None and seen.view is not None and seen.beads is not None  # noqa: S101
        expected = expected_wire(seen.view, sent.plan.trajectory)
        beads, width = seen.beads, sent.kind.wire_mm
        return await self._procedure.workshop.do(find_wire, seen.image, expected, width, beads.uv_px, beads.radius_px)
