"""`sightline frame draw`: drawings, bill of material and inspection sheet for the workshop."""

from pathlib import Path
from typing import Annotated

import typer

from sightline.cli.output import Json, Output, Quiet, example


def register(app: typer.Typer) -> None:
    """Add the command to `sightline frame`."""
    app.command("draw", epilog=example("sightline frame draw gamma --out out/drawings"))(draw)


def draw(
    frame: Annotated[
        str,
        typer.Argument(metavar="FRAME", help="A frame file, or a built-in frame: gamma, biplane, stereo, block60, ..."),
    ],
    *,
    out: Annotated[Path, typer.Option(help="Folder for the files.")],
    clearance_mm: Annotated[
        float,
        typer.Option(help="Added to the bores' diameters in the STL, mm: 0.2 for FDM, 0.1 for SLA.", min=0, max=1),
    ] = 0.0,
    json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Write the drawings that a workshop needs.

    SVG and DXF of each plate or face, STL, an assembly picture, a bill of material and an inspection sheet.
    """
    with Output(json=json, quiet=quiet) as output:
        from sightline.frame import Frame
        from sightline.frame.drawings.bill import bill_rows
        from sightline.frame.drawings.part import parts_of
        from sightline.frame.drawings.workshop import write_workshop

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
