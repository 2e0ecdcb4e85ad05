"""`sightline acquire folder | dicom | video | igtl`: acquire images into a case."""

import time
from collections import deque
from collections.abc import Callable, Generator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from sightline.cli.base import Invert, Output, command, group, parse_address

if TYPE_CHECKING:
    from sightline.case.acquire import Acquirer, News
    from sightline.case.acquire.acquirer import Taken
    from sightline.case.acquire.robot import RobotWatch
    from sightline.case.journal import Case
    from sightline.imaging import Source

_REMEMBERED = 1000  # refusals kept for the result, so that a faulty sender does not fill the memory

app = group("acquire", "Acquire images into a case.")

Average = Annotated[int, typer.Option(min=1, max=64, help="Number of frames to average; refused if something moves.")]


@dataclass(frozen=True)
class Into:
    """Where images go, and what is done with each."""

    case: Annotated[Path, typer.Option(help="Folder of the case; created if it does not exist.")]
    robot: Annotated[
        str | None,
        typer.Option(metavar="HOST:PORT", help="Robot whose pose is recorded with each image.", show_default=False),
    ] = None
    invert: Invert = False


@command(app, "folder", "sightline acquire folder images --case out/case")
def folder(
    output: Output,
    *,
    source: Annotated[Path, typer.Argument(metavar="DIR", help="Folder with images.")],
    into: Into,
    watch: Annotated[
        bool, typer.Option("--watch", help="Keep running until Ctrl-C and take each image as it is written.")
    ] = False,
) -> None:
    """Acquire the images of a folder.

    Each image is taken once; with --watch also images that are written later. Other files are reported; exit code 2
    where one of them has the name or content of an image.
    """
    if into.robot and not watch:
        raise typer.BadParameter(
            "needs --watch: nobody knows when a file was taken that exists already",
            param_hint="--robot",
        )
    from sightline.case.acquire.folder import SCAN_S, Folder, check_folder

    check_folder(source)
    with _into(output, into) as desk:
        files = Folder(source, desk.acquirer, desk.tell)
        if watch:
            output.note("watching the folder; stop with Ctrl-C")
            desk.until_interrupted(lambda: files.scan(time.monotonic()), SCAN_S)
        else:
            files.take_all()
        output.result({**desk.document(), "waiting": files.waiting, "unusable": files.unusable})
        desk.end(files.unusable)


@command(app, "dicom", "sightline acquire dicom --peer CARM@192.168.1.20 --case out/case")
def dicom(
    output: Output,
    *,
    peer: Annotated[
        list[str], typer.Option("--peer", metavar="AET@HOST", help="A sender that is allowed; repeat it for several.")
    ],
    into: Into,
    port: Annotated[int, typer.Option(min=0, max=65535, help="Port to listen at; 0 takes a free one.")] = 11112,
    aet: Annotated[str, typer.Option(help="AE title of this receiver.")] = "SIGHTLINE",
    host: Annotated[str, typer.Option(help="Address to listen at; 0.0.0.0 for all networks.")] = "127.0.0.1",
) -> None:
    """Receive images by DICOM C-STORE.

    Runs until Ctrl-C. Each image is on the disk before the sender gets its answer.
    """
    from sightline.case.acquire.dicom import DicomReceiver, Peer

    peers = [Peer.parse(text) for text in peer]
    # The port first: without it no case is created.
    with (
        DicomReceiver(peers, aet=aet, host=host, port=port) as receiver,
        _into(output, into) as desk,
    ):
        with receiver.receiving(desk.acquirer, desk.tell):
            output.note(f"listening at port {receiver.port} as {aet}; stop with Ctrl-C")
            desk.until_interrupted(lambda: None, 0.5)
        output.result({"port": receiver.port, **desk.document()})


@command(app, "video", "sightline acquire video 0 --average 8 --case out/case")
def video(
    output: Output,
    *,
    place: Annotated[str, typer.Argument(help="Device number, video file, stream address or multi-frame DICOM file.")],
    into: Into,
    average: Average = 1,
    skip: Annotated[int, typer.Option(min=0, help="Number of frames to skip first.")] = 0,
    field: Annotated[
        Literal["first", "second"] | None, typer.Option(help="Use one field of interlaced video.", show_default=False)
    ] = None,
    crop: Annotated[
        str | None, typer.Option(metavar="LEFT,TOP,WIDTH,HEIGHT", help="Part of the image to keep, px.")
    ] = None,
) -> None:
    """Acquire one image from video.

    With --average the mean of several frames, if nothing moved.
    """
    from sightline.case.acquire.acquirer import take_frames
    from sightline.imaging.formats import is_image
    from sightline.imaging.sources import Run, VideoSource

    part = _crop(crop)
    is_run = not place.isdigit() and is_image(Path(place))
    if is_run and part is not None:
        raise typer.BadParameter("a multi-frame file cannot be cropped; leave it out", param_hint="--crop")
    at = int(place) if place.isdigit() else place
    source = Run(Path(place)) if is_run else VideoSource(at, crop=part, tell=output.note)
    settings = {"crop": part} if part else {}
    keep = partial(take_frames, field=field, interlaced=not is_run, how=settings)
    _take(output, into, source, (skip + 1, average), keep)


@command(app, "igtl", "sightline acquire igtl 127.0.0.1:18944 --case out/case")
def igtl(
    output: Output,
    *,
    address: Annotated[
        str, typer.Argument(metavar="HOST:PORT", help="Address of the peer; with --listen, the address to listen at.")
    ],
    into: Into,
    listen: Annotated[bool, typer.Option("--listen", help="Wait for the peer to connect.")] = False,
    average: Average = 1,
) -> None:
    """Acquire one image by OpenIGTLink.

    The peer may be 3D Slicer or PLUS. With --average the mean of several frames, if nothing moved.
    """
    from sightline.case.acquire.acquirer import take_frames
    from sightline.case.acquire.igtl import ImageLink

    host, port = parse_address(address)
    link = ImageLink(host, port, listen=listen, tell=output.note)
    if listen:
        output.note(f"waiting at port {link.port}")
    _take(output, into, link, (1, average), lambda *given, **pose: take_frames(*given, **pose, how=link.stated()))


def _take(output: Output, into: Into, source: "Source", asked: tuple[int, int], keep: "Callable[..., Taken]") -> None:
    """Acquire frames of a source as one image by `keep`, with the robot's pose at the last of them.

    `asked`: the number of the first frame, from 1, and how many are averaged. Raises SourceError for too few.
    """
    from sightline.case.acquire import news_of
    from sightline.errors import SourceError

    first, average = asked
    with ExitStack() as stack:
        watch = stack.enter_context(_robot(into.robot)) if into.robot else None
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
        # Only now, so that a failure creates no case.
        desk = stack.enter_context(_into(output, replace(into, robot=None)))
        desk.tell(news_of(keep(desk.acquirer, frames, pose=pose)))
        output.result(desk.document(), checks=[pose.check] if pose else [])


def _crop(text: str | None) -> tuple[int, int, int, int] | None:
    if text is None:
        return None
    try:
        left, top, width, height = (int(part) for part in text.split(","))
    except ValueError:
        raise typer.BadParameter("give four whole numbers: LEFT,TOP,WIDTH,HEIGHT", param_hint="--crop") from None
    return left, top, width, height


class _Desk:
    """Counts the images that a command acquires and reports each on a line."""

    def __init__(self, case: "Case", acquirer: "Acquirer", output: Output) -> None:
        self.acquirer = acquirer
        self._case, self._output = case, output
        self._entries: list[dict[str, Any]] = []
        self._already = 0
        self._refused: deque[str] = deque(maxlen=_REMEMBERED)

    def tell(self, news: "News") -> None:
        """Report one piece of news; sources call it from any thread."""
        if news.kind == "kept" and news.entry is not None:
            content, settings = news.entry.content, news.entry.settings
            self._entries.append({"number": news.entry.number, "original": content["original"], "settings": settings})
            if not settings["acquisition"].get("robot", {}).get("fresh", True):
                self._output.note(
                    f"entry {news.entry.number}: the robot's pose is stale and was not recorded; check the robot's link"
                )
        elif news.kind == "already":
            self._already += 1
        elif news.kind == "refused":
            self._refused.append(news.text)
        (self._output.say if news.kind in ("kept", "already") else self._output.note)(news.text)

    def until_interrupted(self, step: Any, pause_s: float) -> None:
        """Repeat a step until Ctrl-C."""
        try:
            while True:
                step()
                time.sleep(pause_s)
        except KeyboardInterrupt:
            self._output.note("stopping")

    def document(self) -> dict[str, Any]:
        """Return the result: the case, its new entries, and the refusals with their reasons."""
        return {
            "case": self._case.number,
            "entries": self._entries,
            "already_held": self._already,
            "refused": list(self._refused),
        }

    def end(self, unusable: int) -> None:
        """End with exit code 2 for `unusable` images, or if something was refused and nothing was acquired."""
        if unusable:
            self._output.note(f"image files that cannot be used: {unusable}; export them again")
        if unusable or (self._refused and not self._entries and not self._already):
            raise typer.Exit(2)


@contextmanager
def _into(output: Output, into: Into) -> Generator[_Desk]:
    """Open or create a case; the pose of a robot is recorded when an image arrives."""
    from sightline.case.acquire import Acquirer
    from sightline.case.journal import Case

    with ExitStack() as stack:
        pose = stack.enter_context(_robot(into.robot)).now if into.robot else None
        case = stack.enter_context(Case.create(into.case, exist_ok=True))
        for problem in case.problems:
            output.note(f"the case has a problem: {problem.sentence}")
        output.note(f"case {case.number}")
        yield _Desk(case, Acquirer(case, arrival_pose=pose, invert=into.invert), output)


def _robot(address: str) -> "RobotWatch":
    from sightline.case.acquire.robot import RobotWatch

    return RobotWatch(*parse_address(address))
