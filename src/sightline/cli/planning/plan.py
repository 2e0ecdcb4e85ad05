"""`sightline plan`: from two or three images and their picks to a trajectory, its error, and GO or NO-GO."""

from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from itertools import chain
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sightline.cli.options import Distances, Side, command, commands
from sightline.cli.output import Output
from sightline.cli.planning.images import PlanImages
from sightline.cli.planning.results import planned_document, reports, show, write

if TYPE_CHECKING:
    import numpy as np

    from sightline.calibration import CalibratedView
    from sightline.case.picks import Picks

Point = dict[str, tuple[float, ...]]
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
        str,
        typer.Option(
            "--procedure",
            "--kind",
            help="Procedure: a key of `sightline procedure list`, or a file (docs/procedures.md); of several wires "
            "KEY, or KEY:WIRE for one of them alone. Sets what is needed, checks and limits.",
        ),
    ] = "hip-screw"
    side: Annotated[
        Side | None, typer.Option(help="Side of the patient, as both images show it.", show_default=False)
    ] = None

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
            raise UnusableInputError("give --entry and --end together")
        if points and (picks.wires or picks.nail is not None):
            raise UnusableInputError("the file of picks holds wires, or a nail; leave --entry and --end out")
        procedure = current_key(self.procedure) if points else self.procedure
        if points and len(wires_of(procedure)) > 1:
            raise UnusableInputError(
                f"{self.procedure} has several wires: give entry and end of each in --picks, or plan one of them alone "
                f"with --procedure {self.procedure}:WIRE"
            )
        if points and self.propose:
            raise UnusableInputError("--entry and --end give the wire; leave --propose out")
        if not points:
            refuse_unusable(picks, self.procedure, propose=self.propose)
        return picks, points, procedure


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
        from sightline.case.stages import record_plans
        from sightline.case.views import calibrate_images

        taken = images.taken(output, stack, picks)
        with output.step(f"calibrating the views ({images.method})"):
            known = {"source_detector_mm": distances.sid, "pixel_mm": distances.pixel}
            calibrated = calibrate_images(taken.seen.seen, taken.frame, images.method, picks.mirrored, **known)
        with output.step("planning"):
            if points:
                picks = _with_wire(picks, wires_of(procedure)[0], points, [image.view for image in calibrated])
            asked = ask_plan(picks, calibrated, procedure, wires.side, propose=wires.propose)
            together = asked.request.others is not None
            planned = asked.request.plan_wires(calibrated) if together else asked.request.plan(calibrated)
        document = {**planned_document(planned, calibrated, taken.frame), **asked.unfitted}
        if images.case is not None:
            case = taken.case or stack.enter_context(Case.create(images.case, exist_ok=True))  # now that it has a plan
            entries, numbers = taken.record(case, calibrated)
            recorded = record_plans(case, entries, asked.request, planned, by=Actor.COMMAND)
            document["case"] = {"number": case.number, **recorded, "images": numbers}
        if out is not None:
            with output.step("writing the report"):
                pages = reports(planned, calibrated, taken.frame, asked)
                document["files"] = write(out, planned, pages, document, asked.picks)
        show(output, planned, document, [*chain.from_iterable(asked.unfitted.values()), *asked.proposals])
        output.result(document, planned.verdict.checks)


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
