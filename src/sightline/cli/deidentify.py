"""`sightline export deidentify`: DICOM images without the patient's identity."""

from pathlib import Path
from typing import Annotated

import typer

from sightline.cli.detect import FrameIndex
from sightline.cli.output import Json, Output, Quiet, example


def register(app: typer.Typer) -> None:
    """Add the command."""
    epilog = example("sightline export deidentify pa.dcm lateral.dcm --out out/anonymous")
    app.command("deidentify", epilog=epilog)(deidentify)


def deidentify(
    images: Annotated[list[Path], typer.Argument(metavar="DICOM...", help="DICOM images of one patient.")],
    *,
    out: Annotated[Path, typer.Option(help="Folder for image-001.dcm, image-002.dcm, ... in the order given.")],
    frame_index: FrameIndex = None,
    json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Write DICOM files without the patient's identity.

    The new files hold pixels and geometry only. Burnt-in annotation stays in the pixels.
    """
    with Output(json=json, quiet=quiet) as output:
        from sightline.atomic import write_folder
        from sightline.case.deidentify import Deidentifier

        cleaner = Deidentifier()
        cleaned = [cleaner.clean(image, frame_index) for image in images]  # all of them before one is written
        names = [f"image-{k:03d}.dcm" for k in range(1, len(cleaned) + 1)]
        files = write_folder(out, {name: one.data for name, one in zip(names, cleaned, strict=True)})
        for file in files:
            output.say(f"written: {file}")
        burnt = [name for name, one in zip(names, cleaned, strict=True) if one.burnt_in_stated or one.burnt_in_found]
        found = f"; annotation found in {', '.join(burnt)}" if burnt else ""
        output.note(f"look at every image before you pass it on: burnt-in annotation is not removed{found}")
        documents = [
            {"file": file, "burnt_in_stated": one.burnt_in_stated, "burnt_in_found": one.burnt_in_found}
            for file, one in zip(files, cleaned, strict=True)
        ]
        output.result({"images": documents})
