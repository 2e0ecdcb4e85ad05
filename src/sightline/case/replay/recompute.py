"""What the entries of a case stand for, computed again from its originals."""

from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

from sightline.calibration import CArm
from sightline.case import contents
from sightline.case.canonical import plain
from sightline.case.contents import Asked, CheckAsked, Pair
from sightline.case.journal import Case, Entry, Kind
from sightline.case.journal.originals import short
from sightline.case.stages import TABLE, frame_of, image_of
from sightline.case.views import CalibratedImage, Seen, calibrated
from sightline.detection import Detections, detect
from sightline.detection.files import read_observations
from sightline.errors import CaseError, ObservationsError, RefusedError
from sightline.frame import Frame
from sightline.imaging import Radiograph
from sightline.pipeline import label_beads
from sightline.planning import Plan
from sightline.planning.check_result import CheckShot

_Made = TypeVar("_Made")


class Recomputed:
    """What the entries of a case stand for, computed from its originals, each once. All raise SightlineError."""

    def __init__(self, case: Case) -> None:
        self._case, self._made = case, {}

    def image(self, entry: Entry) -> Radiograph | None:
        """Of an acquired image; None of a table of beads."""
        is_table = entry.content["original"].endswith(TABLE)
        return self._once(entry, lambda: None if is_table else image_of(self._case, entry))

    def beads(self, entry: Entry) -> Detections:
        """Of a detected entry."""
        return self._once(entry, lambda: detect(self._searched(entry)))

    def seen(self, entry: Entry) -> Seen:
        """Of a labelled entry."""
        return self._once(entry, lambda: self._seen(entry))

    def calibrated(self, entry: Entry) -> CalibratedImage:
        """Of a calibrated entry."""

        def make() -> CalibratedImage:
            said, known = entry.settings, entry.settings.get("c_arm")
            c_arm = None if known is None else CArm(**known)
            made = calibrated(self.seen(self._under(entry)), self._frame(entry), said["method"], c_arm)
            before = [self.calibrated(self._case.entry(number)).view for number in said.get("before", ())]
            view = made.view.steady_since(before).said_to_be(said.get("mirrored_display"))
            return CalibratedImage(made.seen, view)

        return self._once(entry, make)

    def plan(self, entry: Entry) -> Plan:
        """Of a planned entry."""

        return self._once(entry, lambda: Asked.of(entry.content["asked"]).plan(self.images(entry)))

    def images(self, entry: Entry) -> Pair:
        """Both calibrated images of a planned entry."""
        first, second = (self.calibrated(self._case.entry(number)) for number in entry.rests_on)
        return first, second

    def shot(self, entry: Entry) -> CheckShot | str:
        """Of a verified entry that says what was asked; where it is refused, why."""

        def make() -> CheckShot | str:
            plan, *views = (self._case.entry(number) for number in entry.rests_on)
            first, second = (self.calibrated(view) for view in views)
            try:
                return CheckAsked.of(entry.content["asked"]).shot(self.plan(plan), self.images(plan), (first, second))
            except RefusedError as error:
                return str(error)

        return self._once(entry, make)

    def content(self, entry: Entry) -> dict[str, Any] | None:
        """What the entry would hold if it were recorded now; None of an entry that is a record, not a result."""
        again: dict[Kind, Callable[[], dict[str, Any]]] = {
            Kind.ACQUIRED: lambda: contents.acquired(entry.content["original"], self.image(entry)),
            Kind.DETECTED: lambda: contents.detected(self.beads(entry)),
            Kind.LABELLED: lambda: contents.labelled(self.seen(entry).observations, self._frame(entry).key),
            Kind.CALIBRATED: lambda: contents.calibrated(self.calibrated(entry)),
            Kind.PLANNED: lambda: self._planned(entry),
        }
        if "asked" in entry.content:  # earlier versions did not say what a check shot was measured from
            again[Kind.VERIFIED] = lambda: contents.verified(CheckAsked.of(entry.content["asked"]), self.shot(entry))
        return again[entry.kind]() if entry.kind in again else None

    def _planned(self, entry: Entry) -> dict[str, Any]:
        """With what was known when it was recorded: earlier versions made fewer checks, and knew no third verdict."""
        then, made = entry.content, self.plan(entry)
        now = plain(contents.planned(Asked.of(then["asked"]), made))
        if "verdict" in then:
            return now
        known = {check["name"] for check in then["checks"]}
        now["checks"] = [check for check in now["checks"] if check["name"] in known]
        now["go"] = all(check["passed"] for check in now["checks"])
        now["landmarks"] = [{key: mark[key] for key in mark if key != "name"} for mark in now["landmarks"]]
        return {key: now[key] for key in then} | {"asked": then["asked"]}

    def _seen(self, entry: Entry) -> Seen:
        source, frame, view = self._under(entry), self._frame(entry), entry.settings["view"]
        if source.kind is Kind.ACQUIRED:
            return _from_table(self._case.original(source.content["original"]), entry.content["view"])
        beads, acquired = self.beads(source), self._under(source)
        image = self._searched(source)
        observations = label_beads(image, beads, frame, view, entry.settings["datums"])
        return Seen(short(acquired.content["original"]), observations, image, beads)

    def _searched(self, detected: Entry) -> Radiograph:
        """The image that a detected entry is of: inverted where its beads were found so."""
        image = self._present(self.image(self._under(detected)))
        return image if image.is_inverted == detected.settings.get("inverted", False) else image.inverted()

    def _frame(self, entry: Entry) -> Frame:
        return frame_of(self._case, entry.settings["frame"])

    def _under(self, entry: Entry) -> Entry:
        """The one entry that this one rests on."""
        (number,) = entry.rests_on
        return self._case.entry(number)

    @staticmethod
    def _present(image: Radiograph | None) -> Radiograph:
        if image is None:
            raise CaseError("an entry states beads of an image, but rests on a table")
        return image

    def _once(self, entry: Entry, make: Callable[[], _Made]) -> _Made:
        if entry.number not in self._made:
            self._made[entry.number] = make()
        return self._made[entry.number]


def _from_table(path: Path, view: str) -> Seen:
    views = read_observations(path)
    if view not in views:
        raise ObservationsError(f"the table holds no observations of view {view!r}")
    return Seen(short(path.name), views[view])
