"""`sightline demo`: two simulated images, planned, drilled, and compared with the truth in a report."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from sightline.cli.demos.case import Kept, record
from sightline.cli.demos.robot import DemoPlan, Inserted, RobotAhead, carry_out
from sightline.cli.options import command, commands
from sightline.cli.output import Output

if TYPE_CHECKING:
    from sightline.calibration.maps.fit_map import Method
    from sightline.case.contents import PlanRequest
    from sightline.case.report.content import Compared, Refused, Report, Truth
    from sightline.case.views import CalibratedImage
    from sightline.common.checks import Check
    from sightline.frame import Frame
    from sightline.planning import WirePlans

METHODS: "tuple[Method, ...]" = ("smooth", "localized", "polynomial")  # the plan is made with the first
OF_SOLIDS: "tuple[Method, ...]" = METHODS[:1]  # the others are for plates
# The first seed whose beads surround the whole wire in both images; otherwise `localized` gives no result to compare.
SEED = 9
PICK_SD_PX = 0.5  # a careful click (physics.md, Picks) [ours]
OF_NAIL = "measured in the images, from clicks with 2 px of noise"
BY_HAND = f"picked by hand: {PICK_SD_PX:g} px of noise, lateral picks snapped to their curves"
EXACT = "located exactly: no noise, 0.1 px assumed"


@command(
    commands, "demo", "sightline demo --out out/demo", "sightline demo --procedure pedicle-screw --out out/pedicle"
)
def demo(
    output: Output,
    *,
    out: Annotated[Path, typer.Option(help="Folder for the report, the images and the results.")] = Path("out/demo"),
    seed: Annotated[
        int | None,
        typer.Option(min=0, help=f"Seed of patient, C-arm and frame; by default {SEED}, or as the procedure needs."),
    ] = None,
    procedure: Annotated[str, typer.Option(help="Key of a shipped procedure; a wrong key lists them.")] = "hip-screw",
    frame: Annotated[
        str | None,
        typer.Option(
            help="gamma; block60 or block30 on a flat panel; block40+detector-plate on an intensifier. By default "
            "gamma, or block60 where the views of plan or check shots are not those of gamma.",
            show_default=False,
        ),
    ] = None,
) -> None:
    """Simulate, plan and drill one case.

    Makes two images with the digital twin, plans a wire on them, drills it with the simulated robot, and compares the
    result with the truth. The robot is simulated at the hip and beside a nail; at other bones the wire is put where it
    was planned.
    """
    from sightline.cli.demos.procedures import SEEDS

    seed = SEEDS.get(procedure, SEED) if seed is None else seed
    with RobotAhead(seed, procedure, frame) as ahead:  # its process imports while this one does
        from sightline.cli.demos.procedures import frame_for
        from sightline.common.atomic import whole_folder
        from sightline.frame import Frame

        frame_name = frame_for(procedure, frame)
        how_long = "about a quarter of a minute, of three wires twice that"
        output.note(f"Sightline demo, seed {seed}: {how_long}; the first run compiles and takes a minute more")
        read = Frame.load(frame_name)
        ahead.keep_beside(read)
        with whole_folder(out, units=("case",)) as scratch:
            document = _run(output, scratch, ahead, seed=seed, frame_name=frame_name, procedure=procedure)
            files = [out / file.name for file in sorted(scratch.iterdir())]
    output.say(f"report: {out / 'report.html'}")
    output.say(f"images and results: {', '.join(file.name for file in files if file.suffix != '.html')} in {out}")
    output.result({**document, "files": files})


def _run(
    output: Output,
    folder: Path,
    ahead: RobotAhead,
    *,
    seed: int,
    frame_name: str,
    procedure: str,
) -> dict[str, Any]:
    """Do all steps and return the result. The images are read back from their files, as a user's images are."""
    from sightline.case.report.content import CHECK, PLANNING, WHILE_DRILLING, Report, Truth, exposures_of_images
    from sightline.case.report.page import render
    from sightline.case.views import NAMES, calibrate_pair, see_pair
    from sightline.cli.demos.procedures import (
        command,
        drawn_patient,
        measured,
        others_compared,
        picks_told,
        placed_told,
        relations_measured,
        title,
    )
    from sightline.frame import Frame
    from sightline.imaging import write_dicom

    frame = Frame.load(frame_name)
    with output.step("1/8 drawing the set-up and its X-ray images"):
        rehearsal = drawn_patient(procedure, seed, frame)
        wire = rehearsal.wires_mm[0]
        truth = Truth(wire, rehearsal.pixels(wire))
        pa, lateral = (
            write_dicom(rehearsal.images[name], folder / f"demo_{name}.dcm", rehearsal.side) for name in NAMES
        )
    with output.step("2/8 reading the images, finding and labelling the beads"):
        seen = see_pair(pa, lateral, frame)
    methods = _methods(frame)
    with output.step(f"3/8 calibrating both views: {', '.join(methods)}"):
        images = {method: calibrate_pair(seen, frame, method) for method in methods}
    rng = rehearsal.generator("picks")
    asked, drawn_px = rehearsal.asked(rng, PICK_SD_PX)
    with output.step("4/8 planning entry and tip, drawing the image-matching curves"):
        wires = asked.plan_wires(images[METHODS[0]]) if asked.others else None
        planned = wires.plans[rehearsal.document.wires[0].key] if wires else asked.plan(images[METHODS[0]])
    with output.step("5/8 comparing with the truth"):
        compared = _compare(images, asked, truth, planned)
        compared += others_compared(rehearsal, wires, compared[0].picks)
    whole = DemoPlan(rehearsal, frame_name, asked, planned, images[METHODS[0]], wires)
    inserted = carry_out(output, whole, ahead, rng)
    drilled = inserted[whole.key].drilled if whole.key in inserted else None
    exposed = exposures_of_images(images[METHODS[0]], PLANNING, planned.kind)
    for one in inserted.values():
        for state, shot in one.shots.items():
            exposed += exposures_of_images(shot.images or (), WHILE_DRILLING[state], planned.kind)
        exposed += exposures_of_images(one.checked.images or (), CHECK, planned.kind)
    with output.step("8/8 drawing the report"):
        report = Report(
            title=title(drilled),
            frame=frame,
            images=images[METHODS[0]],
            plan=planned,
            exposures=exposed,
            provenance={
                "images": f"made by the digital twin, seed {seed}, written as DICOM without geometry and read back",
                "picks": picks_told(planned.kind, asked.landmark_names, drawn_px, PICK_SD_PX)
                if asked.nail is None
                else f"points {OF_NAIL}; landmarks clicked with {PICK_SD_PX:g} px of noise",
                "side": rehearsal.side,
                "command": command(seed, procedure, frame_name),
            }
            | ({} if drilled is None or drilled.record else {"wire": placed_told(wires)}),
            localized=(paper[0].view, paper[1].view) if (paper := images.get("localized")) else None,
            truth=truth,
            compared=compared,
            drilled=drilled,
            wires=wires,
            measured=measured(inserted) if wires else {},
        )
        page = render(report)
    kept = Kept(rehearsal, (pa, lateral), images[METHODS[0]], asked, planned, drawn_px, inserted, wires)
    record(folder / "case", kept)
    _write_results(folder, page, report, {"seed": seed, **rehearsal.truth})
    _show(output, wires or planned, compared)
    _show_drilled(output, inserted)
    relations = relations_measured(output, wires, inserted) if wires else ()
    return {
        **planned.verdict_document(),
        "trajectory": planned.trajectory.document(),
        **({} if wires is None else _wires_document(wires, inserted, relations)),
        "comparison": [one.document() for one in compared],
        "drilled": None if drilled is None else drilled.document()["check_shot"],
    }


def _methods(frame: "Frame") -> "tuple[Method, ...]":
    return METHODS if frame.solid is None else OF_SOLIDS


def _compare(
    images: "dict[str, tuple[CalibratedImage, CalibratedImage]]", asked: "PlanRequest", truth: "Truth", planned: Any
) -> "list[Compared | Refused]":
    """Return every method's error, with a person's picks and with the true pixels."""
    import numpy as np

    from sightline.case.report.content import Compared, Refused
    from sightline.errors import RefusedError
    from sightline.planning import kind, plan

    picks = np.stack([asked.entry_uv_px, asked.end_uv_px], axis=1)
    by_hand = BY_HAND if asked.nail is None else OF_NAIL
    out: list[Compared | Refused] = [Compared(METHODS[0], by_hand, planned.trajectory, truth)]
    for how, uv, sd, snapped in ((BY_HAND, picks, PICK_SD_PX, True), (EXACT, truth.uv_px, 0.1, False)):
        for method in images:
            if (method, how) == (METHODS[0], BY_HAND):
                continue
            views = [image.view for image in images[method]]
            try:
                made = plan(views, uv[:, 0], uv[:, 1], pick_sd_px=sd, snapped=snapped, kind=kind("free-wire"))
                out.append(Compared(method, how, made.trajectory, truth))
            except RefusedError as error:
                out.append(Refused(method, how, str(error)))
    return out


def _write_results(folder: Path, page: str, report: "Report", truth: dict[str, Any]) -> None:
    from sightline.case.saved import document
    from sightline.cli.output import as_json
    from sightline.common.atomic import write_files
    from sightline.detection.csv_files import write_observations

    images, planned = report.images, report.plan
    stated = {"landmarks": planned.landmarks_document(), **planned.verdict_document()}
    results = {
        "detections": {image.name: image.seen.beads for image in images},
        "observations": {image.name: image.seen.observations for image in images},
        "views": [document(image.view, source=image.seen.source) for image in images],
        "trajectory": document(planned.trajectory, **stated, checks=planned.verdict.checks),
        "comparison": [one.document() for one in report.compared],
        "truth": truth,
        **({} if report.drilled is None else {"drilling": report.drilled.document()}),
    }
    documents = {f"{name}.json": as_json(result).encode() for name, result in results.items()}
    write_files(folder, {"report.html": page.encode(), **documents})
    write_observations([image.seen.observations for image in images], folder / "observations.csv")


def _show(output: Output, planned: Any, compared: "list[Compared | Refused]") -> None:
    from sightline.cli.planning.results import show

    show(output, planned, {})
    for how in dict.fromkeys(one.picks for one in compared):
        rows = [_row(one) for one in compared if one.picks == how]
        output.table(f"Error against the truth, {how}", ("method", "entry mm", "tip mm", "direction °"), rows)


def _show_drilled(output: Output, inserted: Mapping[str, Inserted]) -> None:
    from sightline.case.report.drilled import section

    for one in inserted.values():
        told, wire = section(one.drilled) or {}, one.plan.kind.wire.name if len(inserted) > 1 else "wire"
        output.table(f"The drilled {wire}", ("", "entry mm", "tip mm", "direction °"), told["rows"])
        events = f"The robot detected: {told['events']}. " if told["events"] else ""
        output.say(f"{events}{told['check']}")


def _wires_document(
    wires: "WirePlans", inserted: Mapping[str, Inserted], relations: "Sequence[Check]"
) -> dict[str, Any]:
    drilled = {key: one.drilled.document()["check_shot"] for key, one in inserted.items()}
    return {
        "all_wires": wires.document(),
        "all_drilled": drilled,
        "relations_measured": [vars(check) for check in relations],
    }


def _row(one: "Compared | Refused") -> tuple[str, ...]:
    from sightline.case.report.content import Refused

    if isinstance(one, Refused):
        return one.method, "refused", "refused", "refused"
    return one.method, *(f"{v:.2f}" for v in one.errors)
