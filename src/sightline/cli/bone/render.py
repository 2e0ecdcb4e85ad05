"""`sightline render`: the radiograph that a view would see of a CT or a mesh."""

import re
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sightline.cli.base import Output, command, commands

if TYPE_CHECKING:
    from sightline.calibration import CalibratedView
    from sightline.case.views import CalibratedImage
    from sightline.frame import Frame
    from sightline.imaging.volumes import CtScan

    Seen = tuple[CalibratedView, tuple[int, int] | None]

VIEW_HELP = (
    "File of a view: a matrix of 3x4 numbers, of another program, of `sl.save`; or the folder of a case. NAME, such as "
    "pa, where it holds several"
)


@dataclass(frozen=True)
class VolumeFile:
    """The CT or mesh of a bone."""

    what: Annotated[
        Path,
        typer.Argument(
            metavar="CT|MESH", help="CT (NIfTI, NRRD, folder of slices), or closed mesh in mm (STL, PLY, OBJ)."
        ),
    ]
    cortex: Annotated[
        float | None, typer.Option(help="Cortex of a mesh, mm.", show_default="3: a femur has 1 to 5")
    ] = None

    def read(self) -> "CtScan":
        """Return the CT, or the mesh as one. Raises UnusableInputError."""
        from sightline.from_images.registration import read_volume

        return read_volume(self.what, self.cortex)


@command(
    commands,
    "render",
    "sightline render hip.nrrd --view pa.opencv.json --pose pose.tfm --out drr.dcm",
    "sightline render femur.stl --view matrix.csv --size 1024x1024 --out drr.png",
    "sightline render hip.nrrd --view pa:out/demo/case --out drr.png",
)
def render(
    output: Output,
    *,
    subject: VolumeFile,
    view: Annotated[str, typer.Option(metavar="[NAME:]VIEW", help=f"{VIEW_HELP}.")],
    pose: Annotated[
        Path | None,
        typer.Option(
            help="Rigid transform from the CT's or mesh's coordinates to the view's: 4x4 in JSON, or .tfm of ITK; by "
            "default they are the same.",
            show_default=False,
        ),
    ] = None,
    out: Annotated[Path, typer.Option(metavar="FILE", help="Image to write: .dcm, or .png of 16 bits.")],
    size: Annotated[
        str | None,
        typer.Option(metavar="WxH", help="Image size, px; needed where the view states none.", show_default=False),
    ] = None,
) -> None:
    """Render the radiograph that a view would see of a CT.

    Pixels are 65535 exp(-integral of the attenuation at 60 keV). A CT's coordinates are DICOM's: to the patient's left,
    back and head.
    """
    from sightline.calibration.exchange.pose_file import read_pose
    from sightline.errors import UnusableInputError
    from sightline.from_images.registration.render import render as rendered
    from sightline.imaging import write_dicom, write_png

    write = {".dcm": write_dicom, ".png": write_png}.get(out.suffix.lower())
    if write is None:
        raise UnusableInputError(f"{out.name} is neither .dcm nor .png; name the image to write so")
    given = None if size is None else _shape(size)
    seen, stated = read_seen(view)
    placed = None if pose is None else read_pose(pose)
    with output.step("reading"):
        volume = subject.read()
    with output.step("casting rays"):
        image = rendered(volume, seen, placed, given or stated)
    write(image, out)
    output.written([out])
    output.result({"view": seen.name, "shape": image.shape, "white": image.white, "file": out})


def read_seen(given: str) -> "Seen":
    """Return the view in `[NAME:]PATH`, a file or the folder of a case, and its image's shape if the file states it.

    Of a case it is the newest calibration of that view, computed again. Raises SightlineError.
    """
    from sightline.calibration.exchange.formats import read_view
    from sightline.case.saved.files import saved_views

    name, colon, path = given.partition(":")
    name, file = (name, Path(path)) if colon and len(name) > 1 else (None, Path(given))  # C:\... is a path of Windows
    if file.is_dir():
        calibrated = {each.name: each.view for each in newest_of_case(file, name)[0]}
        return calibrated[_one_of(calibrated, name, file)], None
    if (saved := saved_views(file)) is not None:
        views = {each.name: each for each in saved}
        return views[_one_of(views, name, file)], None
    pinhole = read_view(file, name=name)
    return pinhole.view(), pinhole.shape


def newest_of_case(folder: Path, name: str | None = None) -> "tuple[list[CalibratedImage], Frame]":
    """Return a case's newest calibrated image of each view, or of the view `name` alone if there is one, computed
    again, and their frame. Raises CaseError, and UnusableInputError for images of several frames.
    """
    from sightline.case.journal import Case, Kind
    from sightline.case.replay import Recomputed
    from sightline.case.stages import frame_of
    from sightline.errors import UnusableInputError

    with Case.open(folder, read_only=True) as case:
        newest = {str(entry.content["view"]): entry for entry in case.entries(Kind.CALIBRATED)}
        again = Recomputed(case)
        chosen = [newest[view] for view in ([name] if name in newest else newest)]
        frames = sorted({str(entry.settings["frame"]) for entry in chosen})
        if len(frames) != 1:
            raise UnusableInputError(
                f"the newest views of {folder.name} are of {len(frames)} frames; calibrate all in one frame"
            )
        return [again.calibrated(entry) for entry in chosen], frame_of(case, frames[0])


def _one_of(views: Iterable[str], name: str | None, place: Path) -> str:
    """Return the name of the view that is meant. Raises UnusableInputError."""
    from sightline.errors import UnusableInputError

    known = list(views)
    chosen = known[0] if name is None and len(known) == 1 else name
    if chosen not in known:
        raise UnusableInputError(
            f"{place.name} holds {', '.join(known) or 'no views'}; choose one: --view NAME:{place.name}"
        )
    return chosen


def _shape(size: str) -> tuple[int, int]:
    """Return the height and width of 'WxH'. Raises UnusableInputError."""
    from sightline.errors import UnusableInputError

    found = re.fullmatch(r"(\d{1,5})x(\d{1,5})", size)
    if found is None:
        raise UnusableInputError(f"--size {size!r} is not WIDTHxHEIGHT in pixels, for example 1024x1024")
    return int(found[2]), int(found[1])
