"""`sightline frame new | show | check | draw`."""

from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from sightline.cli.options import FrameSource, command, group, refuse_existing
from sightline.cli.output import Output
from sightline.common.checks import failed

if TYPE_CHECKING:
    from sightline.frame.model import Frame
    from sightline.frame.plate import FrameView, Plate, RigidBody

app = group("frame", "Make, measure, draw and check frames.")


@dataclass(frozen=True)
class DesignOptions:
    """The values of a new frame that are not those of the frame that it is like."""

    rows: Annotated[
        int | None, typer.Option(help="Rows of balls on the XRII plate; the source plate has one more.")
    ] = None
    pitch_mm: Annotated[
        float | None, typer.Option(help="Distance between neighbouring balls on the XRII plate, mm.")
    ] = None
    xrii_mm: Annotated[
        float | None, typer.Option(help="Distance of the XRII plate from the hip, towards the intensifier, mm.")
    ] = None
    source_mm: Annotated[
        float | None, typer.Option(help="Distance of the source plate from the hip, mm; negative on the source side.")
    ] = None
    datums: Annotated[int | None, typer.Option(help="Number of datum markers on each plate.")] = None

    @property
    def stated(self) -> dict[str, Any]:
        """The values that are given, by name."""
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        return {name: value for name, value in values.items() if value is not None}

    def frame(self, name: str, like: str) -> "Frame":
        """Return a frame like a built-in one. Raises FrameError."""
        from sightline.errors import FrameError
        from sightline.frame import Frame
        from sightline.frame.designs import SOLIDS, WITH_PLATE, builtin_design, patterns_for

        if like in SOLIDS or like in WITH_PLATE:
            if self.stated:
                raise FrameError(f"{like} is a block without plates; leave out their values, and edit its balls")
            return replace(Frame.load(like), name=name)
        values = {"datums": 6, **self.stated}
        datums = values.pop("datums")
        design = replace(builtin_design(like), name=name, **values)
        patterns = patterns_for(design.beams, design.rows, datums, name)
        return Frame.from_design(replace(design, patterns=patterns))


@command(app, "new", "sightline frame new mine.json --like gamma --rows 7 --pitch-mm 22")
def new(
    output: Output,
    *,
    file: Annotated[Path, typer.Argument(help="The frame file to write.")],
    like: Annotated[
        str, typer.Option(help="Built-in frame that gives the beams and every value not stated here, or a block.")
    ] = "gamma",
    design: DesignOptions,
    csv: Annotated[
        Path | None,
        typer.Option(
            help="Table of measured balls, or frame specification of XMALab, instead of the values above "
            "(docs/frame-file.md)."
        ),
    ] = None,
    diameter_mm: Annotated[
        float | None, typer.Option(help="Diameter of the balls of a frame specification of XMALab, mm; default 3.")
    ] = None,
    units: Annotated[
        str | None, typer.Option(help="Unit of a frame specification of XMALab, mm or cm; default by its size.")
    ] = None,
) -> None:
    """Write a frame file.

    The frame is made from a few values or from a table of measured balls. It is checked first: where a check fails,
    nothing is written (exit code 3).
    """
    from sightline.errors import FrameError
    from sightline.frame.check import check_frame
    from sightline.frame.tables import frame_from_csv

    refuse_existing(file)
    if csv is not None and design.stated:
        raise FrameError("--csv states the whole frame; leave out the other values")
    if csv is None and (diameter_mm is not None or units is not None):
        raise FrameError("--diameter-mm and --units hold for --csv alone; leave them out")
    with output.step("making the frame"):
        if csv is None:
            frame = design.frame(file.stem, like)
        else:
            frame = frame_from_csv(csv, file.stem, diameter_mm, units)
    checks = check_frame(frame)
    sound = not failed(checks)
    if sound:
        frame.save(file)
    output.say(f"written: {file}" if sound else f"{file} was not written: a check failed")
    output.result({"file": file if sound else None, **_document(frame)}, checks)


@command(app, "show", "sightline frame show gamma --picture out/plates.png")
def show(
    output: Output,
    *,
    frame: FrameSource,
    picture: Annotated[
        Path | None, typer.Option(help="Write a PNG of the plates, or of the block's faces, to this file.")
    ] = None,
) -> None:
    """Show plates, datums, tolerances and reach of a frame.

    Of a block: its balls, and where it may stand.
    """
    from sightline.frame import Frame

    loaded = Frame.load(frame)
    document = _document(loaded)
    _show(output, loaded, document)
    if picture is not None:
        from sightline.frame.drawings.picture import draw_frame

        draw_frame(loaded, picture)
        output.say(f"written: {picture}")
    output.result(document)


@command(app, "check", "sightline frame check gamma")
def check(
    output: Output,
    *,
    frame: FrameSource,
    before: Annotated[
        str | None, typer.Option(help="Earlier file of the same frame: fail if the new one is its mirror image.")
    ] = None,
) -> None:
    """Check a frame.

    Exit code 3 if a check fails. Of a block, it also says where it may stand.
    """
    from sightline.frame import Frame
    from sightline.frame.check import before_check, check_frame

    loaded = Frame.load(frame)
    checks = check_frame(loaded)
    if before is not None:
        checks += (before_check(loaded, Frame.load(before)),)
    solid = None if loaded.solid is None else _solid_document(loaded.solid)
    if solid is not None:
        _show_solid(output, solid)
    output.result({"frame": loaded.key, "solid": solid}, checks)


@command(app, "draw", "sightline frame draw gamma --out out/drawings")
def draw(
    output: Output,
    *,
    frame: FrameSource,
    out: Annotated[Path, typer.Option(help="Folder for the files.")],
    clearance_mm: Annotated[
        float,
        typer.Option(help="Added to the bores' diameters in the STL, mm: 0.2 for FDM, 0.1 for SLA.", min=0, max=1),
    ] = 0.0,
) -> None:
    """Write the drawings that a workshop needs.

    SVG and DXF of each plate or face, STL, an assembly picture, a bill of material and an inspection sheet.
    """
    from sightline.frame import Frame
    from sightline.frame.drawings.part import parts_of
    from sightline.frame.drawings.workshop import bill_rows, write_workshop

    loaded = Frame.load(frame)
    with output.step("drawing the parts"):
        files = write_workshop(loaded, out, clearance_mm)
    parts = parts_of(loaded)
    output.table("Bill of material", ("item", "number", "material", "remark"), bill_rows(parts))
    output.say(f"written: {len(files)} files in {out}")
    document = [
        {
            "plate": part.name,
            "width_mm": part.width_mm,
            "height_mm": part.height_mm,
            "thickness_mm": part.thickness_mm,
            "bores": len(part.bores),
            "position_tolerance_mm": part.position_mm,
        }
        for part in parts
    ]
    output.result({"files": files, "parts": document})


def _document(frame: "Frame") -> dict[str, Any]:
    from sightline.frame.plate import ROLES

    return {
        "name": frame.name,
        "serial": frame.serial,
        "measured_on": frame.measured_on,
        "temperature_c": frame.temperature_c,
        "tolerances": None if frame.covariance_mm2 is not None else frame.effective_tolerances,
        "tolerances_from": _tolerances_from(frame),
        "in_use": frame.in_use,
        "plates": [
            _plate_document(name, role, view, getattr(view, role))
            for name, view in frame.views.items()
            for role in ROLES
        ],
        "solid": None if frame.solid is None else _solid_document(frame.solid),
        "detector": None if frame.detector is None else _detector_document(frame.detector),
    }


def _detector_document(plate: "Plate") -> dict[str, Any]:
    return {
        "beads": len(plate.ids),
        "datums": [f.id for f in plate.fiducials if f.datum],
        "stand_off_mm": float(plate.xyz_mm[:, 2].mean()),
    }


def _tolerances_from(frame: "Frame") -> str:
    if frame.covariance_mm2 is not None:
        return "the covariance in the frame file"
    return "the frame file" if frame.tolerances else "the defaults: the frame file states none"


def _plate_document(name: str, role: str, view: "FrameView", plate: "Plate") -> dict[str, Any]:
    from sightline.errors import UnusableInputError
    from sightline.frame.check import reach_mm

    try:
        normal, reach = plate.plane.normal, reach_mm(view, plate)
    except UnusableInputError:  # the beads are on one line; `frame check` reports it
        normal = reach = None
    return {
        "view": name,
        "plate": role,
        "beads": len(plate.ids),
        "datums": [f.id for f in plate.fiducials if f.datum],
        "middle_mm": plate.xyz_mm.mean(axis=0),
        "normal": normal,
        "reach_mm": reach,
    }


def _solid_document(solid: "RigidBody") -> dict[str, Any]:
    from collections import Counter

    import numpy as np

    from sightline.frame.solid_shape import FIELDS_MM, clear_beads, offset_mm, radius_mm

    clear = clear_beads(solid)
    return {
        "beads": len(solid.ids),
        "diameters_mm": dict(sorted(Counter(f.diameter_mm for f in solid.fiducials).items())),
        "size_mm": np.ptp(solid.xyz_mm, axis=0),
        "radius_mm": radius_mm(solid),
        "clear_mean": float(clear.mean()),
        "clear_worst": int(clear.min()),
        "stands": [
            {"detector": name, "field_mm": field, "offset_mm": offset_mm(solid, field)}
            for name, field in FIELDS_MM.items()
        ],
    }


def _show_solid(output: Output, solid: dict[str, Any]) -> None:
    sizes = ", ".join(f"{number} of {diameter:g} mm" for diameter, number in solid["diameters_mm"].items())
    output.say(f"a solid of {solid['beads']} beads: {sizes}")
    output.say(
        f"their centres span {' x '.join(f'{mm:g}' for mm in solid['size_mm'])} mm; radius {solid['radius_mm']:.1f} mm"
    )
    output.say(
        f"clear of each other: {solid['clear_mean']:.1f} beads on average over all directions, "
        f"{solid['clear_worst']} from the worst"
    )
    output.table(
        "Where it may stand at the hip, however it is turned, with all beads in the image",
        ("detector", "field mm", "middle within, mm of the beam's axis", "field left beside it, mm"),
        [
            (
                place["detector"],
                f"{place['field_mm']:g}",
                "does not fit" if place["offset_mm"] < 0 else f"{place['offset_mm']:.0f}",
                None if place["offset_mm"] < 0 else f"{2 * place['offset_mm']:.0f}",
            )
            for place in solid["stands"]
        ],
    )


def _show(output: Output, frame: "Frame", document: dict[str, Any]) -> None:
    title = f"Frame {frame.name}" + (f", serial {frame.serial}" if frame.serial else "")
    if document["solid"] is not None:
        output.say(title)
        _show_solid(output, document["solid"])
        if (plate := document["detector"]) is not None:
            output.say(
                f"a plate of {plate['beads']} beads, {plate['stand_off_mm']:g} mm in front of the detector; datums "
                + " ".join(plate["datums"])
            )
    else:
        _show_plates(output, title, document)
    output.say(f"tolerances (1 s.d.): from {document['tolerances_from']}")
    if (use := frame.in_use) is not None:
        output.say(
            f"handling adds (1 s.d.): {use.warmer_k:g} K of heat, {100 * use.water_share:g} % of water, "
            f"{use.drape_n:g} N of drapes"
        )
    if (sd := document["tolerances"]) is not None:
        rows = [
            ("bead", sd.bead_mm, None),
            ("plate", sd.plate_mm, 1e3 * sd.plate_rad),
            ("arm", sd.arm_mm, 1e3 * sd.arm_rad),
        ]
        output.table("Tolerances", ("of", "shift mm", "rotation mrad"), rows if frame.solid is None else rows[:1])


def _show_plates(output: Output, title: str, document: dict[str, Any]) -> None:
    output.table(
        title,
        ("view", "plate", "beads", "datums", "middle, CFCS mm", "reach mm"),
        [
            (
                plate["view"],
                plate["plate"],
                plate["beads"],
                " ".join(plate["datums"]),
                " ".join(f"{value:.1f}" for value in plate["middle_mm"]),
                None if plate["reach_mm"] is None else f"{plate['reach_mm']:.1f}",
            )
            for plate in document["plates"]
        ],
    )
    output.say("reach: how far the ends of a 95 mm wire at 45° may move at the hip inside the beads' convex hull")
