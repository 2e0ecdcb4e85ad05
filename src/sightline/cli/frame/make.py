"""`sightline frame new | show | check | draw`."""

from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from sightline.cli.base import FrameSource, Output, command, group, refuse_existing
from sightline.cli.frame.describe import frame_document, show_frame, show_stands, show_tolerances, solid_document
from sightline.common.checks import failed

if TYPE_CHECKING:
    from sightline.frame import Frame

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
        """Return a frame like a built-in one, or a copy of a block or of a file. Raises FrameError."""
        from sightline.errors import FrameError
        from sightline.frame import Frame
        from sightline.frame.designs import BUILTIN, builtin_design, patterns_for

        if like not in BUILTIN:
            copied = Frame.load(like)
            if self.stated:
                raise FrameError(
                    f"{like} is copied; rows, pitch, distances and datums are of {', '.join(BUILTIN)} alone"
                )
            return replace(copied, name=name)
        values = {"datums": 6, **self.stated}
        datums = values.pop("datums")
        design = replace(builtin_design(like), name=name, **values)
        patterns = patterns_for(design.beams, design.rows, datums, name)
        return Frame.from_design(replace(design, patterns=patterns))


_MAX_SD = 10.0  # mm or mrad [ours]: more is a wrong unit


@dataclass(frozen=True)
class ToleranceOptions:
    """How well a frame is made or known, 1 s.d. per axis."""

    bead_sd: Annotated[
        float | None,
        typer.Option(
            min=1e-4,
            max=_MAX_SD,
            metavar="MM",
            help="How far a ball may be from its place, 1 s.d. per axis, mm: 0.02 milled, 0.1 to 0.2 printed.",
        ),
    ] = None
    plate_sd: Annotated[
        str | None,
        typer.Option(
            metavar="MM,MRAD", help="The same of a plate as a whole: shift, mm, and rotation, mrad: 0.05,0.2."
        ),
    ] = None
    arm_sd: Annotated[
        str | None, typer.Option(metavar="MM,MRAD", help="The same of both plates of a view together.")
    ] = None

    def on(self, frame: "Frame") -> "Frame":
        """Return the frame with these tolerances; where one is not given, the frame's own, or the default.

        Raises BadParameter, and FrameError for a frame that states its errors otherwise or has no plates.
        """
        from sightline.errors import FrameError

        plates = {"plate": _pair(self.plate_sd, "--plate-sd"), "arm": _pair(self.arm_sd, "--arm-sd")}
        given = {} if self.bead_sd is None else {"bead_mm": self.bead_sd}
        for name, (mm, mrad) in ((name, pair) for name, pair in plates.items() if pair is not None):
            given |= {f"{name}_mm": mm, f"{name}_rad": 1e-3 * mrad}
        if not given:
            return frame
        if frame.covariance_mm2 is not None:
            raise FrameError("the balls' errors are stated already, as they were measured; leave the tolerances out")
        if frame.solid is not None and any(plates.values()):
            raise FrameError("a block has no plates and no arms; give --bead-sd alone")
        return replace(frame, tolerances=replace(frame.effective_tolerances, **given))


def _pair(text: str | None, option: str) -> tuple[float, float] | None:
    """Return the numbers of 'MM,MRAD'. Raises BadParameter."""
    if text is None:
        return None
    try:
        mm, mrad = (float(part) for part in text.split(","))
    except ValueError:
        mm = mrad = -1.0
    if not (0 <= mm <= _MAX_SD and 0 <= mrad <= _MAX_SD):
        raise typer.BadParameter(
            f"{text!r} is not MM,MRAD, each from 0 to {_MAX_SD:g}; write for example 0.1,0.7", param_hint=option
        )
    return mm, mrad


@command(app, "new", "sightline frame new mine.json --like block60 --bead-sd 0.1")
def new(
    output: Output,
    *,
    file: Annotated[Path, typer.Argument(help="The frame file to write.")],
    like: Annotated[
        str,
        typer.Option(
            help="Built-in frame that gives the beams and every value not stated here; or a block or a frame file, "
            "whose balls are copied."
        ),
    ] = "gamma",
    design: DesignOptions,
    tolerances: ToleranceOptions,
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
    from sightline.frame.designs import BUILTIN
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
    frame = tolerances.on(frame)
    checks = check_frame(frame)
    sound = not failed(checks)
    if sound:
        frame.save(file)
    output.say(f"written: {file}" if sound else f"{file} was not written: a check failed")
    if csv is None and like in BUILTIN:
        output.say(f"its datum balls are not those of {like}: make it from `sightline frame draw {file}`")
    document = frame_document(frame)
    show_tolerances(output, frame, document)
    output.result({"file": file if sound else None, **document}, checks)


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
    document = frame_document(loaded)
    show_frame(output, loaded, document)
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
    solid = None if loaded.solid is None else solid_document(loaded.solid)
    if solid is not None:
        show_stands(output, solid)
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
