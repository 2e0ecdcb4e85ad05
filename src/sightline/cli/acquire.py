"""`sightline acquire folder | dicom`: images from real sources into a case."""

import time
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from sightline.cli.output import Json, Output, Quiet

if TYPE_CHECKING:
    from sightline.case.acquire import Acquirer, News
    from sightline.case.journal import Case

_REMEMBERED = 1000  # refusals, for the result: who sends rubbish for days fills no memory

app = typer.Typer(no_args_is_help=True, help="Take images from folders and DICOM senders into a case.")

CaseFolder = Annotated[Path, typer.Option("--case", help="Folder of the case; a new one is made where there is none.")]


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
    json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Take the images of a folder into a case, each once; with --watch those that come later too."""
    with Output(json=json, quiet=quiet) as out, _into(case, out) as desk:
        from sightline.case.acquire_folder import SCAN_S, Folder

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
    json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Receive images by DICOM C-STORE into a case until Ctrl-C; each is on the disk before it is answered."""
    with Output(json=json, quiet=quiet) as out, _into(case, out) as desk:
        from sightline.case.acquire_dicom import DicomReceiver, Peer

        peers = [Peer.parse(text) for text in peer]
        with DicomReceiver(desk.acquirer, peers, desk.tell, aet=aet, host=host, port=port) as receiver:
            out.note(f"listening at port {receiver.port} as {aet}; stop with Ctrl-C")
            desk.until_interrupted(lambda: None, 0.5)
        out.result({"port": receiver.port, **desk.document()})


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
def _into(folder: Path, out: Output) -> Iterator[_Desk]:
    """A case that is there, or a new one."""
    from sightline.case.acquire import Acquirer
    from sightline.case.journal import JOURNAL, Case

    with Case.open(folder) if (folder / JOURNAL).is_file() else Case.create(folder) as case:
        for problem in case.problems:
            out.note(f"the case has a problem: {problem.sentence}")
        out.note(f"case {case.number}")
        yield _Desk(case, Acquirer(case), out)
