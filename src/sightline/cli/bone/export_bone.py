"""`sightline export bone`: the pose of a registered bone for other programs."""

from pathlib import Path
from typing import Annotated

import typer

from sightline.cli.base import OutFolder, Output, command
from sightline.cli.export import app


@command(app, "bone", "sightline export bone out/bone/bone-pose.json --to igtl --out out/ct")
def bone(
    output: Output,
    *,
    path: Annotated[Path, typer.Argument(metavar="POSE", help="bone-pose.json of `sightline register-bone`.")],
    out: OutFolder,
    to: Annotated[str, typer.Option(help="Formats: slicer,igtl,ros2. Each goes to a folder of its name.")] = "slicer",
) -> None:
    """Export the pose of a registered bone.

    One whose checks failed says so, and is not exported as a message.
    """
    from sightline.case.interop.bone import FORMATS
    from sightline.case.saved import load
    from sightline.common.atomic import write_folder
    from sightline.common.names import named
    from sightline.planning.bone.registered import RegisteredBone

    writers = {name: named(name, FORMATS, "format of a bone") for name in map(str.strip, to.split(","))}
    found = load(path, RegisteredBone)
    files = {f"{name}/{file}": data for name, write in writers.items() for file, data in write(found).items()}
    written = write_folder(out, files)
    output.written(written)
    output.result({"trusted": found.trusted, "files": written}, found.checks)
