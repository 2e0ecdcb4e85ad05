"""The demo as a case, which `sightline case` checks and replays and `sightline app --case` opens."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from sightline.case.contents import Pair, PlanRequest
    from sightline.case.journal import Case, Entry
    from sightline.case.views import CalibratedImage
    from sightline.cli.demos.robot import Checked, Inserted
    from sightline.planning import Plan, WirePlans
    from sightline.rehearsal.patient import AidClicks, RehearsedPatient


@dataclass(frozen=True, eq=False)
class Kept:
    """All that the demo records: the image `files`, their views, the plan and its inputs, and the wires put in, by key.

    `drawn_px`: the clicks on each aid by its key.
    """

    rehearsal: "RehearsedPatient"
    files: tuple[Path, Path]
    images: "tuple[CalibratedImage, CalibratedImage]"
    asked: "PlanRequest"
    plan: "Plan"
    drawn_px: "AidClicks"
    inserted: "Mapping[str, Inserted]"
    wires: "WirePlans | None" = None


def record(folder: Path, kept: Kept) -> None:
    """Create the case in a folder."""
    from sightline.app.session.rehearsing import Patient
    from sightline.case import stages
    from sightline.case.journal import Actor, Case, Kind
    from sightline.case.views import NAMES
    from sightline.rehearsal.rehearsal import Rehearsal

    rehearsal, by = kept.rehearsal, Actor.DEMO
    with Case.create(folder) as case:
        frame_ref = stages.keep_frame(case, rehearsal.setup.frame)
        stages.record_changed(case, "frame", frame_ref, by=by)
        if isinstance(rehearsal, Rehearsal):  # the app rehearses with a robot
            patient = Patient(rehearsal.seed, rehearsal.setup.frame.name, rehearsal.side, rehearsal.procedure)
            stages.record_changed(case, "rehearsal", vars(patient), by=by)
        before = case.last
        first, second = (
            stages.record_view(case, file, image, frame_ref=frame_ref, by=by)
            for file, image in zip(kept.files, kept.images, strict=True)
        )
        acquired = [entry.number for entry in case.entries(Kind.ACQUIRED, after=before)]
        decided = _decisions(kept, dict(zip(NAMES, acquired, strict=True)))
        stages.record_changed(case, "edit", decided, by=by)
        made = stages.record_plans(case, (first, second), kept.asked, kept.wires or kept.plan, by=by)
        for key, wire in kept.inserted.items():
            plan = case.entry(made["entries"][key] if kept.wires else made["entry"])
            if wire.again is not None:
                plan = stages.record_planned(case, (first, second), wire.again, wire.plan, by=by)
            for shot in wire.shots.values():
                if entries := _record_images(case, shot.images, frame_ref):
                    stages.record_shot(case, plan, entries, shot.asked, shot.found, by=by)
            if wire.drilled.record is not None:
                record = {"record": wire.drilled.document()["record"]}
                case.record(Kind.DRILLED, record, by=Actor.ROBOT, rests_on=[plan.number])
            _record_check(case, plan, wire.checked, frame_ref)


def _record_check(case: "Case", plan: "Entry", checked: "Checked", frame_ref: str) -> None:
    """Record both images of the check shot and its result, if they could be calibrated."""
    from sightline.case import stages
    from sightline.case.journal import Actor

    if entries := _record_images(case, checked.images, frame_ref):
        stages.record_verified(case, plan, entries, checked.asked, checked.found, by=Actor.DEMO)


def _record_images(case: "Case", images: "Pair | None", frame_ref: str) -> "list[Entry]":
    """Record calibrated images; return their entries."""
    from sightline.case import stages
    from sightline.case.journal import Actor
    from sightline.common.atomic import scratch_folder
    from sightline.imaging import write_dicom

    entries = []
    for image in images or ():
        assert image.seen.image is not None  # noqa: S101 - it was read
        with scratch_folder() as folder:
            file = write_dicom(image.seen.image, folder / "image.dcm")
            entries.append(stages.record_view(case, file, image, frame_ref=frame_ref, by=Actor.DEMO))
    return entries


def _decisions(kept: Kept, acquired: dict[str, int]) -> dict[str, object]:
    """Return the picks as the app keeps them; side and serial are left for a person to confirm."""
    from sightline.app.plan.decisions import Decisions, Mark
    from sightline.app.plan.marks import END, ENTRY
    from sightline.app.plan.planner import with_nail
    from sightline.case.views import NAMES

    def mark(places, *, free: bool) -> Mark:
        return Mark({name: (float(u), float(v)) for name, (u, v) in places.items()}, free)

    def ends(plan: "Plan") -> dict[str, Mark]:
        """Return entry and end, lateral picks as they were used: on their curves."""
        return {
            name: mark({view: pick.uv_px for view, pick in zip(NAMES, picks, strict=True)}, free=False)
            for name, picks in zip((ENTRY, END), plan.picks, strict=True)
        }

    nail = kept.asked.nail
    marks = ends(kept.plan) if nail is None else {}
    for k, name in enumerate(kept.asked.landmark_names):
        assert kept.asked.landmarks_uv_px is not None  # noqa: S101 - they have names
        marks[f"landmark-{name}"] = mark(dict(zip(NAMES, kept.asked.landmarks_uv_px[:, k], strict=True)), free=True)
    for key, each in kept.drawn_px.items():
        drawn = {name: uv for name, uv in zip(NAMES, each, strict=True) if uv is not None}
        for k in range(len(next(iter(drawn.values())))):
            marks[f"{key}-{k + 1}"] = mark({name: uv[k] for name, uv in drawn.items()}, free=True)
    images, kind = MappingProxyType(acquired), kept.plan.kind.key
    decisions = Decisions(images=images, kind=kind, marks=MappingProxyType(marks))
    if nail is not None:
        return with_nail(decisions, nail).document()
    for plan in () if kept.wires is None else kept.wires.plans.values():
        decisions = decisions.with_ends(plan.kind.key, ends(plan))
    return decisions.document()
