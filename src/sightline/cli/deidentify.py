"""`sightline export deidentify`: images without identity."""

from pathlib import Path
from typing import Annotated

import typer

from sightline.cli.detect import FrameIndex
from sightline.cli.output import Json, Output, Quiet


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("deidentify")(deidentify)


def deidentify(
    images: Annotated[list[Path], typer.Argument(metavar="DICOM...", help="Images of one patient.")],
    *,
    out: Annotated[Path, typer.Option(help="Folder for image-001.dcm and so on, in the order given.")],
    frame_index: FrameIndex = None,
    json: Json = False,
    quiet: Quiet = False,
) -> None:
    """New DICOM files of the pixels and the geometry alone; text burnt into the pixels stays."""
    with Output(json=json, quiet=quiet) as output:
        from sightline.atomic import write_folder
        from sightline.case.deidentify import Deidentifier

        cleaner = Deidentifier()
        cleaned = [cleaner.clean(image, frame_index) for image in images]  # all of them, before one is written
        names = [f"image-{k:03d}.dcm" for k in range(1, len(cleaned) + 1)]
        files = write_folder(out, {name: one.data for name, one in zip(names, cleaned, strict=True)})
        for file in files:
            output.say(f"written: {file}")
        burnt = [name for name, one in zip(names, cleaned, strict=True) if one.burnt_in_stated or one.burnt_in_found]
        said = f"; there is some in {', '.join(burnt)}" if burnt else ""
        output.note(f"look at every image before you pass it on: text burnt into the pixels is not removed{said}")
        documents = [
            {"file": file, "burnt_in_stated": one.burnt_in_stated, "burnt_in_found": one.burnt_in_found}
            for file, one in zip(files, cleaned, strict=True)
        ]
        output.result({"images": documents})
