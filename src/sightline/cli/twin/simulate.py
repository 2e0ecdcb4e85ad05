"""`sightline simulate`: images of the digital twin as a C-arm would store them, with their truth."""

from dataclasses import dataclass, replace
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from sightline.cli.base import FrameName, Output, Side, as_json, command, commands

if TYPE_CHECKING:
    import numpy as np

    from sightline.frame import Frame
    from sightline.imaging import Radiograph
    from sightline.twin.scenes.specimens import Specimen

AS_MADE = "frame-as-made.json"
_ACCESSORIES, _SCANNER = 1, 2  # streams of the accessories and of the CT, beside that of set-up and noise


@dataclass(frozen=True)
class SceneOptions:
    """What lies in the beam, and the machine in front of it."""

    what: Annotated[
        str,
        typer.Argument(
            help="What lies in the beam: hip, pelvis, vertebra, nailed-femur, growing-femur, object (the paper's "
            "four balls in Perspex), plastic (its bored femur), porcine; or a file: a closed mesh in mm (STL, PLY, "
            "OBJ) or a CT scan (NIfTI, NRRD, folder of slices)."
        ),
    ] = "hip"
    preset: Annotated[
        str | None,
        typer.Option(
            help="Image chain: 9in-1k (the default), 9in-pal, 17cm-1k; flat panels: flat-panel (the default for a "
            "solid), flat-panel-0.1, flat-panel-0.2, flat-panel-0.3.",
            show_default=False,
        ),
    ] = None
    seed: Annotated[int, typer.Option(min=0, help="The same seed gives the same files.")] = 1
    frame: FrameName = "gamma"
    oblique: Annotated[
        bool, typer.Option("--oblique", help="Add a third image between PA and lateral; needs a block.")
    ] = False
    side: Annotated[Side, typer.Option(help="Side of the hip.")] = "right"
    at: Annotated[
        str | None,
        typer.Option(
            metavar="X,Y,Z",
            help="Point of a mesh or scan, mm in its own coordinates, to put where the hip lies: at the frame's "
            "origin, or beside a solid; by default its middle.",
            show_default=False,
        ),
    ] = None
    accessory: Annotated[
        list[str] | None,
        typer.Option(
            "--with",
            help="Add to the beam; may be given several times: guide-wire, lag-screw, angled-plate, drill-guide, "
            "drape, table-rail.",
            show_default=False,
        ),
    ] = None
    frame_errors: Annotated[
        int | None,
        typer.Option(
            min=0,
            metavar="SEED",
            help="Keep one manufactured frame over all images: its errors are drawn from this seed instead of --seed. "
            "The frame as made is written beside the images.",
            show_default=False,
        ),
    ] = None

    write_bone: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Write the hip's bone as a CT (.nrrd) in coordinates of its own, and beside it its true pose "
            "(.pose.json), which takes them to CFCS.",
            show_default=False,
        ),
    ] = None

    def drawn(self, rng: "np.random.Generator") -> "tuple[Specimen, Frame, Frame | None]":
        """Return the set-up, the frame as designed, and the one as made where that is kept over all images."""
        import numpy as np

        from sightline.frame import Frame
        from sightline.twin.scenes.specimens import SetUpSpec, specimen, with_accessories
        from sightline.twin.xray.presets import preset
        from sightline.twin.xray.setup import chain_for, with_errors

        frame = Frame.load(self.frame)
        chain = preset(self.preset or chain_for(frame))
        made = None if self.frame_errors is None else with_errors(frame, np.random.default_rng(self.frame_errors))
        machine = SetUpSpec(frame, self.side, chain.name, made, oblique=self.oblique)
        drawn = specimen(self.what, rng, machine, None if self.at is None else np.array(_place(self.at)))
        if self.accessory:  # from their own generator, so that the set-up is the same with and without them
            drawn = with_accessories(drawn, self.accessory, np.random.default_rng([self.seed, _ACCESSORIES]))
        return drawn, frame, made


@command(
    commands,
    "simulate",
    "sightline simulate hip --seed 3 --with lag-screw --with drape --out out/hip",
    "sightline simulate object --seed 4 --frame-errors 7 --out out/frame-7",
    "sightline simulate hip --frame block60 --out out/block",
    "sightline simulate pelvis --frame block60 --out out/pelvis",
    "sightline simulate hip --seed 9 --write-bone out/bone.nrrd --out out/hip",
)
def simulate(
    output: Output,
    *,
    scene: SceneOptions,
    dose: Annotated[
        Literal["low", "medium", "high"], typer.Option(help="1, 8 or 32 frames of fluoroscopy.")
    ] = "medium",
    png: Annotated[bool, typer.Option("--png", help="PNG instead of DICOM.")] = False,
    tags: Annotated[
        bool | None,
        typer.Option(
            help="Write the nominal geometry into the DICOM files. By default for a solid, as a flat panel does.",
            show_default=False,
        ),
    ] = None,
    out: Annotated[Path, typer.Option(help="Folder for the images and truth.json.")] = Path("out/simulate"),
) -> None:
    """Make simulated X-ray images and their truth.

    One image for each view of the frame, and truth.json beside them.
    """
    import numpy as np

    from sightline.common.atomic import whole_folder
    from sightline.errors import UnusableInputError
    from sightline.twin import DOSES, render

    if png and tags:
        raise UnusableInputError("a PNG holds no geometry tags; leave out --png or --tags")
    rng = np.random.default_rng(scene.seed)
    with output.step("drawing the set-up"):
        drawn, frame, made = scene.drawn(rng)
    bone = [] if scene.write_bone is None else _bone(scene.write_bone, drawn, scene.seed)
    images = {}
    for view in drawn.setup.views:
        with output.step(f"exposing {view}"):
            images[view] = render(drawn.setup, view, drawn.scene, rng, DOSES[dose])
    chain = next(iter(drawn.setup.views.values())).chain.name
    truth: dict[str, Any] = {"what": Path(scene.what).name, "preset": chain, "seed": scene.seed, "dose": dose}
    truth["whole_shown"] = drawn.shown
    if made is not None:
        truth["frame_errors"] = scene.frame_errors
    with whole_folder(out) as scratch:
        stated = tags if tags is not None else frame.solid is not None
        files = _write(scratch, images, drawn, png=png, tags=stated)
        (scratch / "truth.json").write_text(as_json({**truth, **drawn.truth}), "utf-8")
        if made is not None:
            made.save(scratch / AS_MADE)
    if not drawn.shown:
        output.note(f"the field of {chain} does not show everything; see the pixels in truth.json")
    written = [out / name for name in (*files, "truth.json", *([] if made is None else [AS_MADE]))] + bone
    output.written(written)
    output.result({**truth, "frame": frame.key, "side": scene.side, "files": written})


def _bone(file: Path, drawn: "Specimen", seed: int) -> list[Path]:
    """Write the CT of the bone and its true pose; return both files. Raises UnusableInputError."""
    import numpy as np

    from sightline.common.atomic import write_whole
    from sightline.errors import UnusableInputError
    from sightline.imaging.volumes.ct import write_ct
    from sightline.twin.scenes.bone_ct import bone_ct

    if file.suffix.lower() != ".nrrd":
        raise UnusableInputError(f"{file.name} is not an .nrrd; name the CT to write so")
    scan, pose = bone_ct(drawn.scene, drawn.setup.side, np.random.default_rng([seed, _SCANNER]))
    document = as_json({"coordinates": "CFCS", "matrix": pose.as_matrix()})
    return [write_ct(scan, file), write_whole(file.with_suffix(".pose.json"), document.encode())]


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


def _write(folder: Path, images: "dict[str, Radiograph]", drawn: "Specimen", *, png: bool, tags: bool) -> list[str]:
    """Write the images; return the names of their files."""
    from sightline.imaging import write_dicom, write_png
    from sightline.twin.scenes.specimens import nominal_tags

    names = []
    for view, image in images.items():
        names.append(f"{view}.{'png' if png else 'dcm'}")
        if png:
            write_png(image, folder / names[-1])
        else:
            stated = nominal_tags(drawn.setup.views[view], drawn.setup.side) if tags else image.tags
            write_dicom(replace(image, tags=stated), folder / names[-1], drawn.setup.side)
    return names
