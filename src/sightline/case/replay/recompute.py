"""Recomputation of the results in a case's entries from its originals."""

from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from sightline.calibration import CArm
from sightline.case import contents
from sightline.case.canonical import canonical, plain, with_null
from sightline.case.contents import CheckRequest, DrillShotRequest, Images, PlanRequest
from sightline.case.journal import Case, Entry, Kind
from sightline.case.journal.originals import short
from sightline.case.stages import TABLE, frame_of, image_of
from sightline.case.views import CalibratedImage, ObservedView, calibrated
from sightline.detection import Detections, detect
from sightline.detection.csv_files import read_observations
from sightline.errors import CaseError, ObservationsError, RefusedError
from sightline.frame import Frame
from sightline.from_images.pipeline import label_beads
from sightline.imaging import Radiograph
from sightline.planning import Plan, WirePlans
from sightline.planning.check.result import CheckShot
from sightline.planning.check.shot import DrillShot

_Made = TypeVar("_Made")


class Recomputed:
    """Results of a case's entries, recomputed from its originals; each is computed once. All raise SightlineError."""

    def __init__(self, case: Case) -> None:
        self._case, self._cache = case, {}

    def image(self, entry: Entry) -> Radiograph | None:
        """Return the image of an acquired entry; None for a table of beads."""
        is_table = entry.content["original"].endswith(TABLE)
        return self._once(entry, lambda: None if is_table else image_of(self._case, entry))

    def beads(self, entry: Entry) -> Detections:
        """Return the beads of a detected entry."""
        return self._once(entry, lambda: detect(self._detected_image(entry)))

    def seen(self, entry: Entry) -> ObservedView:
        """Return the observations of a labelled entry."""
        return self._once(entry, lambda: self._seen(entry))

    def calibrated(self, entry: Entry) -> CalibratedImage:
        """Return the calibrated image of a calibrated entry."""

        def make() -> CalibratedImage:
            settings, known = entry.settings, entry.settings.get("c_arm")
            c_arm = None if known is None else CArm(**known)
            made = calibrated(self.seen(self._source(entry)), self._frame(entry), settings["method"], c_arm)
            before = [self.calibrated(self._case.entry(number)).view for number in settings.get("before", ())]
            view = made.view.steady_since(before).said_to_be(settings.get("mirrored_display"))
            return CalibratedImage(made.seen, view)

        return self._once(entry, make)

    def plan(self, entry: Entry) -> Plan:
        """Return the plan of a planned entry."""
        wires = self.wires(entry)
        if wires is None:
            return self._once(entry, lambda: PlanRequest.of(entry.content["asked"]).plan(self.images(entry)))
        return wires.plans[PlanRequest.of(entry.content["asked"]).known_kind.wire.key]

    def wires(self, entry: Entry) -> WirePlans | None:
        """Return the plans of all wires that a planned entry's wire was planned with; None where it was alone."""
        asked = PlanRequest.of(entry.content["asked"])
        if asked.others is None:
            return None
        return self._once(entry, lambda: asked.plan_wires(self.images(entry)))

    def others_mm(self, entry: Entry) -> tuple[np.ndarray, ...]:
        """Return entry and end (2, 3) of the other wires that a planned entry's wire was planned with."""
        wires = self.wires(entry)
        return () if wires is None else wires.others_mm(self.plan(entry).kind.wire.key)

    def of_all_wires(self, entry: Entry) -> dict[str, Entry]:
        """Return the planned entries of the wires that a planned entry's wire was planned with, its own too, by key."""
        asked, entries = PlanRequest.of(entry.content["asked"]), {}
        own = asked.known_kind.wire.key
        for planned in [] if asked.others is None else self._case.entries(Kind.PLANNED):
            known = PlanRequest.of(planned.content["asked"])
            key = known.known_kind.wire.key
            if planned.rests_on == entry.rests_on and known.others is not None and own in {key, *known.others}:
                same = canonical(with_null(known.of_wire(own))) == canonical(with_null(asked))
                entries |= {key: planned} if same else {}
        return entries

    def measured(self, entry: Entry) -> dict[str, CheckShot]:
        """Return the last check shot of each wire that a planned entry's wire was planned with, its own too, by key.

        Refused ones are left out.
        """
        shots = {}
        for key, planned in self.of_all_wires(entry).items():
            verified = [
                check for check in self._case.entries(Kind.VERIFIED, planned.number) if planned.number in check.rests_on
            ]
            shot = self.shot(verified[-1]) if verified and "asked" in verified[-1].content else None
            shots |= {key: shot} if isinstance(shot, CheckShot) else {}
        return shots

    def images(self, entry: Entry) -> Images:
        """Return the calibrated images of a planned entry, PA first."""
        return tuple(self.calibrated(self._case.entry(number)) for number in entry.rests_on)

    def shot(self, entry: Entry) -> CheckShot | str:
        """Return the check shot of a verified entry that holds its request, or why it is refused."""
        asked, plan = CheckRequest.of(entry.content["asked"]), self._case.entry(entry.rests_on[0])
        return self._measured(entry, lambda *made: asked.shot(*made, others_mm=self.others_mm(plan)))

    def drill_shot(self, entry: Entry) -> DrillShot | str:
        """Return the shot of a shot entry, or why it is refused."""
        asked, plan = DrillShotRequest.of(entry.content["asked"]), self._case.entry(entry.rests_on[0])
        return self._measured(entry, lambda *made: asked.shot(*made, others_mm=self.others_mm(plan)))

    def _measured(self, entry: Entry, shot: Callable[[Plan, Images, Images], _Made]) -> _Made | str:
        def make() -> _Made | str:
            plan, *views = (self._case.entry(number) for number in entry.rests_on)
            try:
                return shot(self.plan(plan), self.images(plan), tuple(self.calibrated(view) for view in views))
            except RefusedError as error:
                return str(error)

        return self._once(entry, make)

    def content(self, entry: Entry) -> dict[str, Any] | None:
        """Return the content that the entry would have if it were recorded now; None if it is not a computed result."""
        again: dict[Kind, Callable[[], dict[str, Any]]] = {
            Kind.ACQUIRED: lambda: contents.acquired(entry.content["original"], self.image(entry)),
            Kind.DETECTED: lambda: contents.detected(self.beads(entry)),
            Kind.LABELLED: lambda: contents.labelled(self.seen(entry).observations, self._frame(entry).key),
            Kind.CALIBRATED: lambda: contents.calibrated(self.calibrated(entry)),
            Kind.PLANNED: lambda: self._planned(entry),
        }
        if entry.kind is Kind.SHOT:
            asked = DrillShotRequest.of(entry.content["asked"])
            again[Kind.SHOT] = lambda: contents.shot(asked, self.drill_shot(entry))
        if "asked" in entry.content:  # earlier versions did not record the request of a check shot
            again[Kind.VERIFIED] = lambda: contents.shot(CheckRequest.of(entry.content["asked"]), self.shot(entry))
        return again[entry.kind]() if entry.kind in again else None

    def _planned(self, entry: Entry) -> dict[str, Any]:
        """Return a plan's content as the version that recorded it wrote it: earlier ones made fewer checks and had no
        verdict "incomplete"."""
        then, made = entry.content, self.plan(entry)
        now = plain(contents.planned(PlanRequest.of(then["asked"]), made))
        if "procedure" not in then:  # procedures were not files, and some had other keys
            del now["procedure"], now["implant"]
            now |= {key: then[key] for key in ("asked", "kind") if key in then}
        if "verdict" in then:
            return now
        known = {check["name"] for check in then["checks"]}
        now["checks"] = [check for check in now["checks"] if check["name"] in known]
        now["go"] = all(check["passed"] for check in now["checks"])
        now["landmarks"] = [{key: mark[key] for key in mark if key != "name"} for mark in now["landmarks"]]
        return {key: now[key] for key in then} | {"asked": then["asked"]}

    def _seen(self, entry: Entry) -> ObservedView:
        source, frame, view = self._source(entry), self._frame(entry), entry.settings["view"]
        if source.kind is Kind.ACQUIRED:
            return _from_table(self._case.original(source.content["original"]), entry.content["view"])
        beads, acquired = self.beads(source), self._source(source)
        image = self._detected_image(source)
        observations = label_beads(image, beads, frame, view, entry.settings["datums"])
        return ObservedView(short(acquired.content["original"]), observations, image, beads)

    def _detected_image(self, detected: Entry) -> Radiograph:
        """Return the image of a detected entry, inverted if its beads were found in the inverse."""
        image = self.image(self._source(detected))
        if image is None:
            raise CaseError("an entry states beads of an image, but rests on a table")
        return image if image.is_inverted == detected.settings.get("inverted", False) else image.inverted()

    def _frame(self, entry: Entry) -> Frame:
        return frame_of(self._case, entry.settings["frame"])

    def _source(self, entry: Entry) -> Entry:
        """Return the single entry that this one was made from."""
        (number,) = entry.rests_on
        return self._case.entry(number)

    def _once(self, entry: Entry, make: Callable[[], _Made]) -> _Made:
        if entry.number not in self._cache:
            self._cache[entry.number] = make()
        return self._cache[entry.number]


def _from_table(path: Path, view: str) -> ObservedView:
    views = read_observations(path)
    if view not in views:
        raise ObservationsError(f"the table holds no observations of view {view!r}")
    return ObservedView(short(path.name), views[view])
