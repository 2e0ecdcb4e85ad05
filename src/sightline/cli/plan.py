"""`sightline plan`: from two or three images and their picks to a trajectory, its error, and GO or NO-GO."""

from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from itertools import chain
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from sightline.cli.base import Distances, Invert, Method, Output, Side, command, commands, frame_of_images
from sightline.common.checks import failed

if TYPE_CHECKING:
    import numpy as np

    from sightline.calibration import CalibratedView
    from sightline.case.contents import Images
    from sightline.case.journal import Case, Entry
    from sightline.case.picks import AskedPlan, Picks
    from sightline.case.report.content import Report
    from sightline.case.stages import SeenImages
    from sightline.frame import Frame
    from sightline.planning import Plan, WirePlans

Point = dict[str, tuple[float, ...]]
_ASSUMED = "hip-screw"  # the procedure where none is named
_POINTS = ({"pa": 2, "lateral": 2}, {"pa": 2, "depth": 1})  # how many numbers each name has, in either way to write


@dataclass(frozen=True)
class Wires:
    """The wires to be planned."""

    entry: Annotated[
        str | None,
        typer.Option(
            help="Entry point, in pixels: 'pa:U,V lateral:U,V'. Instead of the lateral pixel, 'depth:MM' is a point on "
            "the image-matching curve, in mm from the PA plate towards the X-ray source.",
            show_default=False,
        ),
    ] = None
    end: Annotated[
        str | None,
        typer.Option(help="End point, the tip of the wire; written like the entry point.", show_default=False),
    ] = None
    picks: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="JSON file of all else that is picked or drawn: aids, landmarks, several wires, wires in the bone, "
            "the holes of a nail, points in a third image (docs/planning.md, docs/schemas/picks.schema.json).",
            show_default=False,
        ),
    ] = None
    propose: Annotated[
        bool,
        typer.Option(
            "--propose",
            help="Propose the wires that are not picked by the procedure's rule, from the drawn aids, and plan them. A "
            "person must look at the proposal in both images.",
        ),
    ] = False
    procedure: Annotated[
        str | None,
        typer.Option(
            help="What the wire is for: a key of `sightline procedure list`, or a file (docs/procedures.md); of "
            "several wires KEY, or KEY:WIRE for one of them alone. Sets what is needed, checks and limits.",
            show_default=_ASSUMED,
        ),
    ] = None
    side: Annotated[
        Side | None, typer.Option(help="Side of the patient, as both images show it.", show_default=False)
    ] = None

    @property
    def named(self) -> str:
        """The procedure, as given or assumed."""
        return self.procedure or _ASSUMED

    def read(self) -> "tuple[Picks, list[Point], str]":
        """Return the picks of the file, none without one, entry and end as typed, if they are, and the procedure.

        Raises UnusableInputError, also for a wire that is typed where the file or the procedure has several.
        """
        from sightline.case.picks import Picks, refuse_unusable, wires_of
        from sightline.errors import UnusableInputError
        from sightline.planning.procedures.procedure import current_key

        picks = Picks() if self.picks is None else Picks.read(self.picks)
        typed = {"--entry": self.entry, "--end": self.end}
        points = [parse_point(text, option) for option, text in typed.items() if text is not None]
        if len(points) == 1:
            (missing,) = (option for option, text in typed.items() if text is None)
            raise UnusableInputError(f"{missing} is missing: a wire has an entry and an end; give both, written alike")
        if points and (picks.wires or picks.nail is not None):
            raise UnusableInputError("the file of picks holds wires, or a nail; leave --entry and --end out")
        procedure = current_key(self.named) if points else self.named
        if points and len(wires_of(procedure)) > 1:
            raise UnusableInputError(
                f"{self.named} has several wires: give entry and end of each in --picks, or plan one of them alone "
                f"with --procedure {self.named}:WIRE"
            )
        if points and self.propose:
            raise UnusableInputError("--entry and --end give the wire; leave --propose out")
        if not points:
            refuse_unusable(picks, self.named, propose=self.propose)
        return picks, points, procedure


def parse_point(text: str, option: str) -> Point:
    """Return the numbers of 'pa:U,V lateral:U,V' or 'pa:U,V depth:MM' by name.

    The depth, mm, is counted along the line of sight from the PA view's XRII plate towards the X-ray source.
    Raises UnusableInputError.
    """
    from sightline.errors import UnusableInputError

    try:
        parts = [part.split(":") for part in text.split()]
        point = {name: tuple(map(float, numbers.split(","))) for name, numbers in parts}
    except ValueError:
        point, parts = {}, []
    lengths = {name: len(numbers) for name, numbers in point.items()}
    finite = all(isfinite(number) for numbers in point.values() for number in numbers)
    if lengths not in _POINTS or len(parts) > len(point) or not finite:
        raise UnusableInputError(
            f"{option} {text!r} is not a point; write 'pa:U,V lateral:U,V' in pixels (for example "
            "'pa:512.3,401.8 lateral:498.0,377.2'), or 'pa:U,V depth:MM'; all else is given in --picks FILE"
        )
    return point


def _with_wire(picks: "Picks", key: str, points: Sequence[Point], views: "Sequence[CalibratedView]") -> "Picks":
    """Return the picks with the wire between two typed points; those with a depth are snapped to their curves."""
    from sightline.case.picks import PickedWire
    from sightline.planning import WirePicks

    entry, end = (_pixels(point, views, picks.pick_sd_px) for point in points)
    wire = PickedWire.of(WirePicks(entry, end, ["depth" in point for point in points]))
    return picks.model_copy(update={"wires": {key: wire}})


def _pixels(point: Point, views: "Sequence[CalibratedView]", pick_sd_px: float) -> "np.ndarray":
    """Return the pixels (2, 2) of a point in PA and lateral.

    A depth (`MatchingCurve.depth_mm`) is replaced by the lateral pixel of the image-matching curve at that depth.
    Raises UnusableInputError for a depth outside the curve, and what `matching_curve` raises.
    """
    import numpy as np

    from sightline.errors import UnusableInputError
    from sightline.planning import Pick, matching_curve

    if "lateral" in point:
        return np.array([point["pa"], point["lateral"]])
    pick = Pick.free(point["pa"], pick_sd_px)
    curve = matching_curve(views[0], pick.uv_px, views[1], pick.covariance_px2)
    depth, (low, high) = point["depth"][0], (curve.depth_mm[0], curve.depth_mm[-1])
    if not low <= depth <= high:
        raise UnusableInputError(
            f"give a depth from {low:.0f} to {high:.0f} mm, counted from the PA view's XRII plate towards the X-ray "
            f"source; {depth:g} mm is outside the lateral view"
        )
    return np.array([point["pa"], [np.interp(depth, curve.depth_mm, curve.uv_px[:, k]) for k in range(2)]])


SAID = {
    "go": "GO: every check passed; a person decides",
    "no-go": "NO-GO: {} failed. Do what the sentences say, then plan again:",
    "incomplete": "INCOMPLETE: {} could not be made. Give what the sentences ask for:",
}


def each_of(planned: "Plan | WirePlans") -> "Mapping[str, Plan]":
    """Return the plans by wire, in the order of drilling; "" for that of a wire alone."""
    from sightline.planning import Plan

    return {"": planned} if isinstance(planned, Plan) else planned.plans


def plan_document(planned: "Plan", images: "Images") -> dict[str, Any]:
    """Return the plan of a wire as JSON types."""
    from sightline.case.views import view_document

    return {**planned.document(), "views": [view_document(image) for image in images]}


def planned_document(planned: "Plan | WirePlans", images: "Images", frame: "Frame") -> dict[str, Any]:
    """Return the plan of a wire, or of several with their proposed order of drilling, as JSON types."""
    from sightline.case.interop.plan_file import of_wires
    from sightline.from_images.pipeline import propose_order
    from sightline.planning import Plan

    documents = {key: plan_document(plan, images) for key, plan in each_of(planned).items()}
    if isinstance(planned, Plan):
        return documents[""]
    views = [image.view for image in images]
    order = propose_order(planned.lines, planned.procedure, views, frame, planned.placed)
    names = {wire.key: wire.name for wire in planned.procedure.wires}
    return of_wires(planned.document(), documents) | {
        "drilling_order": {**vars(order), "sentence": order.sentence(names)}
    }


def show(
    output: Output,
    planned: "Plan | WirePlans",
    document: dict[str, Any],
    remarks: Sequence[str] = (),
    first: Sequence[str] = (),
) -> None:
    """Print the plan for people: verdict and what failed, relations, trajectories, and where it is kept (`document`).

    `remarks`: sentences on proposed wires and on aids that were not fitted; `first`: after what failed.

    Where a gap contradicts the stated error, no error is shown beside the coordinates.
    """
    from sightline.common.show import counted

    verdict, plans = planned.verdict, each_of(planned)
    output.say(SAID[verdict.state].format(counted(len(failed(verdict.checks)), "check")))
    output.failures(verdict.checks)
    for sentence in first:
        output.say(sentence)
    for plan in plans.values():
        _say_beside_verdict(output, plan, "" if "" in plans else f"{plan.kind.wire.name}: ")
    for check in (relation for relation in planned.relations if relation.passed):
        output.say(f"{check.name}: {check.sentence}")
    for sentence in remarks:
        output.say(sentence)
    rows = [row for plan in plans.values() for row in _rows(plan, alone="" in plans)]
    output.table("Trajectory in CFCS, mm (no robot is known)", ("point", "x", "y", "z", "95 % error"), rows)
    sentences_of = {key: _sentences(plan) for key, plan in plans.items()}
    own, *rest = sentences_of.values()
    common = [sentence for sentence in own if all(sentence in others for others in rest)]
    for key, sentences in sentences_of.items():
        for sentence in sentences:
            if sentence not in common:
                output.say(f"{plans[key].kind.wire.name}: {sentence}")
    for sentence in common:
        output.say(sentence)
    if "drilling_order" in document:
        output.say(document["drilling_order"]["sentence"])
    if "case" in document:
        number, entries = document["case"]["number"], document["case"].get("entries", {})
        for wire, entry in (entries or {"": document["case"].get("entry")}).items():
            output.say(f"case {number}: the plan{f' of the wire {wire}' if wire else ''} is entry {entry}")
    output.written(document.get("files", ()))


def _other_procedures(planned: "Plan | WirePlans") -> list[str]:
    """Return what else the images may be of, for an assumed procedure that asks for what was not given."""
    from sightline.planning.procedures.procedure import shipped

    if planned.verdict.state != "incomplete":
        return []
    others = "; ".join(f"{key} ({document.name})" for key, document in shipped().items() if key != _ASSUMED)
    return [
        f"All this is asked of a hip screw, which was assumed. For another wire add --procedure KEY: {others}. A free "
        "wire is not checked against the bone."
    ]


def _say_beside_verdict(output: Output, planned: "Plan", wire: str) -> None:
    """Print what belongs beside the verdict: errors that no check notices, and the tip-apex distance with its error."""
    from sightline.common.checks import CheckCode

    if planned.unnoticed:
        output.say(wire + planned.unnoticed)
    for check in planned.verdict.checks:
        if check.code is CheckCode.TIP_APEX_DISTANCE and check.passed:
            output.say(wire + check.sentence)


def _rows(planned: "Plan", *, alone: bool) -> list[tuple[str | None, ...]]:
    path, errors = planned.trajectory, planned.trajectory.document()["error_95"] or {}
    wire = "" if alone else f"{planned.kind.wire.name}, "
    return [
        (
            wire + _called(key, point.name),
            *(f"{v:.2f}" for v in xyz),
            f"{errors[f'{key}_mm']:.2f}" if errors else None,
        )
        for key, point, xyz in zip(("entry", "end"), planned.kind.points, path.points.xyz_mm, strict=True)
    ]


def _sentences(planned: "Plan") -> list[str]:
    """Return length and direction of the wire, and what else a reader must know."""
    path = planned.trajectory
    errors = path.document()["error_95"] or {}
    direction = f"{errors['direction_deg']:.2f}°" if errors else "not stated"
    sentences = [f"wire from entry to end {path.length_mm:.1f} mm, 95 % error of its direction {direction}"]
    if not errors:
        contradicted = "the gap of a point contradicts it" if path.points.gap_failed.any() else "a view's is unknown"
        sentences.append(f"No error is stated: {contradicted}.")
    return [*sentences, *planned.sentences()]


def _called(key: str, name: str) -> str:
    """Return "entry" or "end", with the name that the procedure gives the point, if it has one."""
    return key if name == f"{key} point" else f"{key} ({name})"


def reports(
    planned: "Plan | WirePlans", images: "Images", frame: "Frame", asked: "AskedPlan"
) -> "Mapping[str, Report]":
    """Return the report of each wire's plan, by wire; "" for that of a wire alone."""
    from sightline.case.report.content import PLANNING, Report, exposures_of_images
    from sightline.planning import Plan

    plans = each_of(planned)
    exposed = exposures_of_images(images, PLANNING, next(iter(plans.values())).kind)
    wires = None if isinstance(planned, Plan) else planned
    picks = {"picks": "; ".join([*asked.proposals, f"all in picks.json, with {asked.picks.pick_sd_px:g} px s.d."])}
    return {
        key: Report("Planned guide wire", frame, images, plan, exposed, picks, wires=wires)
        for key, plan in plans.items()
    }


def write(
    folder: Path,
    planned: "Plan | WirePlans",
    made: "Mapping[str, Report]",
    document: dict[str, Any],
    picks: "Picks",
) -> list[Path]:
    """Write the reports, plan.json, picks.json and the undistorted images; return the files."""
    from sightline.case.interop.plan_file import bundle, of_wires, sealed
    from sightline.case.report.page import render
    from sightline.cli.base import as_json
    from sightline.common.atomic import write_folder

    plans, files = {}, {}
    for key, report in made.items():
        taken, files = bundle(report.plan, report.images, report.frame)
        own = document["wires"][key] if key else document
        plans[key] = {**own, **taken}
    whole = plans[""] if "" in plans else of_wires({**document, "checks": planned.verdict.checks}, plans)
    pages = {f"report{f'-{key}' if key else ''}.html": render(report).encode() for key, report in made.items()}
    texts = {"plan.json": as_json(sealed(whole)), "picks.json": picks.text}
    return write_folder(folder, {**pages, **{name: text.encode() for name, text in texts.items()}, **files})


@dataclass(frozen=True)
class PlanImages:
    """The images of a plan."""

    pa: Annotated[
        Path | None, typer.Argument(help="PA image, or observations as CSV. May be left out with --case.")
    ] = None
    lateral: Annotated[
        Path | None, typer.Argument(help="Lateral image, or observations as CSV (may be the same file).")
    ] = None
    oblique: Annotated[
        Path | None,
        typer.Argument(
            help="A third image, taken last, from between the others: it shows movements of the patient that no pair "
            "shows. Needs a block, and two landmarks or more picked in all images.",
            show_default=False,
        ),
    ] = None
    case: Annotated[
        Path | None,
        typer.Option(
            help="Folder of a case: record images and plan in it. Without images, plan on its newest PA and lateral "
            "image, and on its newest oblique one where picks name it.",
            show_default=False,
        ),
    ] = None
    frame: Annotated[
        str | None,
        typer.Option(
            help="A frame file, gamma, biplane, stereo or block60.", show_default="gamma, or that of the case"
        ),
    ] = None
    method: Method = "smooth"
    invert: Invert = False

    def taken(self, output: Output, stack: ExitStack, picks: "Picks") -> "PlanningImages":
        """Return the images with their beads, read or taken from the case, which is open until the stack ends.

        Raises BadParameter for a missing image, CaseError, and what reading and labelling raise.
        """
        from sightline.case.journal import Case
        from sightline.case.stages import frame_in_use, frame_of
        from sightline.case.views import ALL_NAMES, NAMES

        files = both_or_none(self.pa, self.lateral)
        if files is None and self.case is None:
            raise typer.BadParameter("give the PA and the lateral image, or --case", param_hint="PA LATERAL")
        if files is not None and self.oblique is not None:
            files = (*files, self.oblique)
        if files is not None and picks.in_oblique and self.oblique is None:
            raise typer.BadParameter("points are picked in an oblique image; give its file", param_hint="OBLIQUE")
        names = ALL_NAMES if self.oblique is not None or picks.in_oblique else NAMES
        case = None
        if self.case is not None and (files is None or Case.exists(self.case)):
            case = stack.enter_context(Case.open(self.case))
        in_use = None if case is None or self.frame is not None else frame_in_use(case)
        known = None if case is None or in_use is None else frame_of(case, in_use)
        frame = frame_of_images(output, self.frame) if known is None else known
        if known is not None:
            output.say(f"frame: {known.name} (that of the case)")
        with output.step("finding and labelling the beads"):
            return PlanningImages(case, frame, names, images_of(output, case, files, frame, names, invert=self.invert))


@dataclass(frozen=True, eq=False)
class PlanningImages:
    """The images of the views `names` before calibration, their frame, and the case, None where there is none yet."""

    case: "Case | None"
    frame: "Frame"
    names: Sequence[str]
    seen: "SeenImages"

    def record(self, case: "Case", images: "Images") -> "tuple[tuple[Entry, ...], dict[str, int]]":
        """Record the calibrated images in a case; return their entries, and the numbers of those that acquired them."""
        from sightline.case.journal import Actor
        from sightline.case.stages import record_images

        entries = record_images(case, self.seen, images, self.frame, by=Actor.COMMAND)
        return entries, image_numbers(case, entries, self.names)


RegisteredBoneFile = Annotated[
    Path | None,
    typer.Option(
        "--bone",
        metavar="FILE",
        help="bone-pose.json of `register-bone` in these images: its checks, such as a movement between the images, "
        "enter the verdict.",
        show_default=False,
    ),
]


def both_or_none(pa: Path | None, lateral: Path | None) -> tuple[Path, ...] | None:
    """Return the files of both views; None where neither is given. Raises BadParameter where one is missing."""
    if pa is not None and lateral is not None:
        return pa, lateral
    if pa is not None:
        raise typer.BadParameter("the lateral image is missing; give both images", param_hint="LATERAL")
    return None


def images_of(
    output: Output,
    case: "Case | None",
    files: tuple[Path, ...] | None,
    frame: "Frame",
    names: Sequence[str],
    *,
    invert: bool = False,
    after: int = 0,
) -> "SeenImages":
    """Return the images of the files, or the newest of these views in the case after entry `after`; say which were
    skipped.

    Raises what `given_images` and `newest_images` raise.
    """
    from sightline.case.stages import given_images, newest_images

    if files is not None:
        return given_images(files, frame, invert=invert)
    assert case is not None  # noqa: S101 - without files there is a case
    seen = newest_images(case, frame, names, after=after, invert=invert)
    for line in seen.skipped:
        output.note(line)
    return seen


def image_numbers(case: "Case", entries: "Sequence[Entry]", names: Sequence[str]) -> dict[str, int]:
    """Return the numbers of the entries that acquired the images of calibrated views, by name."""
    from sightline.case.stages import acquired_of

    return {name: acquired_of(case, entry).number for name, entry in zip(names, entries, strict=True)}


@command(
    commands,
    "plan",
    "sightline plan out/demo/demo_pa.dcm out/demo/demo_lateral.dcm \\",
    "  --procedure free-wire --entry 'pa:161.8,689.3 lateral:683.9,692.2' \\",
    "  --end 'pa:818.0,366.3 lateral:377.8,275.7' --out out/plan",
)
def plan(
    output: Output,
    *,
    images: PlanImages,
    wires: Wires,
    distances: Distances,
    bone: RegisteredBoneFile = None,
    out: Annotated[
        Path | None, typer.Option(help="Folder for report, plan.json, picks.json and undistorted images.")
    ] = None,
) -> None:
    """Plan one wire or several on two images, or on three.

    Gives each trajectory, its 95 % error bounds and the verdict: GO, or NO-GO or INCOMPLETE (exit code 3). Of several
    wires the relations between them are checked too.
    """
    with ExitStack() as stack:
        picks, points, procedure = wires.read()
        from sightline.case.journal import Actor, Case
        from sightline.case.picks import ask_plan, wires_of
        from sightline.case.saved import load
        from sightline.case.stages import record_plans
        from sightline.case.views import calibrate_images
        from sightline.planning.bone.registered import RegisteredBone

        registered = None if bone is None else load(bone, RegisteredBone)
        taken = images.taken(output, stack, picks)
        output.say(f"procedure: {procedure}" + ("" if wires.procedure else " (assumed; --procedure names another)"))
        with output.step(f"calibrating the views ({images.method})"):
            known = {"source_detector_mm": distances.sid, "pixel_mm": distances.pixel}
            calibrated = calibrate_images(taken.seen.seen, taken.frame, images.method, picks.mirrored, **known)
        with output.step("planning"):
            if points:
                picks = _with_wire(picks, wires_of(procedure)[0], points, [image.view for image in calibrated])
            asked = ask_plan(picks, calibrated, procedure, wires.side, propose=wires.propose)
            request = replace(asked.request, bone=registered)
            together = request.others is not None
            planned = request.plan_wires(calibrated) if together else request.plan(calibrated)
        document = {**planned_document(planned, calibrated, taken.frame), **asked.unfitted}
        if images.case is not None:
            case = taken.case or stack.enter_context(Case.create(images.case, exist_ok=True))  # now that it has a plan
            entries, numbers = taken.record(case, calibrated)
            recorded = record_plans(case, entries, request, planned, by=Actor.COMMAND)
            document["case"] = {"number": case.number, **recorded, "images": numbers}
        if out is not None:
            with output.step("writing the report"):
                pages = reports(planned, calibrated, taken.frame, asked)
                document["files"] = write(out, planned, pages, document, asked.picks)
        remarks = [*chain.from_iterable(asked.unfitted.values()), *asked.proposals]
        show(output, planned, document, remarks, [] if wires.procedure else _other_procedures(planned))
        output.result(document, planned.verdict.checks)
