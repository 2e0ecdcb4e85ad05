"""`sightline acquire folder | dicom | video | igtl`: images from real sources into a case."""

import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from sightline.cli.output import Json, Output, Quiet

if TYPE_CHECKING:
    from sightline.case.acquire import Acquirer, News
    from sightline.case.acquire.robot import RobotWatch
    from sightline.case.journal import Case
    from sightline.imaging import Source

_REMEMBERED = 1000  # refusals, for the result: who sends rubbish for days fills no memory

app = typer.Typer(
    no_args_is_help=True, help="Take images into a case: from a folder, a DICOM sender, video, OpenIGTLink."
)

CaseFolder = Annotated[Path, typer.Option("--case", help="Folder of the case; a new one is made where there is none.")]

Average = Annotated[int, typer.Option(min=1, max=64, help="How many frames to average, if nothing moves.")]
Robot = Annotated[
    str | None, typer.Option(metavar="HOST:PORT", help="Write the robot's pose of that moment too.", show_default=False)
]


def register(parent: typer.Typer) -> None:
    """Add the commands."""
    parent.add_typer(app, name="acquire")


@app.command("folder")
def folder(
    source: Annotated[Path, typer.Argument(metavar="DIR", help="Folder with images: DICOM, PNG, TIFF, BMP, NumPy.")],
    *,
    case: CaseFolder,
    watch: Annotated[
        bool, typer.Option("--watch", help="Go on until Ctrl-C: take images as they are written.")
    ] = False,
    robot: Robot = None,
    json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Take the images of a folder into a case, each once; with --watch those that come later too."""
    if robot and not watch:
        raise typer.BadParameter("goes with --watch: images that lie there already are older", param_hint="--robot")
    with Output(json=json, quiet=quiet) as out:
        from sightline.case.acquire.folder import SCAN_S, Folder, check_folder

        check_folder(source)
        with _into(case, out, robot) as desk:
            files = Folder(source, desk.acquirer, desk.tell)
            if watch:
                out.note("watching the folder; stop with Ctrl-C")
                desk.until_interrupted(lambda: files.scan(time.monotonic()), SCAN_S)
            else:
                files.take_all()
            out.result({**desk.document(), "waiting": files.waiting})
            desk.end()


@app.command("dicom")
def dicom(
    *,
    peer: Annotated[list[str], typer.Option("--peer", metavar="AET@HOST", help="Who may send; give it for each.")],
    case: CaseFolder,
    port: Annotated[int, typer.Option(min=0, max=65535, help="0 takes a free one.")] = 11112,
    aet: Annotated[str, typer.Option(help="Our AE title.")] = "SIGHTLINE",
    host: Annotated[str, typer.Option(help="Address to listen at; 0.0.0.0 for the network.")] = "127.0.0.1",
    robot: Robot = None,
    json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Receive images by DICOM C-STORE into a case until Ctrl-C; each is on the disk before it is answered."""
    with Output(json=json, quiet=quiet) as out:
        from sightline.case.acquire.dicom import DicomReceiver, Peer

        peers = [Peer.parse(text) for text in peer]
        # The port first: where it cannot be had, no case is made.
        with DicomReceiver(peers, aet=aet, host=host, port=port) as receiver, _into(case, out, robot) as desk:
            with receiver.receiving(desk.acquirer, desk.tell):
                out.note(f"listening at port {receiver.port} as {aet}; stop with Ctrl-C")
                desk.until_interrupted(lambda: None, 0.5)
            out.result({"port": receiver.port, **desk.document()})


@app.command("video")
def video(
    place: Annotated[str, typer.Argument(help="Number of a device, a video file, a stream's address, a DICOM run.")],
    *,
    case: CaseFolder,
    average: Average = 1,
    skip: Annotated[int, typer.Option(min=0, help="Frames to pass over first.")] = 0,
    field: Annotated[
        Literal["first", "second"] | None, typer.Option(help="Of interlaced video one field alone.", show_default=False)
    ] = None,
    crop: Annotated[str | None, typer.Option(metavar="LEFT,TOP,WIDTH,HEIGHT", help="Part of the picture, px.")] = None,
    robot: Robot = None,
    json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Take one image of a video source into a case, or the mean of several if nothing moved."""
    with Output(json=json, quiet=quiet) as out:
        from sightline.imaging.source import Run
        from sightline.imaging.video import VideoSource

        part = _crop(crop)
        is_run = not place.isdigit() and _is_image(Path(place))
        if is_run and part is not None:
            raise typer.BadParameter("a run is taken whole", param_hint="--crop")
        at = int(place) if place.isdigit() else place
        source = Run(Path(place)) if is_run else VideoSource(at, crop=part, tell=out.note)
        how = {"crop": part} if part else {}
        options = {"field": field, "interlaced": not is_run}
        _take(out, case, source, first=skip + 1, average=average, robot=robot, options=options, how=lambda: how)


@app.command("igtl")
def igtl(
    address: Annotated[
        str, typer.Argument(metavar="HOST:PORT", help="The peer; with --listen where it is waited for.")
    ],
    *,
    case: CaseFolder,
    listen: Annotated[bool, typer.Option("--listen", help="Wait for the peer instead of calling it.")] = False,
    average: Average = 1,
    robot: Robot = None,
    json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Take one image of an OpenIGTLink peer (3D Slicer, PLUS) into a case, or the mean of several."""
    with Output(json=json, quiet=quiet) as out:
        from sightline.case.acquire.igtl import ImageLink
        from sightline.cli.robot import parse_address

        host, port = parse_address(address)
        link = ImageLink(host, port, listen=listen, tell=out.note)
        if listen:
            out.note(f"waiting at port {link.port}")
        _take(out, case, link, first=1, average=average, robot=robot, options={}, how=link.stated)


def _take(
    out: Output,
    case: Path,
    source: "Source",
    *,
    first: int,
    average: int,
    robot: str | None,
    options: dict[str, Any],
    how: Callable[[], dict[str, Any]],
) -> None:
    """Frames `first` and following of a source, as one image, with the robot's pose at the last of them."""
    from sightline.case.acquire import news_of
    from sightline.case.acquire.frames import take_frames
    from sightline.errors import SourceError

    with ExitStack() as stack:
        watch = stack.enter_context(_robot(robot)) if robot else None
        stack.callback(source.close)
        frames, pose = [], None
        for frame in source:
            pose = watch.now() if watch else None
            if frame.number >= first:
                frames.append(frame)
            if len(frames) == average:
                break
        if len(frames) < average:
            raise SourceError(f"the source ended after {len(frames)} of {average} images; ask for fewer")
        desk = stack.enter_context(_into(case, out))  # now that there is something to take
        desk.tell(news_of(take_frames(desk.acquirer, frames, pose=pose, how=how(), **options)))
        out.result(desk.document(), checks=[pose.check] if pose else [])


def _crop(text: str | None) -> tuple[int, int, int, int] | None:
    if text is None:
        return None
    try:
        left, top, width, height = (int(part) for part in text.split(","))
    except ValueError:
        raise typer.BadParameter("four whole numbers: LEFT,TOP,WIDTH,HEIGHT", param_hint="--crop") from None
    return left, top, width, height


def _is_image(file: Path) -> bool:
    from sightline.bounded import regular_file
    from sightline.imaging import suffix_of

    if not file.is_file():
        return False
    with regular_file(file) as stream:
        return suffix_of(stream.read(132)) is not None


class _Desk:
    """Where images of a command arrive: they are counted, and told of line by line."""

    def __init__(self, case: "Case", acquirer: "Acquirer", out: Output) -> None:
        self.acquirer = acquirer
        self._case, self._out = case, out
        self._entries: list[dict[str, Any]] = []
        self._already = 0
        self._refused: deque[str] = deque(maxlen=_REMEMBERED)

    def tell(self, news: "News") -> None:
        """Sources call it, from any thread."""
        if news.kind == "kept" and news.entry is not None:
            content, settings = news.entry.content, news.entry.settings
            self._entries.append({"number": news.entry.number, "original": content["original"], "settings": settings})
            if not settings["acquisition"].get("robot", {}).get("fresh", True):
                self._out.note(f"entry {news.entry.number}: pose stale, none is written; look at the robot's link")
        elif news.kind == "already":
            self._already += 1
        elif news.kind == "refused":
            self._refused.append(news.text)
        (self._out.say if news.kind in ("kept", "already") else self._out.note)(news.text)

    def until_interrupted(self, step: Any, pause_s: float) -> None:
        """Do a step again and again; Ctrl-C is how it ends."""
        try:
            while True:
                step()
                time.sleep(pause_s)
        except KeyboardInterrupt:
            self._out.note("stopping")

    def document(self) -> dict[str, Any]:
        """The result: the case, its new entries, what was refused and why."""
        return {
            "case": self._case.number,
            "entries": self._entries,
            "already_held": self._already,
            "refused": list(self._refused),
        }

    def end(self) -> None:
        """Exit code 2 where nothing could be taken and something was refused."""
        if self._refused and not self._entries and not self._already:
            raise typer.Exit(2)


@contextmanager
def _into(folder: Path, out: Output, robot: str | None = None) -> Iterator[_Desk]:
    """A case that is there, or a new one; `robot`: whose pose is written when an image arrives."""
    from sightline.case.acquire import Acquirer
    from sightline.case.journal import Case

    with ExitStack() as stack:
        pose = stack.enter_context(_robot(robot)).now if robot else None
        case = stack.enter_context(Case.create(folder, exist_ok=True))
        for problem in case.problems:
            out.note(f"the case has a problem: {problem.sentence}")
        out.note(f"case {case.number}")
        yield _Desk(case, Acquirer(case, arrival_pose=pose), out)


def _robot(address: str) -> "RobotWatch":
    from sightline.case.acquire.robot import RobotWatch
    from sightline.cli.robot import parse_address

    return RobotWatch(*parse_address(address))
