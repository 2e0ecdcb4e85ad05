"""`sightline plan`: two images and four picks to a trajectory, its error, and GO or NO-GO."""

from collections.abc import Sequence
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from sightline.cli.calibrate import PixelSize, Sid
from sightline.cli.detect import Invert
from sightline.cli.output import Json, Output, Quiet, example

if TYPE_CHECKING:
    from sightline.calibration import CalibratedView
    from sightline.case.report.content import Report
    from sightline.case.views import CalibratedImage
    from sightline.planning import Plan

Side = Literal["right", "left"]
KindName = Literal["hip-screw", "interlocking", "free-wire"]
MethodName = Literal["smooth", "localized", "polynomial"]
Mirrored = Annotated[
    list[str] | None,
    typer.Option(help="A view, pa or lateral, whose display you saw to be mirrored (writing in it reads backwards)."),
]
SAID = {
    "go": "GO: every check passed; a person decides",
    "no-go": "NO-GO: see the checks that failed",
    "incomplete": "INCOMPLETE: see the checks that something is missing for",
}
PICK_HELP = (
    "Where the point is, in pixels: 'pa:U,V lateral:U,V'. Instead of the lateral pixel, 'depth:MM' is a place on the "
    "image-matching curve, in mm from the PA plate towards the X-ray source."
)


def register(app: typer.Typer) -> None:
    """Add the command."""
    epilog = example(
        "sightline plan demo_pa.dcm demo_lateral.dcm --kind free-wire --snap \\",
        "  --entry 'pa:161.8,689.3 lateral:683.9,692.2' \\",
        "  --end 'pa:818.0,366.3 lateral:377.8,275.7' --out out/plan",
    )
    app.command("plan", epilog=epilog)(plan)


def plan(
    pa: Annotated[Path, typer.Argument(help="The PA image, or observations as CSV.")],
    lateral: Annotated[Path, typer.Argument(help="The lateral image, or observations as CSV (may be the same file).")],
    *,
    entry: Annotated[str, typer.Option(help=f"Entry point. {PICK_HELP}")],
    end: Annotated[str, typer.Option(help="End point, the tip of the wire; written like the entry point.")],
    landmark: Annotated[
        list[str] | None,
        typer.Option(
            help="A point of the bone that both views show, picked freely: 'NAME pa:U,V lateral:U,V'. Two or more tell "
            "whether the patient moved; snapped picks do not. Names of a hip screw: head-centre, lesser-trochanter, "
            "greater-trochanter; without a name it tells of movement alone.",
            show_default=False,
        ),
    ] = None,
    side: Annotated[
        Side | None, typer.Option(help="Of the patient, as a look at both images shows it.", show_default=False)
    ] = None,
    head: Annotated[
        str | None,
        typer.Option(
            help="Circles over the femoral head, centre and radius in pixels: 'pa:U,V,R lateral:U,V,R'.",
            show_default=False,
        ),
    ] = None,
    kind: Annotated[KindName, typer.Option(help="Of trajectory: what is asked for, and which limits hold.")] = (
        "hip-screw"
    ),
    frame: Annotated[str, typer.Option(help="A frame file, or gamma, biplane, stereo.")] = "gamma",
    method: Annotated[MethodName, typer.Option(help="localized is the paper's.")] = "smooth",
    pick_sd: Annotated[float, typer.Option(help="Standard deviation of a pick, px: 0.5 is a careful click.")] = 0.5,
    mirrored: Mirrored = None,
    sid: Sid = None,
    pixel: PixelSize = None,
    snap: Annotated[
        bool, typer.Option("--snap", help="Take the lateral picks to their image-matching curves.")
    ] = False,
    out: Annotated[Path | None, typer.Option(help="Folder for report, plan.json, undistorted images.")] = None,
    invert: Invert = False,
    json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Plan a wire on two images.

    Gives the trajectory, its 95 % error bounds and the verdict: GO, or NO-GO or INCOMPLETE (exit code 3).
    """
    with Output(json=json, quiet=quiet) as output:
        points = [parse_point(entry, "--entry"), parse_point(end, "--end")]
        names, landmarks = zip(*map(parse_landmark, landmark or []), strict=True) if landmark else ((), ())
        circles = None if head is None else parse_head(head)
        snapped = snap or _all_depths(points)
        import numpy as np

        from sightline.case.views import calibrate_pair, see_pair
        from sightline.frame import Frame
        from sightline.planning import Aids, Circle
        from sightline.planning import kind as kind_of
        from sightline.planning import plan as make_plan

        known_frame = Frame.load(frame)
        with output.step("finding and labelling the beads"):
            seen = see_pair(pa, lateral, known_frame, invert=invert)
        with output.step(f"calibrating both views ({method})"):
            images = calibrate_pair(seen, known_frame, method, mirrored or (), source_detector_mm=sid, pixel_mm=pixel)
        with output.step("planning"):
            views = [image.view for image in images]
            entry_px, end_px = (_pixels(point, views, pick_sd) for point in points)
            drawn = None if circles is None else [Circle.of(np.array(c[:2]), c[2], pick_sd) for c in circles]
            planned = make_plan(
                views,
                entry_px,
                end_px,
                pick_sd_px=pick_sd,
                snapped=snapped,
                landmarks_uv_px=np.reshape(landmarks, (-1, 2, 2)).swapaxes(0, 1),
                landmark_names=names,
                kind=kind_of(kind),
                side=side,
                aids=None if drawn is None else Aids(head=(drawn[0], drawn[1])),
            )
        document = plan_document(planned, images)
        if out is not None:
            from sightline.case.report import exposures
            from sightline.case.report.content import Report

            picks = f"entry {entry}; end {end}; {pick_sd:g} px{', snapped' if snapped else ''}"
            picks += "".join(f"; landmark {text}" for text in landmark or [])
            picks += "" if head is None else f"; head {head}"
            exposed = exposures.of_images(images, exposures.PLANNING)
            report = Report("Planned guide wire", known_frame, images, planned, exposed, {"picks": picks})
            with output.step("writing the report"):
                document["files"] = _write(out, report, document)
        show(output, planned)
        for file in document.get("files", ()):
            output.say(f"written: {file}")
        output.result(document, planned.verdict.checks)


def parse_point(text: str, option: str) -> dict[str, tuple[float, ...]]:
    """'pa:U,V lateral:U,V' or 'pa:U,V depth:MM' as numbers. Raises UnusableInputError."""
    from sightline.errors import UnusableInputError

    out = _numbers(text)
    lengths = {name: len(numbers) for name, numbers in out.items()}
    if lengths not in ({"pa": 2, "lateral": 2}, {"pa": 2, "depth": 1}):
        raise UnusableInputError(
            f"{option} {text!r} is no point; write 'pa:U,V lateral:U,V' in pixels (for example "
            "'pa:512.3,401.8 lateral:498.0,377.2'), or 'pa:U,V depth:MM'"
        )
    return out


def parse_head(text: str) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """'pa:U,V,R lateral:U,V,R' as numbers, a circle (3,) for each view. Raises UnusableInputError."""
    from sightline.errors import UnusableInputError

    found = _numbers(text)
    if {name: len(numbers) for name, numbers in found.items()} != {"pa": 3, "lateral": 3}:
        raise UnusableInputError(
            f"--head {text!r} is not two circles; write centre and radius in pixels, 'pa:U,V,R lateral:U,V,R'"
        )
    return found["pa"], found["lateral"]


def _numbers(text: str) -> dict[str, tuple[float, ...]]:
    """'name:1,2 other:3' as finite numbers by name; empty where it is written otherwise."""
    out: dict[str, tuple[float, ...]] = {}
    try:
        for part in text.split():
            name, numbers = part.split(":")
            if name in out:
                return {}
            out[name] = tuple(float(number) for number in numbers.split(","))
    except ValueError:
        return {}
    return out if all(isfinite(number) for numbers in out.values() for number in numbers) else {}


def parse_landmark(text: str) -> tuple[str, list[tuple[float, ...]]]:
    """'NAME pa:U,V lateral:U,V': the name, "" without one, and the pixels in both views. Raises UnusableInputError."""
    from sightline.errors import UnusableInputError

    words = text.split()
    name = "-".join(word for word in words if ":" not in word)
    point = parse_point(" ".join(word for word in words if ":" in word), "--landmark")
    if "depth" in point:
        raise UnusableInputError(
            f"--landmark {text!r} states a depth; a landmark is picked freely in both views: 'pa:U,V lateral:U,V'"
        )
    return name, [point["pa"], point["lateral"]]


def _all_depths(points: list[dict[str, tuple[float, ...]]]) -> bool:
    """True if both points state a depth, False if none does. Raises UnusableInputError on one of each."""
    from sightline.errors import UnusableInputError

    depths = {"depth" in point for point in points}
    if len(depths) == 2:
        raise UnusableInputError("one point states a depth and the other a lateral pixel; write both in one way")
    return depths == {True}


def _pixels(point: dict[str, tuple[float, ...]], views: "Sequence[CalibratedView]", pick_sd: float) -> Any:
    """(2, 2): the picks of one point in both views. A depth becomes the pixel of the curve there."""
    import numpy as np

    from sightline.errors import UnusableInputError
    from sightline.planning import Pick, matching_curve

    first = np.array(point["pa"])
    if "lateral" in point:
        return np.array([first, point["lateral"]])
    pick = Pick.free(first, pick_sd)
    curve = matching_curve(views[0], pick.uv_px, views[1], pick.covariance_px2)
    depth, (low, high) = point["depth"][0], (curve.depth_mm[0], curve.depth_mm[-1])
    if not low <= depth <= high:
        raise UnusableInputError(
            f"the lateral view sees the line of sight from {low:.0f} to {high:.0f} mm of depth, not at {depth:g} mm"
        )
    return np.array([first, [np.interp(depth, curve.depth_mm, curve.uv_px[:, k]) for k in range(2)]])


def plan_document(planned: "Plan", images: "tuple[CalibratedImage, CalibratedImage]") -> dict[str, Any]:
    """The plan as JSON types."""
    from sightline.case.documents import view_document

    return {
        **planned.verdict_document(),
        "trajectory": planned.trajectory.document(),
        "landmarks": planned.landmarks_document(),
        "views": [view_document(image) for image in images],
    }


def show(output: Output, planned: "Plan") -> None:
    """The plan for a person."""
    path = planned.trajectory
    errors = path.document()["error_95"] or {}
    rows = [
        (name, *(f"{v:.2f}" for v in xyz), f"{errors[key]:.2f}" if errors else "unknown")
        for name, key, xyz in (("entry", "entry_mm", path.entry_mm), ("end", "end_mm", path.end_mm))
    ]
    output.table("Trajectory in CFCS, mm (no robot is known)", ("point", "x", "y", "z", "95 % error"), rows)
    direction = f"{errors['direction_deg']:.2f}°" if errors else "unknown"
    output.say(f"wire {path.length_mm:.1f} mm, 95 % error of its direction {direction}")
    for sentence in planned.along_sentences():
        output.say(sentence)
    output.say(SAID[planned.verdict.state])


def _write(folder: Path, report: "Report", document: dict[str, Any]) -> list[Path]:
    from sightline.atomic import write_folder
    from sightline.case.interop.bundle import bundle
    from sightline.case.interop.plan_file import sealed
    from sightline.case.report.page import render
    from sightline.cli.output import as_json

    taken, files = bundle(report.plan, report.images, report.frame)
    plan_json = as_json(sealed({**document, **taken, "checks": report.plan.verdict.checks}))
    return write_folder(folder, {"report.html": render(report).encode(), "plan.json": plan_json.encode(), **files})
