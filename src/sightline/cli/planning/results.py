"""What `sightline plan` prints and writes: the plan of one wire, or of several."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sightline.cli.output import Output
from sightline.common.checks import failed

if TYPE_CHECKING:
    from sightline.case.contents import Images
    from sightline.case.picks import AskedPlan, Picks
    from sightline.case.report.content import Report
    from sightline.frame import Frame
    from sightline.planning import Plan, WirePlans

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

    documents = {key: plan_document(one, images) for key, one in each_of(planned).items()}
    if isinstance(planned, Plan):
        return documents[""]
    views = [image.view for image in images]
    order = propose_order(planned.lines, planned.procedure, views, frame, planned.placed)
    names = {wire.key: wire.name for wire in planned.procedure.wires}
    return of_wires(planned.document(), documents) | {
        "drilling_order": {**vars(order), "sentence": order.sentence(names)}
    }


def show(output: Output, planned: "Plan | WirePlans", document: dict[str, Any], remarks: Sequence[str] = ()) -> None:
    """Print the plan for people: verdict and what failed, relations, trajectories, and where it is kept (`document`).

    `remarks`: sentences on proposed wires and on aids that were not fitted.

    Where a gap contradicts the stated error, no error is shown beside the coordinates.
    """
    from sightline.common.show import counted

    verdict, plans = planned.verdict, each_of(planned)
    output.say(SAID[verdict.state].format(counted(len(failed(verdict.checks)), "check")))
    output.failures(verdict.checks)
    for check in (one for one in planned.relations if one.passed):
        output.say(f"{check.name}: {check.sentence}")
    for sentence in remarks:
        output.say(sentence)
    rows = [row for one in plans.values() for row in _rows(one, alone="" in plans)]
    output.table("Trajectory in CFCS, mm (no robot is known)", ("point", "x", "y", "z", "95 % error"), rows)
    said = {key: _sentences(one) for key, one in plans.items()}
    common = [one for one in next(iter(said.values())) if all(one in others for others in said.values())]
    for key, sentences in said.items():
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
    out = [f"wire from entry to end {path.length_mm:.1f} mm, 95 % error of its direction {direction}"]
    if not errors:
        contradicted = "the gap of a point contradicts it" if path.points.gap_failed.any() else "a view's is unknown"
        out.append(f"No error is stated: {contradicted}.")
    return [*out, *planned.sentences()]


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
    from sightline.cli.output import as_json
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
