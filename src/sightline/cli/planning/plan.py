"""`sightline plan`: from two or three images and their picks to a trajectory, its error, and GO or NO-GO."""

from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from sightline.cli.calibrate import PixelSize, Sid
from sightline.cli.detect import Invert
from sightline.cli.output import Json, Output, Quiet, example
from sightline.cli.plan_aids import drawn, fitted
from sightline.cli.planning.points import (
    OBLIQUE,
    VIEWS,
    Point,
    all_depths,
    parse_aid,
    parse_head,
    parse_hole,
    parse_landmark,
    parse_nail,
    parse_wires,
    pixels,
)
from sightline.cli.planning.results import planned_document, reports, show, write
from sightline.cli.proposed import wires_to_propose, with_proposals

if TYPE_CHECKING:
    import numpy as np

    from sightline.case.contents import Images
    from sightline.case.journal import Case, Entry
    from sightline.case.pairs import SeenImages
    from sightline.frame import Frame
    from sightline.from_images.interlocking import NailDrawn
    from sightline.planning import PlacedWire, Procedure
    from sightline.planning.procedures.document import ProcedureDocument

Side = Literal["right", "left"]
MethodName = Literal["smooth", "localized", "polynomial"]
Mirrored = Annotated[
    list[str] | None,
    typer.Option(help="View, such as pa, whose image is shown mirrored: writing in it reads backwards."),
]
PICK_HELP = (
    "In pixels: 'pa:U,V lateral:U,V'. Instead of the lateral pixel, 'depth:MM' is a point on the image-matching "
    "curve, in mm from the PA plate towards the X-ray source. With --oblique also 'oblique:U,V', if it shows the point."
)


def register(app: typer.Typer) -> None:
    """Add the command."""
    epilog = example(
        "sightline plan out/demo/demo_pa.dcm out/demo/demo_lateral.dcm \\",
        "  --procedure free-wire --entry 'pa:161.8,689.3 lateral:683.9,692.2' \\",
        "  --end 'pa:818.0,366.3 lateral:377.8,275.7' --out out/plan",
    )
    app.command("plan", epilog=epilog)(plan)


def plan(
    pa: Annotated[
        Path | None, typer.Argument(help="PA image, or observations as CSV. May be left out with --case.")
    ] = None,
    lateral: Annotated[
        Path | None, typer.Argument(help="Lateral image, or observations as CSV (may be the same file).")
    ] = None,
    *,
    entry: Annotated[
        list[str] | None,
        typer.Option(
            help=f"Entry point. {PICK_HELP} To plan several wires together, once for each, the wire's name first: "
            "'inferior pa:U,V lateral:U,V'. Needed, with --end, but for the holes of a nail.",
            show_default=False,
        ),
    ] = None,
    end: Annotated[
        list[str] | None,
        typer.Option(help="End point, the tip of the wire; written like the entry point.", show_default=False),
    ] = None,
    propose: Annotated[
        bool,
        typer.Option(
            "--propose",
            help="Propose the wires without --entry and --end by the procedure's rule, from --aid and --head, and "
            "plan them. A person must look at the proposal in both images.",
        ),
    ] = False,
    oblique: Annotated[
        Path | None,
        typer.Option(
            help="A third image, taken last, from between the others: it shows movements of the patient that no pair "
            "shows. Needs a block, and two landmarks or more picked in all images.",
            show_default=False,
        ),
    ] = None,
    case: Annotated[
        Path | None,
        typer.Option(
            help="Folder of a case: record images and plan in it. Without images, plan on its newest PA and lateral "
            "image, and on its newest oblique one where picks name it.",
            show_default=False,
        ),
    ] = None,
    landmark: Annotated[
        list[str] | None,
        typer.Option(
            help="A point of the bone picked freely in both views: 'NAME pa:U,V lateral:U,V'. Two or more show whether "
            "the patient moved; snapped picks do not. With a third image add 'oblique:U,V'; one of the three may "
            "be left out. Names for a hip screw: head-centre, lesser-trochanter, "
            "greater-trochanter; a landmark without a name shows movement only.",
            show_default=False,
        ),
    ] = None,
    side: Annotated[
        Side | None, typer.Option(help="Side of the patient, as both images show it.", show_default=False)
    ] = None,
    head: Annotated[
        str | None,
        typer.Option(
            help="Circles over the femoral head, centre and radius in pixels: 'pa:U,V,R lateral:U,V,R'.",
            show_default=False,
        ),
    ] = None,
    aid: Annotated[
        list[str] | None,
        typer.Option(
            help="An aid of the procedure, drawn by clicks in pixels: 'KEY pa:U,V,U,V,... lateral:U,V,U,V,...'. May be "
            "given several times. `sightline procedure show` names the aids; docs/procedures.md the clicks.",
            show_default=False,
        ),
    ] = None,
    fit_head: Annotated[
        bool,
        typer.Option(
            "--fit-head",
            help="Fit the circles of the femoral head to the edges in the images, at most 12 px away. A circle without "
            "a clear edge is kept, with the reason.",
        ),
    ] = False,
    fit_shaft: Annotated[
        bool,
        typer.Option(
            "--fit-shaft",
            help="Fit the borders of the shaft, four clicks in each image, to the edges in the images, at most 12 px "
            "away. A line without clear, straight and parallel edges is kept, with the reason.",
        ),
    ] = False,
    fit_neck: Annotated[
        bool,
        typer.Option(
            "--fit-neck",
            help="Fit the neck's axis, from the head's centre, between the edges at most 12 px from its drawn borders, "
            "four clicks in each image. A line is kept where its image does not show the neck, with the reason.",
        ),
    ] = False,
    hole: Annotated[
        list[str] | None,
        typer.Option(
            help="A hole of a nail instead of --entry and --end: the wire's key and one click in the bright lens in "
            "both images, 'distal pa:U,V lateral:U,V'. Its axis is measured in the images. Needs --nail, --nail-edges.",
            show_default=False,
        ),
    ] = None,
    nail: Annotated[
        str | None,
        typer.Option(
            help="The nail as its maker states it, mm: 'diameter:11 hole:5 bore:5 spacing:28 titanium', or steel. Or a "
            "nail's file, or the key of a shipped one: titanium-11 (docs/interlocking.md).",
            show_default=False,
        ),
    ] = None,
    nail_edges: Annotated[
        str | None,
        typer.Option(
            help="Both edges of the nail, each by two clicks that reach past its holes, at most 8 px off: "
            "'pa:U,V,U,V,U,V,U,V lateral:...', one edge first, then the other.",
            show_default=False,
        ),
    ] = None,
    procedure: Annotated[
        str,
        typer.Option(
            "--procedure",
            "--kind",
            help="Procedure: a key of `sightline procedure list`, or a file (docs/procedures.md); of several wires "
            "KEY, or KEY:WIRE for one of them alone. Sets what is needed, checks and limits.",
        ),
    ] = "hip-screw",
    placed: Annotated[
        list[str] | None,
        typer.Option(
            help="Key of a wire that is in the bone already. It is found in both images near its --entry and --end "
            "(the tip), and the others are planned beside it. Name every such wire that the images show. Of a nail: "
            "the key of a hole that is drilled already; its axis is measured from its --hole.",
            show_default=False,
        ),
    ] = None,
    frame: Annotated[
        str | None,
        typer.Option(help="A frame file, gamma, biplane or stereo.", show_default="gamma, or that of the case"),
    ] = None,
    method: Annotated[MethodName, typer.Option(help="Calibration method; localized is the paper's.")] = "smooth",
    pick_sd: Annotated[float, typer.Option(help="Standard deviation of a pick, px; 0.5 is a careful click.")] = 0.5,
    mirrored: Mirrored = None,
    sid: Sid = None,
    pixel: PixelSize = None,
    snap: Annotated[
        bool, typer.Option("--snap", help="Move the lateral picks to their image-matching curves.")
    ] = False,
    out: Annotated[Path | None, typer.Option(help="Folder for report, plan.json and undistorted images.")] = None,
    invert: Invert = False,
    json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Plan one wire or several on two images, or on three.

    Gives each trajectory, its 95 % error bounds and the verdict: GO, or NO-GO or INCOMPLETE (exit code 3). Of several
    wires the relations between them are checked too.
    """
    with Output(json=json, quiet=quiet) as output, ExitStack() as stack:
        drawn_nail = _nail_drawn(nail, nail_edges, hole, placed, picked=[*(entry or ()), *(end or ())])
        wires = parse_wires(entry or [], end or []) if drawn_nail is None else _holes_to_plan(hole or [], placed or ())
        unpicked = () if drawn_nail else wires_to_propose(procedure, wires, propose=propose)
        points = [point for wire in wires.values() for point in wire]
        names, landmarks = zip(*map(parse_landmark, landmark or []), strict=True) if landmark else ((), ())
        views = _views(oblique, [*points, *landmarks], pa)
        aids_drawn = None if head is None else parse_head(head), dict(map(parse_aid, aid or []))
        snapped = snap or all_depths(points)
        files = both_or_none(pa, lateral, oblique)
        if files is None and case is None:
            raise typer.BadParameter("give the PA and the lateral image, or --case", param_hint="PA LATERAL")
        import numpy as np

        from sightline.case.contents import PlanRequest
        from sightline.case.journal import Actor, Case
        from sightline.case.pairs import record_images
        from sightline.case.stages import frame_in_use, frame_of, record_plans
        from sightline.case.views import calibrate_images
        from sightline.frame import Frame
        from sightline.planning import WirePicks
        from sightline.planning.procedures.files import keeping

        first, known = _first_of(procedure, [name for name in (*wires, *unpicked) if name not in (placed or ())])
        opened = None if case is None else case_of(stack, case, files)
        in_use = None if opened is None or frame is not None else frame_in_use(opened)
        known_frame = Frame.load(frame or "gamma") if opened is None or in_use is None else frame_of(opened, in_use)
        with output.step("finding and labelling the beads"):
            taken = images_of(output, opened, files, known_frame, views, invert=invert)
        with output.step(f"calibrating the views ({method})"):
            images = calibrate_images(
                taken.seen, known_frame, method, mirrored or (), source_detector_mm=sid, pixel_mm=pixel
            )
        with output.step("planning"):
            calibrated = [image.view for image in images]
            ends = {name: [pixels(point, calibrated, pick_sd) for point in wire] for name, wire in wires.items()}
            in_bone = _in_bone(() if drawn_nail else placed or (), ends, images, known.document)
            aids, unfitted = fitted(
                drawn(known, *aids_drawn, pick_sd), images, head=fit_head, shaft=fit_shaft, neck=fit_neck
            )
            picked, proposed = with_proposals(
                {name: WirePicks(*at, snapped=snapped) for name, at in ends.items()},
                unpicked,
                known,
                calibrated,
                aids=aids,
                side=side,
            )
            asked = PlanRequest(
                np.asarray(picked[first].entry_uv_px),
                np.asarray(picked[first].end_uv_px),
                pick_sd_px=pick_sd,
                snapped=picked[first].snapped,
                landmarks_uv_px=np.reshape(
                    [[point.get(view, (np.nan, np.nan)) for point in landmarks] for view in views], (len(views), -1, 2)
                ),
                landmark_names=names,
                kind=known.key,
                procedure=keeping(known),
                side=side,
                aids=aids,
                others={name: one for name, one in picked.items() if name != first} if first else None,
                placed=in_bone or None,
                nail=drawn_nail,
            )
            planned = asked.plan_wires(images) if first else asked.plan(images)
        document = planned_document(planned, images, known_frame) | unfitted
        if case is not None:
            opened = opened or stack.enter_context(Case.create(case, exist_ok=True))  # now that there is a plan
            made_on = record_images(opened, taken, images, known_frame, by=Actor.COMMAND)
            document["case"] = {
                "number": opened.number,
                **record_plans(opened, made_on, asked, planned, by=Actor.COMMAND),
                "images": image_numbers(opened, made_on, views),
            }
        if out is not None:
            picks = {"entry": entry, "end": end, "hole": hole, "nail": nail, "nail's edges": nail_edges}
            with output.step("writing the report"):
                pages = reports(
                    planned,
                    images,
                    known_frame,
                    _words(
                        {**picks, "landmark": landmark, "head": head, "aid": aid, "wire": proposed},
                        pick_sd,
                        snapped=snapped,
                    ),
                )
                document["files"] = write(out, planned, pages, document)
        show(output, planned, document, [*(one for said in unfitted.values() for one in said), *proposed])
        output.result(document, planned.verdict.checks)


def _first_of(procedure: str, wires: Sequence[str]) -> "tuple[str, Procedure]":
    """Return the key of the first wire, "" for a wire alone, and its procedure. Raises UnusableInputError."""
    from sightline.planning import Procedure, kind
    from sightline.planning.procedures.files import document_of

    first = next(iter(wires), "")
    return first, Procedure.of(document_of(procedure), first) if first else kind(procedure)


def _words(given: Mapping[str, str | list[str] | None], pick_sd: float, *, snapped: bool) -> str:
    """Return in words what was given."""
    texts = {name: [text] if isinstance(text, str) else text or [] for name, text in given.items()}
    words = [f"{name} {text}" for name, each in texts.items() for text in each]
    return "; ".join([*words, f"{pick_sd:g} px{', snapped' if snapped else ''}"])


def _holes_to_plan(holes: Sequence[str], drilled: Sequence[str]) -> dict[str, tuple[Point, Point]]:
    """Return the click on each hole that is not drilled by its wire's key, in place of entry and end."""
    return {key: (point, point) for key, point in map(parse_hole, holes) if key not in drilled}


def _nail_drawn(
    sizes: str | None,
    edges: str | None,
    holes: Sequence[str] | None,
    drilled: Sequence[str] | None,
    *,
    picked: Sequence[str],
) -> "NailDrawn | None":
    """Return the nail whose holes are to be planned; None where no option of a nail is given.

    Raises UnusableInputError for some of these options without the others, or beside picked points.
    """
    if sizes is None and edges is None and not holes:
        return None
    import numpy as np

    from sightline.errors import UnusableInputError
    from sightline.from_images.interlocking import NailDrawn

    if sizes is None or edges is None or not holes or picked:
        raise UnusableInputError(
            "the holes of a nail are planned from --nail, --nail-edges and --hole, all three, and without --entry and "
            "--end"
        )
    clicks = dict(map(parse_hole, holes))
    if len(clicks) < len(holes) or not set(drilled or ()) < clicks.keys():
        raise UnusableInputError(
            f"--hole is given for {', '.join(clicks)} and --placed for {', '.join(drilled or ()) or 'none'}; give "
            "--hole once for each hole, and --placed for those of them that are drilled, but not for all"
        )
    known, strokes = parse_nail(edges, sizes)
    uv = {key: np.array([point[view] for view in VIEWS]) for key, point in clicks.items()}
    return NailDrawn(known, strokes, uv, tuple(drilled or ()))


def _in_bone(
    keys: Sequence[str], ends: "dict[str, list[np.ndarray]]", images: "Images", procedure: "ProcedureDocument"
) -> "dict[str, PlacedWire]":
    """Return the wires that are in the bone already, found in the images; they are taken out of `ends`.

    Raises UnusableInputError, and what `find_placed_wires` raises.
    """
    import numpy as np

    from sightline.errors import UnusableInputError
    from sightline.from_images.pipeline import find_placed_wires

    if not keys:
        return {}
    each = [(one.seen.image, one.seen.beads, one.view) for one in images]
    seen = [(image, beads, view) for image, beads, view in each if image is not None and beads is not None]
    known = {wire.key: wire.diameter_mm for wire in procedure.wires}
    if not set(keys) < set(ends) or not set(keys) <= set(known):
        raise UnusableInputError(
            f"--placed names {', '.join(keys)}; give --entry and --end of each, with its name, and of a wire to plan; "
            f"the wires are {', '.join(known)}"
        )
    if len(seen) < len(each):
        raise UnusableInputError("a placed wire is found in images; a table of beads shows no wire")
    clicked = {key: np.array(ends.pop(key)).swapaxes(0, 1)[:2] for key in keys}
    return find_placed_wires(seen, clicked, known)


def both_or_none(pa: Path | None, lateral: Path | None, oblique: Path | None = None) -> tuple[Path, ...] | None:
    """Return the files of both views, and of a third where it is given; None where neither of both is given.

    Raises BadParameter where one of both is missing.
    """
    if pa is not None and lateral is not None:
        return (pa, lateral) if oblique is None else (pa, lateral, oblique)
    if pa is not None:
        raise typer.BadParameter("the lateral image is missing; give both images", param_hint="LATERAL")
    return None


def _views(oblique: Path | None, picked: Sequence[Point], pa: Path | None) -> tuple[str, ...]:
    """Return the names of the views to plan on: a third where its image or a pick in it is given.

    Raises BadParameter where one is given without the other images, or picked without its image.
    """
    if oblique is not None and pa is None:
        raise typer.BadParameter("give the PA and the lateral image with it", param_hint="--oblique")
    if all(OBLIQUE not in point for point in picked):
        return VIEWS if oblique is None else (*VIEWS, OBLIQUE)
    if oblique is None and pa is not None:
        raise typer.BadParameter("points are picked in an oblique image; give its file", param_hint="--oblique")
    return (*VIEWS, OBLIQUE)


def case_of(stack: ExitStack, folder: Path, files: tuple[Path, ...] | None) -> "Case | None":
    """Return the case in a folder, open until the stack ends; None where files are given and there is none yet.

    Raises CaseError.
    """
    from sightline.case.journal import Case

    return stack.enter_context(Case.open(folder)) if files is None or Case.exists(folder) else None


def images_of(
    output: Output,
    case: "Case | None",
    files: tuple[Path, ...] | None,
    frame: "Frame",
    views: Sequence[str] = VIEWS,
    *,
    invert: bool,
    after: int = 0,
) -> "SeenImages":
    """Return the images of the files, or the newest of these views in the case after entry `after`; say which were
    skipped.

    Raises what `given_images` and `newest_images` raise.
    """
    from sightline.case.pairs import given_images, newest_images

    if files is not None:
        return given_images(files, frame, invert=invert)
    assert case is not None  # noqa: S101 - without files there is a case
    taken = newest_images(case, frame, views, after=after, invert=invert)
    for line in taken.skipped:
        output.note(line)
    return taken


def image_numbers(case: "Case", views: "Sequence[Entry]", names: Sequence[str]) -> dict[str, int]:
    """Return the numbers of the entries that acquired the images of calibrated views, by name."""
    from sightline.case.stages import acquired_of

    return {name: acquired_of(case, view).number for name, view in zip(names, views, strict=True)}
