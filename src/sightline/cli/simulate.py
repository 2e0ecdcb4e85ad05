"""`sightline simulate`: images of the digital twin as a C-arm would store them, with their truth."""

from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from sightline.cli.output import Json, Output, Quiet, as_json, example

if TYPE_CHECKING:
    from sightline.imaging import Radiograph
    from sightline.twin.scenes.specimens import Specimen

AS_MADE = "frame-as-made.json"
_ACCESSORIES = 1  # stream of the accessories, beside that of set-up and noise
DoseName = Literal["low", "medium", "high"]
SideName = Literal["right", "left"]


_EXAMPLES = (
    "sightline simulate hip --seed 3 --with lag-screw --with drape --out out/hip",
    "sightline simulate object --seed 4 --frame-errors 7 --out out/frame-7",
    "sightline simulate hip --frame block60 --out out/block",
    "sightline simulate pelvis --frame block60 --out out/pelvis",
)


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("simulate", epilog=example(*_EXAMPLES))(simulate)


def simulate(
    what: Annotated[
        str,
        typer.Argument(
            help="What lies in the beam: hip, pelvis, vertebra, nailed-femur, growing-femur, object (the paper's "
            "four balls in Perspex), plastic (its bored femur), porcine; or a file: a closed mesh in mm (STL, PLY, "
            "OBJ) or a CT scan (NIfTI, folder of slices)."
        ),
    ] = "hip",
    *,
    preset: Annotated[
        str | None,
        typer.Option(
            help="Image chain; a wrong name lists them all. By default 9in-1k, for a solid flat-panel.",
            show_default=False,
        ),
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="The same seed gives the same files.")] = 1,
    frame: Annotated[str, typer.Option(help="A frame file, gamma, biplane, stereo or block60.")] = "gamma",
    oblique: Annotated[
        bool, typer.Option("--oblique", help="Add a third image between PA and lateral; needs a block.")
    ] = False,
    side: Annotated[SideName, typer.Option(help="Side of the hip.")] = "right",
    dose: Annotated[DoseName, typer.Option(help="1, 8 or 32 frames of fluoroscopy.")] = "medium",
    at: Annotated[
        str | None,
        typer.Option(
            metavar="X,Y,Z",
            help="Point of a mesh or scan, mm in its own coordinates, to put where the hip lies: at the frame's "
            "origin, or beside a solid; by default its middle.",
            show_default=False,
        ),
    ] = None,
    accessory: Annotated[
        list[str] | None,
        typer.Option(
            "--with",
            help="Add to the beam; may be given several times: guide-wire, lag-screw, angled-plate, drill-guide, "
            "drape, table-rail.",
            show_default=False,
        ),
    ] = None,
    frame_errors: Annotated[
        int | None,
        typer.Option(
            min=0,
            metavar="SEED",
            help="Keep one manufactured frame over all images: its errors are drawn from this seed instead of --seed. "
            "The frame as made is written beside the images.",
            show_default=False,
        ),
    ] = None,
    png: Annotated[bool, typer.Option("--png", help="PNG instead of DICOM.")] = False,
    tags: Annotated[
        bool | None,
        typer.Option(
            help="Write the nominal geometry into the DICOM files. By default for a solid, as a flat panel does.",
            show_default=False,
        ),
    ] = None,
    out: Annotated[Path, typer.Option(help="Folder for the images and truth.json.")] = Path("out/simulate"),
    json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Make simulated X-ray images and their truth.

    One image for each view of the frame, and truth.json beside them.
    """
    with Output(json=json, quiet=quiet) as output:
        import numpy as np

        from sightline.atomic import whole_folder
        from sightline.errors import UnusableInputError
        from sightline.frame import Frame
        from sightline.twin import DOSES, render
        from sightline.twin.scenes.specimens import SetUpSpec, specimen, with_accessories
        from sightline.twin.xray.presets import preset as chain_called
        from sightline.twin.xray.setup import chain_for, with_errors

        if png and tags:
            raise UnusableInputError("a PNG holds no geometry tags; leave out --png or --tags")
        designed = Frame.load(frame)
        stated = tags if tags is not None else designed.solid is not None
        chain = chain_called(preset or chain_for(designed))
        as_made = None if frame_errors is None else with_errors(designed, np.random.default_rng(frame_errors))
        machine = SetUpSpec(designed, side, chain.name, as_made, oblique=oblique)
        place = None if at is None else np.array(_place(at))
        rng = np.random.default_rng(seed)
        with output.step("drawing the set-up"):
            made = specimen(what, rng, machine, place)
            if accessory:  # from their own generator, so that the set-up is the same with and without them
                made = with_accessories(made, accessory, np.random.default_rng([seed, _ACCESSORIES]))
        images = {}
        for view in made.setup.views:
            with output.step(f"exposing {view}"):
                images[view] = render(made.setup, view, made.scene, rng, DOSES[dose])
        told = {"what": Path(what).name, "preset": chain.name, "seed": seed, "dose": dose, "whole_shown": made.shown}
        if frame_errors is not None:
            told["frame_errors"] = frame_errors
        with whole_folder(out) as scratch:
            files = _write(scratch, images, made, {**told, **made.truth}, png=png, tags=stated)
            if as_made is not None:
                as_made.save(scratch / AS_MADE)
                files.append(scratch / AS_MADE)
        if not made.shown:
            output.note(f"the field of {chain.name} does not show everything; see the pixels in truth.json")
        written = [out / file.name for file in files]
        for file in written:
            output.say(f"written: {file}")
        output.result({**told, "frame": machine.frame.key, "side": side, "files": written})


def _place(text: str) -> list[float]:
    """Return the numbers of 'X,Y,Z'. Raises UnusableInputError."""
    from sightline.errors import UnusableInputError

    try:
        numbers = [float(part) for part in text.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) != 3 or not all(isfinite(number) for number in numbers):
        raise UnusableInputError(f"--at {text!r} is not a point; write X,Y,Z in mm, for example '12.5,-40,310'")
    return numbers


def _write(
    folder: Path, images: "dict[str, Radiograph]", made: "Specimen", truth: dict[str, Any], *, png: bool, tags: bool
) -> list[Path]:
    from dataclasses import replace

    from sightline.atomic import write_whole
    from sightline.imaging import write_dicom, write_png
    from sightline.twin.scenes.specimens import nominal_tags

    files = []
    for name, image in images.items():
        if png:
            files.append(write_png(image, folder / f"{name}.png"))
        else:
            stated = nominal_tags(made.setup.views[name], made.setup.side) if tags else image.tags
            files.append(write_dicom(replace(image, tags=stated), folder / f"{name}.dcm", made.setup.side))
    return [*files, write_whole(folder / "truth.json", as_json(truth).encode())]
