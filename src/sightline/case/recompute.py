"""Everything a case states, computed again from its originals, and held against what was recorded."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Any, TypeVar

from sightline.calibration import CArm
from sightline.case import contents
from sightline.case.canonical import canonical, digest, plain
from sightline.case.compare_json import Difference, differences, largest
from sightline.case.contents import Asked, CheckAsked, Pair
from sightline.case.journal import Case, Entry, Kind
from sightline.case.journal.entry import versions
from sightline.case.journal.originals import short
from sightline.case.stages import TABLE, frame_of, image_of
from sightline.case.stated_error import beyond_stated
from sightline.case.views import CalibratedImage, Seen, calibrated, tell_apart
from sightline.checks import Check
from sightline.detection import Detections, detect
from sightline.detection.files import read_observations
from sightline.errors import CaseError, ObservationsError, RefusedError, SightlineError
from sightline.estimator import ESTIMATOR, FIRST
from sightline.frame import Frame
from sightline.imaging import Radiograph
from sightline.planning import Plan
from sightline.planning.check_result import CheckShot

_Made = TypeVar("_Made")


class Outcome(StrEnum):
    """How an entry compares with what is computed now."""

    SAME = "same to the bit"
    CLOSE = "within tolerance, by other versions"
    ESTIMATES = "estimates changed"
    BEYOND = "estimates changed by more than their stated error"
    DIFFERENT = "differs"
    FAILED = "cannot be computed again"
    RECORDED = "recorded, not computed"


@dataclass(frozen=True)
class Replayed:
    """One entry, computed again. `changed`: versions that are not those of the entry, as "name then -> now";
    `differences`: where the result is another, the largest first; `reason`: why it FAILED, or what is BEYOND."""

    entry: Entry
    outcome: Outcome
    changed: tuple[str, ...] = ()
    differences: tuple[Difference, ...] = ()
    reason: str = ""

    @property
    def passed(self) -> bool:
        """True unless something speaks against the entry."""
        return self.outcome not in (Outcome.BEYOND, Outcome.DIFFERENT, Outcome.FAILED)

    @property
    def said(self) -> str:
        """The outcome in words; where estimates changed, with the estimator's versions that changed them."""
        changed = self.outcome in (Outcome.ESTIMATES, Outcome.BEYOND)
        return f"{self.outcome} in {_since(self.entry)}" if changed else str(self.outcome)


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
        observations = tell_apart(image, beads, frame, view, entry.settings["datums"])
        return Seen(short(acquired.content["original"]), observations, image, beads)

    def _searched(self, detected: Entry) -> Radiograph:
        """The image that a detected entry is of: inverted where its beads were found so."""
        image = self._present(self.image(self._under(detected)))
        return image.inverted() if detected.settings.get("inverted") else image

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


def replay(case: Case) -> Iterator[Replayed]:
    """Every entry of a case in order, computed again from the originals."""
    again = Recomputed(case)
    for entry in case.entries():
        yield _replayed(entry, again)


def judge(replayed: Sequence[Replayed]) -> Check:
    """The check of docs/refusals.md, "case replay"."""
    bad = [one for one in replayed if not one.passed]
    computed = [one for one in replayed if one.outcome is not Outcome.RECORDED]
    same = sum(one.outcome is Outcome.SAME for one in computed)
    sentence = f"Of {len(computed)} computed entries {same} are the same to the bit"
    if close := sum(one.outcome is Outcome.CLOSE for one in computed):
        sentence += f", {close} within the tolerances, by other versions"
    if moved := [one for one in computed if one.outcome is Outcome.ESTIMATES]:
        sentence += f"; of {len(moved)} the {moved[0].said}, {_by_at_most(moved)}"
    if bad:
        sentence += f"; entry {bad[0].entry.number} ({bad[0].entry.kind}) {bad[0].said}"
        sentence += f": {bad[0].reason}" if bad[0].reason else ""
    return Check("case replay", not bad, float(len(bad)), 0.0, "entries", sentence + ".")


def _replayed(entry: Entry, again: Recomputed) -> Replayed:
    try:
        now = again.content(entry)
    except (SightlineError, KeyError, ValueError) as error:  # the last two: an entry that no stage of ours recorded
        reason = str(error) if isinstance(error, SightlineError) else "its content is not what this stage records"
        return Replayed(entry, Outcome.FAILED, _changed(entry), reason=reason)
    if now is None:
        return Replayed(entry, Outcome.RECORDED)
    text = canonical(now)
    changed = _changed(entry)
    if digest(text) == entry.content_sha256:
        return Replayed(entry, Outcome.SAME, changed)
    found = differences(entry.content, text)
    reason = ""
    if changed and all(one.close for one in found):
        outcome = Outcome.CLOSE
    elif _estimator(entry) != ESTIMATOR and all(one.where != "pixels_sha256" for one in found):  # no estimate
        reason = beyond_stated(entry.content, plain(now))
        outcome = Outcome.BEYOND if reason else Outcome.ESTIMATES
    else:
        outcome = Outcome.DIFFERENT
    return Replayed(entry, outcome, changed, found, reason)


def _estimator(entry: Entry) -> int:
    stated = entry.versions.get("estimator", "")
    return int(stated) if stated.isdecimal() else FIRST


def _since(entry: Entry) -> str:
    """The versions in which the estimates became others than the entry's."""
    low, high = sorted((_estimator(entry), ESTIMATOR))
    return f"version {high}" if high == low + 1 else f"versions {low + 1} to {high}"


def _by_at_most(replayed: Sequence[Replayed]) -> str:
    """The largest changes of pixels and lengths, each with its place, and verdicts that changed."""
    said = []
    for unit in ("px", "mm"):
        tops = [(top, one) for one in replayed if (top := largest(one.differences, unit)) is not None]
        if tops:
            top, one = max(tops, key=lambda pair: pair[0].by or 0.0)
            said.append(f"{top.by:.2g} {unit} (entry {one.entry.number}, {top.where})")
    words = f"by at most {' and '.join(said)}" if said else "without a change of pixels or lengths"
    other = [one.entry.number for one in replayed if any(d.where in ("go", "verdict") for d in one.differences)]
    return f"{words}; another verdict in entry {', '.join(map(str, other))}" if other else words


def _changed(entry: Entry) -> tuple[str, ...]:
    then, now = entry.versions, versions()
    names = sorted(then.keys() | now.keys())
    return tuple(
        f"{name} {then.get(name, 'none')} -> {now.get(name, 'none')}"
        for name in names
        if then.get(name) != now.get(name)
    )


def _from_table(path: Path, view: str) -> Seen:
    views = read_observations(path)
    if view not in views:
        raise ObservationsError(f"the table holds no observations of view {view!r}")
    return Seen(short(path.name), views[view])
