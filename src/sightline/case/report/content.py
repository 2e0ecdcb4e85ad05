"""The content of a report before it is rendered, and the report of a case's last plan."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from sightline.calibration import BeadView, CalibratedView
from sightline.case.journal import Case, Entry, Kind
from sightline.case.journal.originals import short
from sightline.case.replay import Recomputed
from sightline.case.report.drilled import Drilled
from sightline.case.stages import acquired_of, frame_of
from sightline.case.views import CalibratedImage, ObservedView, spoken
from sightline.common.checks import Check
from sightline.common.geometry.lines import angle_rad
from sightline.errors import CaseError, UnusableInputError
from sightline.frame import Frame
from sightline.imaging import Radiograph
from sightline.planning import Plan, Trajectory, WirePlans
from sightline.planning.check.result import CheckShot
from sightline.planning.check.shot import ALIGNED, PAUSED
from sightline.planning.points.results import Verdict
from sightline.planning.procedures import Procedure
from sightline.robot.link.record import DrillingRecord, last_hole


@dataclass(frozen=True, eq=False)
class Truth:
    """The intended wire: entry and end point (2, 3), CFCS, and their pixels in each image (2, 2, 2)."""

    xyz_mm: np.ndarray
    uv_px: np.ndarray


@dataclass(frozen=True, eq=False)
class Compared:
    """One plan compared with the truth. `picks`: how its points were picked, in words."""

    method: str
    picks: str
    trajectory: Trajectory
    truth: Truth

    @property
    def errors_mm(self) -> tuple[float, float]:
        """Errors of the entry and of the end point."""
        entry, end = np.linalg.norm(self.trajectory.points.xyz_mm - self.truth.xyz_mm, axis=1)
        return float(entry), float(end)

    @property
    def direction_error_rad(self) -> float:
        """The angle between the planned and the true direction."""
        return float(angle_rad(self.truth.xyz_mm[1] - self.truth.xyz_mm[0], self.trajectory.direction))

    @property
    def errors(self) -> tuple[float, float, float]:
        """Errors of the entry point, mm, of the end point, mm, and of the direction, degrees."""
        return *self.errors_mm, float(np.rad2deg(self.direction_error_rad))

    @property
    def bounds_95(self) -> tuple[float, float, float] | None:
        """The 95 % bounds that the plan stated for the same errors; None if its error is unknown."""
        if not self.trajectory.error_stated:
            return None
        path = self.trajectory
        return path.entry_error_95_mm, path.end_error_95_mm, float(np.rad2deg(path.direction_error_95_rad))

    @property
    def within_bounds(self) -> int | None:
        """How many of the three errors are within their bounds; None if the plan states no bounds."""
        bounds = self.bounds_95
        return None if bounds is None else sum(e <= b for e, b in zip(self.errors, bounds, strict=True))

    def document(self) -> dict[str, Any]:
        """Return the comparison as JSON types."""
        names = ("entry_mm", "end_mm", "direction_deg")
        bounds = self.bounds_95
        return {
            "method": self.method,
            "picks": self.picks,
            "error": dict(zip(names, self.errors, strict=True)),
            "stated_95": None if bounds is None else dict(zip(names, bounds, strict=True)),
            "within_bounds": self.within_bounds,
        }


@dataclass(frozen=True)
class Refused:
    """A plan that a method refused to make, and the reason."""

    method: str
    picks: str
    reason: str

    def document(self) -> dict[str, Any]:
        """Return the refusal as JSON types."""
        return {"method": self.method, "picks": self.picks, "refused": self.reason}


NOTE = (
    "Exposures whose images were kept. Other exposures, such as live images and those to position patient and C-arm, "
    "are not known here, and neither is the dose."
)
PLANNING, CHECK, UNUSED = "planning", "check shot", "not used for this plan"
WHILE_DRILLING = {ALIGNED: "confirmation shot", PAUSED: "second shot"}


@dataclass(frozen=True)
class KeptExposure:
    """An exposure whose image was kept. `image`: the first digits of its hash. `at`: UTC, when it was kept; None
    outside a case. `frames`: the number of frames exposed for it, in a run or an average."""

    image: str
    used: str
    at: str | None = None
    frames: int = 1


def exposures_of_images(images: Iterable[CalibratedImage], used: str, kind: Procedure) -> tuple[KeptExposure, ...]:
    """Return the exposures of images outside a case."""
    return tuple(KeptExposure(image.seen.source, f"{used}, {spoken(image.name, kind)} view") for image in images)


def exposures_of_case(case: Case, plan: Entry, kind: Procedure | None = None) -> tuple[KeptExposure, ...]:
    """Return all exposures of a case in order, and the use of each in a plan and its check shot. `kind`: of the plan,
    whose names the views get.

    Images with the same pixels, from the same file or under another header, count as one exposure.
    """
    uses = dict(_uses(case, plan, kind))
    exposures: dict[str, KeptExposure] = {}
    by_file: dict[str, str] = {}
    for entry in case.entries(Kind.ACQUIRED):
        acquisition = entry.settings.get("acquisition") or {}
        frames = int(acquisition.get("frames") or acquisition.get("averaged") or 1)
        pixels = str(entry.content.get("pixels_sha256", f"{entry.number}"))
        known = by_file.setdefault(entry.content["original"], pixels)
        used = uses.get(entry.number)
        before = exposures.get(known)
        if before is None or (used is not None and before.used == UNUSED):
            at = before.at if before else f"{entry.at:%Y-%m-%d %H:%M:%S}"
            exposures[known] = KeptExposure(short(entry.content["original"]), used or UNUSED, at, frames)
    return tuple(exposures.values())


def _uses(case: Case, plan: Entry, kind: Procedure | None) -> Iterator[tuple[int, str]]:
    """Yield numbers of acquired entries, and what their images were used for."""
    uses = [(PLANNING, plan.rests_on)]
    uses += [(CHECK, entry.rests_on[1:]) for entry in _of_plan(case, Kind.VERIFIED, plan)]
    for entry in _of_plan(case, Kind.SHOT, plan):
        state = ALIGNED if entry.content["asked"]["straight"] else PAUSED
        uses.append((WHILE_DRILLING[state], entry.rests_on[1:]))
    for what, views in reversed(uses):
        for number in views:
            view = case.entry(number)
            yield acquired_of(case, view).number, f"{what}, {spoken(view.content['view'], kind)} view"


def _of_plan(case: Case, kind: Kind, plan: Entry) -> list[Entry]:
    return [entry for entry in case.entries(kind) if entry.rests_on[:1] == (plan.number,)]


@dataclass(frozen=True, eq=False)
class Report:
    """The content of the report of one plan.

    `images`: PA, lateral and any third, with the views that `plan` was made on. `localized`: both views calibrated with
    the paper's method, for its triangles. `compared`, `truth`: only if the truth is known. `drilled`: once a robot has
    carried out the plan. `exposures`: the known exposures of the procedure. `provenance`: how to reproduce the report,
    in words. `confirmed`: checks of what a person confirmed, which enter the verdict. `wires`: the plans of all wires
    of the procedure, where `plan` is one of several; `measured`: the check
    shots of these wires, by key.
    """

    title: str
    frame: Frame
    images: tuple[CalibratedImage, ...]
    plan: Plan
    exposures: Sequence[KeptExposure]
    provenance: dict[str, str]
    localized: tuple[BeadView, BeadView] | None = None
    truth: Truth | None = None
    compared: Sequence[Compared | Refused] = field(default=())
    drilled: Drilled | None = None
    wires: WirePlans | None = None
    measured: Mapping[str, CheckShot] = field(default_factory=dict)
    confirmed: Sequence[Check] = field(default=())

    @property
    def verdict(self) -> Verdict:
        """The verdict on the plan, with what a person confirmed."""
        return self.plan.verdict.joined(Verdict(tuple(self.confirmed)))

    def spoken(self, view: str) -> str:
        """Return a view's name as the procedure has it."""
        return spoken(view, self.plan.kind)


def report_of(case: Case, confirmed: Sequence[Check] = ()) -> Report:
    """Return the report of the last plan and its drilling, recomputed from the originals, which name the images.

    `confirmed`: as of `Report`.
    Raises CaseError if the case holds no plan; also raises the errors of the recomputed stages.
    """
    entry = case.latest(Kind.PLANNED)
    if entry is None:
        raise CaseError("the case holds no plan yet; plan first, then report")
    again = Recomputed(case)
    made = again.plan(entry)
    return Report(
        title=f"Case {case.number}",
        frame=frame_of(case, case.entry(entry.rests_on[0]).settings["frame"]),
        images=again.images(entry),
        plan=made,
        wires=again.wires(entry),
        measured=again.measured(entry),
        exposures=exposures_of_case(case, entry, made.kind),
        drilled=_drilled(case, entry, again),
        confirmed=confirmed,
        provenance={
            "case": f"{case.number}, entry {entry.number} of {case.last}",
            "planned": f"{entry.at:%Y-%m-%d %H:%M} UTC, by {entry.by}",
            "journal": f"the hash chain is {entry.chain[:16]} at entry {entry.number}",
        },
    )


def report_of_plan(plan: Plan) -> Report:
    """Return the report of a plan alone, with the images that its views hold; their files are not known.

    Raises UnusableInputError for a plan on a view without beads.
    """
    images, frames = zip(*(_image_and_frame(view) for view in plan.views), strict=True)
    return Report(
        title="Planned guide wire",
        frame=frames[0],
        images=images,
        plan=plan,
        exposures=exposures_of_images(images, PLANNING, plan.kind),
        provenance={"picks": "given in Python"},
    )


def _image_and_frame(view: CalibratedView) -> tuple[CalibratedImage, Frame]:
    """Return a view with the image that it holds, if it holds one, and its frame. Raises UnusableInputError."""
    if not isinstance(view, BeadView) or view.inputs is None:
        raise UnusableInputError(
            f"a report shows the beads of each view, and none of view {view.name} are known; plan on views of "
            "`calibrate_image` or `calibrate`"
        )
    seen, image = view.inputs.observations, None
    if seen.pixels is not None and seen.radius_px is not None:
        image = Radiograph(seen.pixels, float(seen.pixels.max()))  # the figures' grey alone needs its white
    return CalibratedImage(ObservedView("", seen, image), view), view.inputs.frame


def _drilled(case: Case, plan: Entry, again: Recomputed) -> Drilled | None:
    """Return the last drilling record and the last check shot after it; None if there is neither since the plan."""
    drilled = case.entries(Kind.DRILLED, plan.number)
    own = [entry for entry in drilled if not entry.rests_on or plan.number in entry.rests_on]  # not of another wire
    records = [entry.content["record"] for entry in own if "record" in entry.content]
    since = max([plan.number, *(entry.number for entry in own)])
    verified = [entry for entry in case.entries(Kind.VERIFIED, since) if plan.number in entry.rests_on]
    shots = [entry for entry in verified if "asked" in entry.content]  # earlier versions did not record the request
    drilling = {entry.content["asked"]["straight"]: entry for entry in case.entries(Kind.SHOT, plan.number)}
    if not records and not shots and not drilling:
        return None
    return Drilled(
        target=None,
        record=last_hole([DrillingRecord.of(record) for record in records]),
        check=again.shot(shots[-1]) if shots else None,
        shots={ALIGNED if straight else PAUSED: again.drill_shot(entry) for straight, entry in drilling.items()},
    )
