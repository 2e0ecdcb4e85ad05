"""`sightline register-bone`: where the bone of a CT or mesh lies in two images or more."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from sightline.cli.base import ImagesFrame, Output, Side, as_json, command, commands, frame_of_images
from sightline.cli.bone.render import VIEW_HELP, VolumeFile, newest_of_case, read_seen

if TYPE_CHECKING:
    import numpy as np

    from sightline.calibration import CalibratedView
    from sightline.case.views import CalibratedImage
    from sightline.frame import Frame
    from sightline.from_images.ct_wire import CtWire
    from sightline.from_images.registration import BonePose, BoneStart
    from sightline.imaging import Radiograph


@dataclass(frozen=True, eq=False)
class SeenBone:
    """Images and their views, the names or digests of the images' files, and the frame whose beads they show."""

    images: "list[Radiograph]"
    views: "list[CalibratedView]"
    sources: list[str]
    frame: "Frame | None" = None


@dataclass(frozen=True)
class ShotFiles:
    """The images that show the bone, and their views."""

    images: Annotated[
        list[Path] | None,
        typer.Argument(metavar="IMAGE...", help="Images, two or more; without --view PA, lateral, oblique."),
    ] = None
    view: Annotated[
        list[str] | None,
        typer.Option(
            metavar="[NAME:]VIEW",
            help=f"{VIEW_HELP}. One for each image, in their order; by default calibrated from the beads in it.",
        ),
    ] = None
    frame: ImagesFrame = None
    case: Annotated[
        Path | None,
        typer.Option(
            help="Folder of a case: its newest image and calibration of each view, instead of images and views.",
            show_default=False,
        ),
    ] = None

    def read(self, output: Output) -> SeenBone:
        """Return the images and their views. Raises UnusableInputError, and what reading and calibrating raise."""
        from sightline.case.stages import given_images
        from sightline.case.views import calibrate_images
        from sightline.errors import UnusableInputError
        from sightline.imaging import read_image

        files, views = self.images or [], self.view or []
        if self.case is not None:
            if files or views or self.frame:
                raise UnusableInputError("--case gives images and views; leave the others out")
            return _of_beads(*newest_of_case(self.case))
        if len(files) < 2 or len(views) not in (0, len(files)):
            raise UnusableInputError(
                f"{len(files)} images and {len(views)} views are given; give two images or more, and --view for each "
                "in the same order or for none, or --case"
            )
        if not views:
            frame = frame_of_images(output, self.frame)
            return _of_beads(calibrate_images(given_images(files, frame).seen, frame, "smooth"), frame)
        if self.frame:
            raise UnusableInputError("--view gives the views; leave out --frame, which is for images with beads")
        images, seen = [read_image(file) for file in files], [read_seen(view)[0] for view in views]
        return SeenBone(images, seen, [digest_of(file) for file in files])


def _of_beads(calibrated: "Sequence[CalibratedImage]", frame: "Frame") -> SeenBone:
    """Return images that show the beads that their views were calibrated from. Raises UnusableInputError."""
    from sightline.errors import UnusableInputError

    images = [each.seen.image for each in calibrated if each.seen.image is not None]
    if len(images) < max(2, len(calibrated)):
        raise UnusableInputError("two calibrated images are needed, no tables of beads; give or acquire them")
    return SeenBone(images, [each.view for each in calibrated], [each.seen.source for each in calibrated], frame)


@dataclass(frozen=True)
class Beginning:
    """About where the bone lies."""

    start: Annotated[
        Path | None,
        typer.Option(
            metavar="POSE",
            help="Pose within 10 mm and 10° of the bone's: 4x4 in JSON, or .tfm of ITK. Without a start all "
            "rotations are tried.",
            show_default=False,
        ),
    ] = None
    points: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Two named points or more of the CT or mesh: markups of 3D Slicer (.mrk.json), or CSV "
            "name,coordinates,x_mm,y_mm,z_mm with the coordinates LPS or RAS. Needs --clicks.",
            show_default=False,
        ),
    ] = None
    clicks: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Pixels of the points in the images: CSV name,view,u,v.", show_default=False),
    ] = None

    def read(self, shown: SeenBone) -> "BoneStart | None":
        """Return the start. Raises UnusableInputError, and what reading and triangulating raise."""
        from sightline.calibration.exchange.markups import read_points
        from sightline.calibration.exchange.pose_file import read_pose
        from sightline.errors import UnusableInputError
        from sightline.from_images.registration import BoneStart
        from sightline.from_images.registration.clicks import read_clicks, start_of_clicks

        if (self.points is None) != (self.clicks is None):
            raise UnusableInputError("--points and --clicks belong together; give both")
        if self.points is None or self.clicks is None:
            return None if self.start is None else BoneStart(read_pose(self.start))
        if self.start is not None:
            raise UnusableInputError("--start and --points both give a start; leave one out")
        return start_of_clicks(read_points(self.points), read_clicks(self.clicks), shown.views)


@dataclass(frozen=True)
class LineOfCt:
    """A wire that was planned on the CT or mesh."""

    line: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Wire planned on the CT or mesh: entry, then end, in a file like that of --points. It is placed in "
            "the calibration frame, and judged as a plan.",
            show_default=False,
        ),
    ] = None
    procedure: Annotated[
        str | None,
        typer.Option(
            help="What the wire is for; sets its limits. One that asks for checks against the bone leaves the wire "
            "incomplete.",
            show_default="free-wire",
        ),
    ] = None
    side: Annotated[Side | None, typer.Option(help="Side of the patient; a robot needs it.", show_default=False)] = None

    def read(self) -> "np.ndarray | None":
        """Return entry and end (2, 3) in the coordinates of the CT or mesh. Raises UnusableInputError."""
        import numpy as np

        from sightline.calibration.exchange.markups import read_points
        from sightline.errors import UnusableInputError

        if self.line is None:
            if self.procedure or self.side:
                raise UnusableInputError(
                    "--procedure and --side are those of a wire; give it with --line, or leave them"
                )
            return None
        points = read_points(self.line)
        names = [name.lower() for name in points]
        if len(points) != 2 or names[0] in ("end", "tip") or names[1] == "entry":
            raise UnusableInputError(
                f"{self.line.name} holds {', '.join(points)[:80]}; give two points, the entry first"
            )
        return np.array(list(points.values()))

    def placed(self, ends_mm: "np.ndarray", found: "BonePose") -> "CtWire":
        """Return the wire in CFCS. Raises UnusableInputError."""
        from sightline.from_images.ct_wire import ct_wire
        from sightline.planning import kind

        return ct_wire(found, ends_mm, kind(self.procedure or "free-wire"), self.side)


@command(
    commands,
    "register-bone",
    "sightline register-bone out/bone.nrrd out/hip/pa.dcm out/hip/lateral.dcm \\",
    "  --out out/bone-pose",
    "sightline register-bone hip.nrrd ap.png lateral.png --start start.json \\",
    "  --view ap.opencv.json --view lateral.opencv.json --out out/bone-pose",
    "sightline register-bone femur.stl --case mycase --points femur.mrk.json \\",
    "  --clicks clicks.csv --out out/bone-pose",
)
def register_bone(
    output: Output,
    *,
    volume: VolumeFile,
    shots: ShotFiles,
    beginning: Beginning,
    wire: LineOfCt,
    out: Annotated[Path | None, typer.Option(help="Folder for the pose, for 3D Slicer too, and a picture.")] = None,
) -> None:
    """Find the pose of a bone's CT or mesh in two images.

    The CT holds one bone, as it is now. Exit code 3 where a check failed; the files are written all the same.
    """
    from sightline import register_bone as registered
    from sightline.case.interop.bone import slicer_files
    from sightline.case.saved import document as saved_document

    with output.step("reading"):
        shown = shots.read(output)
        start, line = beginning.read(shown), wire.read()
        scan = volume.read()
    with output.step("registering the bone"):
        found = registered(scan, shown.images, shown.views, start)
    for sentence in found.sentences():
        output.say(sentence)
    placed = None if line is None else wire.placed(line, found)
    if placed is not None:
        _say(output, placed)
    document = saved_document(found)
    plan = {} if placed is None else {**placed.document(), **_identity(shown)}
    if out is not None:
        output.written(_write(out, placed or found, slicer_files(found), document, plan))
    if plan:
        document["plan"] = plan
    output.result(document, found.checks if placed is None else placed.verdict.checks)


def _identity(shown: SeenBone) -> dict[str, Any]:
    """Return the images and the frame of a plan, by which a robot knows whether it was registered with them."""
    from sightline.case.interop.plan_file import frame_document

    named = zip(shown.views, shown.sources, strict=True)
    return {
        "views": [{"view": view.name, "source": source} for view, source in named],
        "frame": None if shown.frame is None else frame_document(shown.frame),
    }


def _say(output: Output, placed: "CtWire") -> None:
    for line in placed.summary().splitlines()[:4]:
        output.say(line)


def _write(
    folder: Path,
    drawn: "BonePose | CtWire",
    for_slicer: dict[str, bytes],
    document: dict[str, Any],
    plan: dict[str, Any],
) -> list[Path]:
    """Write pose, picture, and plan if there is one; return the files."""
    from sightline.case.interop.plan_file import sealed
    from sightline.common.atomic import write_folder

    files = {"bone-pose.json": as_json(document).encode(), **for_slicer}
    if plan:
        files["plan.json"] = as_json(sealed(plan)).encode()
    return write_folder(folder, files | {"bone.png": drawn.png()})


def digest_of(path: Path) -> str:
    """Return the SHA-256 of a file."""
    from hashlib import file_digest

    with path.open("rb") as stream:
        return f"sha256:{file_digest(stream, 'sha256').hexdigest()}"
