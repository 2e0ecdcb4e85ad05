"""`sightline check-shot`: two more images, with the wire in the bone, against the plan of a case."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from sightline.cli.base import Distances, Invert, Output, WireKey, command, commands
from sightline.cli.plan import both_or_none, image_numbers, images_of
from sightline.common.checks import failed

if TYPE_CHECKING:
    from sightline.case.contents import CheckRequest, DrillShotRequest
    from sightline.case.journal import Case, Entry
    from sightline.case.picks import Picks
    from sightline.case.replay import Recomputed
    from sightline.common.checks import Check
    from sightline.frame import Frame
    from sightline.planning.bone.registered import RegisteredBone
    from sightline.planning.check.result import CheckShot
    from sightline.planning.check.wires import Landmarks


@dataclass(frozen=True)
class FoundAgain:
    """What was found again in the images, and tells how the bone moved since the plan."""

    picks: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="JSON file of landmarks found again (docs/check-shot.md). Three show how the bone moved.",
            show_default=False,
        ),
    ] = None
    bone: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="bone-pose.json of `register-bone` in these images, of a plan with --bone: it shows how the bone "
            "moved without landmarks.",
            show_default=False,
        ),
    ] = None

    def read(self) -> "tuple[Picks, RegisteredBone | None]":
        """Return the picks, none without a file, and the bone. Raises UnusableInputError."""
        from sightline.case.picks import Picks
        from sightline.case.saved import load
        from sightline.planning.bone.registered import RegisteredBone

        picks = Picks() if self.picks is None else Picks.read(self.picks)
        return picks, None if self.bone is None else load(self.bone, RegisteredBone)


@command(
    commands,
    "check-shot",
    "sightline check-shot check_pa.dcm check_lateral.dcm --case out/case \\",
    "  --picks found.json",
    "sightline check-shot check_pa.dcm check_lateral.dcm --case out/case \\",
    "  --bone out/check-bone/bone-pose.json",
)
def check_shot(
    output: Output,
    *,
    pa: Annotated[
        Path | None, typer.Argument(help="PA image with the wire. Default: the newest of the case since the plan.")
    ] = None,
    lateral: Annotated[Path | None, typer.Argument(help="Lateral image with the wire.")] = None,
    case: Annotated[Path, typer.Option(help="Folder of the case with the plan, made by `plan --case` or the app.")],
    found: FoundAgain,
    wire: WireKey = None,
    distances: Distances,
    invert: Invert = False,
) -> None:
    """Measure the inserted wire against its plan.

    The wire is found in two more images of the same views and compared with the last plan of the case, in which the
    result is recorded. Exit code 3 if a check fails or the wire is not found.
    """
    files = both_or_none(pa, lateral)
    from sightline.case.journal import Case, Kind
    from sightline.case.replay import Recomputed
    from sightline.case.stages import frame_of
    from sightline.errors import CaseError

    with Case.open(case) as opened:
        again, entry = Recomputed(opened), opened.latest(Kind.PLANNED)
        if entry is None:
            raise CaseError("the case holds no plan; make one with `sightline plan --case`")
        entry = _of_wire(entry, again.of_all_wires(entry), wire)
        given, bone = found.read()
        frame = frame_of(opened, opened.entry(entry.rests_on[0]).settings["frame"])
        known = {"source_detector_mm": distances.sid, "pixel_mm": distances.pixel}
        taken = NewImages(files, frame, given.mirrored, known, entry.number, invert)
        output.result(*measure_check(output, (opened, again, entry), given, taken, bone))


@dataclass(frozen=True, eq=False)
class NewImages:
    """Two more images of a plan's views: their `files`, or None for the newest of the case after entry `after`.

    `mirrored`: names of the views that are displayed mirrored; `known`: what is known of the C-arm, as arguments of
    `calibrate_pair`.
    """

    files: tuple[Path, ...] | None
    frame: "Frame"
    mirrored: Sequence[str]
    known: Mapping[str, float | None]
    after: int
    invert: bool = False


def measure_check(
    output: Output,
    of: "tuple[Case, Recomputed, Entry]",
    picks: "Picks",
    new: NewImages,
    bone: "RegisteredBone | None" = None,
) -> "tuple[dict[str, Any], tuple[Check, ...]]":
    """Measure, record and print a check shot; return its document, and its checks with the relations between wires.

    `bone`: registered in these images. `of`, and what is raised: as of `measure_shot`.
    """
    from sightline.case.contents import CheckRequest
    from sightline.case.picks import CHECK_NAMES
    from sightline.case.stages import record_verified

    case, again, plan = of
    landmarks = landmarks_of(picks, plan)
    with output.step("computing the plan again"):
        made = again.plan(plan)
    request = CheckRequest(made.kind.wire_mm, landmarks, bone)
    shot, views, kept = measure_shot(output, of, request, new, record_verified)
    _show(output, shot)
    relations = _relations(output, again, plan)
    output.say(f"case {case.number}: the check shot is entry {kept.number}, against the plan of entry {plan.number}")
    numbers = {"number": case.number, "plan": plan.number, "entry": kept.number}
    numbers |= {"images": image_numbers(case, views, CHECK_NAMES)}
    document = {key: value for key, value in shot.document().items() if key != "checks"}
    return {**document, "case": numbers}, (*shot.checks, *relations)


def measure_shot(
    output: Output,
    of: "tuple[Case, Recomputed, Entry]",
    request: "CheckRequest | DrillShotRequest",
    new: NewImages,
    record: "Callable[..., Entry]",
) -> "tuple[Any, tuple[Entry, ...], Entry]":
    """Calibrate two more images and measure the wire in them. `of`: the case, its results, and the entry of the plan.

    Return the shot, the entries of both views, and its own. `record`: of `case.stages`; a refusal is recorded, too.
    Raises what reading, labelling, calibrating and measuring raise.
    """
    from sightline.case.journal import Actor
    from sightline.case.stages import record_images
    from sightline.case.views import NAMES, calibrate_pair
    from sightline.errors import RefusedError

    case, again, plan = of
    with output.step("finding and labelling the beads"):
        seen = images_of(output, case, new.files, new.frame, NAMES, invert=new.invert, after=new.after)
    with output.step("calibrating both views (smooth)"):
        images = calibrate_pair(seen.seen, new.frame, "smooth", new.mirrored, **new.known)
    views = record_images(case, seen, images, new.frame, by=Actor.COMMAND)
    try:
        with output.step("finding the wire"):
            shot = request.shot(again.plan(plan), again.images(plan), images, again.others_mm(plan))
    except RefusedError as refusal:
        record(case, plan, views, request, str(refusal), by=Actor.COMMAND)
        raise
    return shot, views, record(case, plan, views, request, shot, by=Actor.COMMAND)


def _relations(output: Output, again: "Recomputed", plan: "Entry") -> "tuple[Check, ...]":
    """Return the relations between the wires that were measured, and print all of them; none of a wire alone."""
    from sightline.planning.wires import judge_measured

    plans = again.wires(plan)
    if plans is None:
        return ()
    with output.step("comparing the wires that were measured"):
        measured = judge_measured(plans, again.measured(plan), again.plan(plan).side)
    for check in measured.checks:
        output.say(f"{check.name}, as measured: {check.sentence}")
    return tuple(relation for relation in measured.checks if not relation.missing)


def _of_wire(last: "Entry", of_all: "dict[str, Entry]", wire: str | None) -> "Entry":
    """Return the entry of the wire's plan, of the last plans. Raises UnusableInputError."""
    from sightline.errors import UnusableInputError

    if not of_all and wire is None:
        return last
    if wire not in of_all:
        known = ", ".join(of_all) or "none: it is the plan of one wire"
        raise UnusableInputError(f"name the wire that was drilled with --wire; the plan's are {known}")
    return of_all[wire]


def landmarks_of(picks: "Picks", plan: "Entry") -> "Landmarks":
    """Return landmarks found again, of the first two views of the plan of an entry. Raises UnusableInputError."""
    import numpy as np

    from sightline.case.picks import CHECK_NAMES
    from sightline.case.views import NAMES
    from sightline.errors import UnusableInputError
    from sightline.planning.check.wires import Landmarks

    names, planned = (plan.content["asked"][key] for key in ("landmark_names", "landmarks_uv_px"))
    before = np.array([[], []] if planned is None else planned[:2], dtype=np.float64).reshape(2, -1, 2)
    known = {name: before[:, k] for k, name in enumerate(names) if name and np.isfinite(before[:, k]).all()}
    again = [mark for mark in picks.landmarks if mark.check_pa is not None]
    for mark in again:
        if mark.pa is None and mark.name not in known:
            raise UnusableInputError(
                f"the plan has no landmark {mark.name!r}; it has {', '.join(known) or 'none with a name'}. Add where "
                "the point lies in the planning images: pa and lateral"
            )
    given = [known[mark.name] if mark.pa is None else mark.uv_px(NAMES) for mark in again]
    again_px = [mark.uv_px(CHECK_NAMES) for mark in again]
    planned_px, checked_px = (np.reshape(uv_px, (-1, 2, 2)).swapaxes(0, 1) for uv_px in (given, again_px))
    return Landmarks(planned_px, checked_px, picks.pick_sd_px)


def _show(output: Output, shot: "CheckShot") -> None:
    """Print the check shot for people: the verdict and what failed first, then where the wire is."""
    bad = failed(shot.checks)
    output.say(
        f"NOT CONFIRMED: {len(bad)} checks of the wire failed:"
        if bad
        else "CONFIRMED: the wire is where it was planned, within the limits; a person decides"
    )
    output.failures(shot.checks)
    document = shot.document()
    off, error = document["deviation"], document["error_95"]
    rows = [
        ("entry, across the plan", f"{off['entry_mm']:.2f} mm", f"{error['entry_mm']:.2f} mm"),
        ("tip, in all directions", f"{off['tip_mm']:.2f} mm", f"{error['tip_mm']:.2f} mm"),
        ("tip, along the plan (+ too deep)", f"{off['tip_along_mm']:+.2f} mm", None),
        ("direction", f"{off['direction_deg']:.2f}°", f"{error['direction_deg']:.2f}°"),
    ]
    output.table("Wire against the plan", ("of", "deviation", "95 % error"), rows)
