"""The command line `commands`, how a function becomes one of its commands, and the options that several share."""

import os
import signal
import sys
import traceback
from collections.abc import Callable, Generator, Iterable, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, fields, is_dataclass
from inspect import Parameter, Signature, signature
from itertools import chain
from json import dumps
from pathlib import Path
from time import perf_counter
from types import TracebackType
from typing import TYPE_CHECKING, Annotated, Any, Literal, Self, get_type_hints

import typer
from typer.core import TyperCommand

from sightline.common.checks import Check, advised, failed
from sightline.errors import SightlineError, UnusableInputError

commands = typer.Typer(
    name="sightline",
    no_args_is_help=True,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)


def group(name: str, text: str) -> typer.Typer:
    """Return a new group of commands, `sightline NAME`, with what its help says."""
    made = typer.Typer(no_args_is_help=True, help=text)
    commands.add_typer(made, name=name)
    return made


def _keep(context: typer.Context, option: typer.CallbackParam, value: bool) -> None:
    context.meta[str(option.name)] = value


def _of_every_command(
    json: Annotated[
        bool,
        typer.Option("--json", callback=_keep, expose_value=False, help="Print one JSON document, for machines."),
    ] = False,
    quiet: Annotated[
        bool,
        typer.Option(
            "--quiet", callback=_keep, expose_value=False, help="Print nothing but errors and what --json asks for."
        ),
    ] = False,
    every: Annotated[
        bool, typer.Option("--all", callback=_keep, expose_value=False, help="List the checks that passed, too.")
    ] = False,
) -> None: ...


_alone = typer.Typer(add_completion=False)
_alone.command()(_of_every_command)
_OF_EVERY_COMMAND = typer.main.get_command(_alone).params


class JsonCommand(TyperCommand):
    """A command that takes --json, --quiet and --all, as every command takes --help."""

    def get_params(self, ctx: Any) -> list[Any]:
        """Return the parameters of the command, and those that every command has."""
        own = super().get_params(ctx)
        return [*own[: len(self.params)], *_OF_EVERY_COMMAND, *own[len(self.params) :]]


def command(app: typer.Typer, name: str, *examples: str) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Return the decorator that makes a function the command `name` of `app`; `examples`: lines that a person can copy.

    The function's first parameter is the `Output` of the command, open while it runs. Of the others, one whose type is
    a dataclass stands for its fields: each of them is an argument or an option. The rest are options themselves.
    """

    def register(body: Callable[..., None]) -> Callable[..., None]:
        own = dict(list(signature(body).parameters.items())[1:])
        types = get_type_hints(body, include_extras=True)
        groups = {key: types[key] for key in own if is_dataclass(types[key])}
        spread = [Parameter("context", Parameter.KEYWORD_ONLY, annotation=typer.Context)]
        for key, parameter in own.items():
            members = signature(groups[key]).parameters.values() if key in groups else [parameter]
            hints = get_type_hints(groups[key], include_extras=True) if key in groups else types
            spread += [member.replace(kind=Parameter.KEYWORD_ONLY, annotation=hints[member.name]) for member in members]

        def run(context: typer.Context, **given: Any) -> None:
            with Output(**{name: context.meta[name] for name in ("json", "quiet", "every")}) as output:
                _refuse_overwriting(given)
                for key, group in groups.items():
                    given[key] = group(**{field.name: given.pop(field.name) for field in fields(group)})
                body(output, **given)

        run.__doc__ = body.__doc__
        run.__signature__ = Signature(spread)  # pyright: ignore[reportFunctionMemberAccess] - typer reads it
        run.__annotations__ = {parameter.name: parameter.annotation for parameter in spread}
        app.command(name, cls=JsonCommand, epilog="\b\n" + "\n".join(["Example:", *examples]))(run)
        return body

    return register


_WRITTEN = ("out", "csv", "picture")  # parameters that name a file to write, in some command


def _refuse_overwriting(given: dict[str, Any]) -> None:
    """Raise UnusableInputError where a command would write over a file that it reads."""
    for name in _WRITTEN:
        if not isinstance(target := given.get(name), Path) or not target.is_file():
            continue
        others = [value if isinstance(value, list) else [value] for key, value in given.items() if key != name]
        if any(isinstance(each, Path) and each.exists() and each.samefile(target) for each in chain(*others)):
            raise UnusableInputError(f"{target.name} is given twice, to read and to write; name another file to write")


Invert = Annotated[
    bool,
    typer.Option("--invert", help="Invert the image first: the file shows the balls bright, whatever its header says."),
]
FrameIndex = Annotated[
    int | None, typer.Option("--frame-index", help="Which image of a multi-frame file, from 0.", show_default=False)
]
FrameName = Annotated[str, typer.Option("--frame", help="A frame file, gamma, biplane, stereo or block60.")]
ImagesFrame = Annotated[
    str | None,
    typer.Option(
        "--frame", help="The frame in the image: a frame file, gamma, biplane, stereo or block60.", show_default="gamma"
    ),
]
MethodName = Literal["smooth", "localized", "polynomial"]
Method = Annotated[MethodName, typer.Option("--method", help="Calibration method; localized is the paper's.")]
Mirrored = Annotated[
    list[str] | None,
    typer.Option("--mirrored", help="View, such as pa, whose image is shown mirrored: writing in it reads backwards."),
]


@dataclass(frozen=True)
class Distances:
    """What is known of the C-arm besides the image."""

    sid: Annotated[
        float | None,
        typer.Option(
            min=1.0,
            help="Distance from X-ray source to detector, mm; by default as DICOM states it, if it does.",
            show_default=False,
        ),
    ] = None
    pixel: Annotated[
        float | None,
        typer.Option(
            min=1e-4,
            help="Size of a pixel on the detector, mm; by default as DICOM states it, if it does.",
            show_default=False,
        ),
    ] = None


@dataclass(frozen=True)
class LabellingOptions:
    """How the beads of one image are found and labelled."""

    frame: ImagesFrame = None
    view: Annotated[
        str | None,
        typer.Option(
            help="View of the image, pa or lateral, of a block also oblique; by default as the datum markers show.",
            show_default=False,
        ),
    ] = None
    datum: Annotated[
        list[str] | None,
        typer.Option(help="Pixel of a datum marker, 'ID=U,V', where it is not found; give one for each marker."),
    ] = None
    frame_index: FrameIndex = None
    invert: Invert = False


Spacing = Annotated[
    float | None,
    typer.Option("--spacing", help="Pixel size on the plate, mm; by default as in the image.", show_default=False),
]
Side = Literal["right", "left"]
WireKey = Annotated[
    str | None,
    typer.Option("--wire", help="Key of the wire, where several were planned together.", show_default=False),
]
ServeAt = Annotated[
    list[str] | None,
    typer.Option(
        "--serve",
        metavar="igtl:PORT|ros2:/NAMESPACE",
        help="Show images, poses, plan and verdict to other programs, such as 3D Slicer or RViz. May be repeated.",
        show_default=False,
    ),
]
OutFolder = Annotated[Path, typer.Option("--out", help="Folder for the files.")]


FrameSource = Annotated[
    str, typer.Argument(metavar="FRAME", help="A frame file, or a built-in frame: gamma, biplane, stereo, block60, ...")
]
Rehearsed = Literal["hip-screw", "cannulated-hip-screws", "free-wire", "distal-interlocking"]
Twin = Literal["manipulator", "six-axis", "seven-axis"]  # the simulated arms: `Design`, whose import takes long
Arm = Annotated[
    Twin,
    typer.Option(help="The arm: ours feeds the wire, the others hold the guide while a person drills."),
]


def frame_of_images(output: "Output", given: str | None) -> "Frame":
    """Return the frame in the images, and say first which it is; gamma where none is given. Raises FrameError."""
    from sightline.frame import Frame

    frame = Frame.load(given or "gamma")
    output.say(f"frame: {frame.name}" if given else "frame: gamma (assumed; --frame names another)")
    return frame


def refuse_existing(file: Path | None) -> None:
    """Raise UnusableInputError for a file to be written that exists."""
    from sightline.errors import UnusableInputError

    if file is not None and file.exists():
        raise UnusableInputError(f"{file.name} exists; remove it, or name another file")


def parse_address(text: str) -> tuple[str, int]:
    """Return host and port of 'HOST:PORT'. Raises UnusableInputError."""
    from sightline.errors import UnusableInputError

    host, _, port = text.rpartition(":")
    if not host or not (port.isascii() and port.isdigit() and 0 < int(port) < 65536):
        raise UnusableInputError(f"{text!r} is not an address; write HOST:PORT, for example 127.0.0.1:18936")
    return host, int(port)


if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

    from sightline.case.live import LiveState
    from sightline.common.closing import Closing
    from sightline.frame import Frame

# Typer turns these into exit codes itself.
_PASSED_ON = (typer.Exit, typer.Abort, typer.BadParameter, BrokenPipeError)
_REFUSED, _NOT_VERIFIED, _BUG = 3, 4, 1
_PIPE_COLUMNS = 1000  # [ours] more than any row has
_SIGNALLED = 128  # plus the signal's number, as shells expect


@contextmanager
def serving(at: Sequence[str] | None, state: "Callable[[], LiveState]", output: "Output") -> Generator[None]:
    """Serve the state by OpenIGTLink and ROS 2, where asked for. Raises UnusableInputError, SetUpError, LinkError."""
    with ExitStack() as stack:
        for address in at or ():
            stack.enter_context(_served(address, state, output))
        yield


def _served(address: str, state: "Callable[[], LiveState]", output: "Output") -> "Closing":
    from sightline.case import live_ros2

    if address.startswith(live_ros2.SCHEME):
        reach = os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")  # ROS 2's own default is SUBNET
        publisher = live_ros2.broadcast(address, state)
        output.say(f"ROS 2 at {address.removeprefix(live_ros2.SCHEME)}, discovery range {reach}")
        return publisher
    from sightline.case.live import LiveMessages
    from sightline.robot.transport.broadcast import Broadcast, port_of

    server = Broadcast(LiveMessages(state), port_of(address))
    output.say(f"OpenIGTLink at 127.0.0.1:{server.port}, for programs on this machine")
    return server


class Terminated(KeyboardInterrupt):
    """A signal that ends the program, handled wherever Ctrl-C is."""

    def __init__(self, number: int = signal.SIGTERM) -> None:
        self.signal = signal.Signals(number)


class Output:
    """The output of one command: results go to stdout, progress and errors to stderr.

    With `json`, stdout holds exactly one JSON document: the result, or {"error": {"type", "message"}}. Leaving the
    `with` block turns a SightlineError into its message and exit code, and anything unexpected into one line that
    asks for a report (exit code 1; SIGHTLINE_DEBUG=1 shows the traceback).
    """

    def __init__(self, *, json: bool, quiet: bool, every: bool = False) -> None:
        self._json, self._quiet, self._every = json, quiet, every
        self._told: set[Check] = set()
        self._document: str | None = None
        self._code = 0

    def __enter__(self) -> Self:
        return self

    def step(self, text: str) -> "_Step":
        """`with out.step("finding beads"):` shows the step while it runs, and its time afterwards."""
        return _Step(None if self._silent else _console(stderr=True), text)

    @contextmanager
    def progress(self, text: str, total: int) -> Generator[Callable[[], None]]:
        """`with out.progress("trials", 200) as advance:` shows a bar; call `advance()` after each item."""
        from rich.progress import Progress

        with Progress(console=_console(stderr=True), transient=True, disable=self._silent) as bar:
            task = bar.add_task(text, total=total)
            yield lambda: bar.advance(task)

    def note(self, text: str) -> None:
        """Print a line on stderr, for people."""
        if not self._silent:
            _console(stderr=True).print(text, markup=False, highlight=False)

    def say(self, text: str) -> None:
        """Print a line of the result, for people; the terminal wraps it, so that a path stays one word."""
        if not self._silent:
            _console().print(text, markup=False, highlight=False, soft_wrap=True)

    def written(self, files: Iterable[Path]) -> None:
        """Print the files that were written, for people."""
        for file in files:
            self.say(f"written: {file}")

    def table(self, title: str, columns: Sequence[str], rows: Iterable[Sequence[object]]) -> None:
        """Print a table of the result, for people; None is shown as a dash."""
        if not self._silent:
            self.say(title)  # Rich would break it at the width of the table
            _console().print(_table("", columns, rows))

    def failures(self, checks: Iterable[Check]) -> None:
        """Print the failed checks once, for people, before any table: each with what it means and what to do. First
        those of the bone, last what is missing."""
        for check in advised(checks):
            if check not in self._told:
                self.say(f"FAIL {check.name}: {check.sentence}")
                self._told.add(check)

    @contextmanager
    def live(self, title: str, columns: Sequence[str]) -> Generator[Callable[[Iterable[Sequence[object]]], None]]:
        """`with out.live("Watching", ("", "")) as show:` shows a table, for people, that each `show(rows)` replaces."""
        from rich.live import Live

        if self._silent:
            yield lambda _: None
            return
        with Live(console=_console(stderr=True), refresh_per_second=10) as shown:
            yield lambda rows: shown.update(_table(title, columns, rows))

    def line(self, document: dict[str, Any]) -> None:
        """Print one of many results at once: with --json, a line of its own before the document."""
        if self._json:
            typer.echo(as_json(document))

    def result(self, document: dict[str, Any], checks: Iterable[Check] = (), *, verified: bool = True) -> None:
        """The result of the command, once. With a failed check it ends with exit code 3; with 4 where the work is done
        but nothing shows that it is right.

        People see what failed, unless it was shown before, what informs, and how many passed; with --all every check.
        """
        checks = tuple(checks)
        self._code = _REFUSED if failed(checks) else 0 if verified else _NOT_VERIFIED
        if self._every:
            for check in checks:
                figures = "".join(f"{text}, " for text in (check.value_text, check.limit_text) if text)
                self.say(f"{'pass' if check.passed else 'FAIL'} {check.name}: {figures}{check.sentence}")
        elif checks:
            self.failures(checks)
            sentences = [
                (check.name, check.sentence.removeprefix(f"{check.view}: ")) for check in checks if check.informs
            ]
            for name, sentence in dict.fromkeys(sentences):  # once where both views say it
                self.say(f"note {name}: {sentence}")
            passed = len(checks) - len(failed(checks))
            of_all = "" if passed == len(checks) else f"of {len(checks)} "
            of_all = f"{passed} {of_all}check{'s' if len(checks) > 1 else ''}"
            self.say(f"{of_all} passed; --all lists them")
        self._document = as_json({**document, "checks": checks} if checks else document)

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if error is None or isinstance(error, typer.Exit):
            if self._json and (self._document or error is None):
                typer.echo(self._document or "{}")
            if self._code:
                raise typer.Exit(self._code)
        elif isinstance(error, Terminated):
            self._fail("Interrupted", f"stopped by a signal ({error.signal.name})", _SIGNALLED + error.signal)
        elif isinstance(error, KeyboardInterrupt):
            self._fail("Interrupted", "stopped by the keyboard", _SIGNALLED + signal.SIGINT)
        elif isinstance(error, SightlineError):
            self._fail(type(error).__name__, str(error), error.exit_code)
        elif isinstance(error, OSError) and (message := _disk_error(error)):
            self._fail("UnusableInputError", message, UnusableInputError.exit_code)
        elif isinstance(error, Exception) and not isinstance(error, _PASSED_ON):
            if os.environ.get("SIGHTLINE_DEBUG"):
                traceback.print_exception(error, file=sys.stderr)
            message = f"a bug in Sightline ({type(error).__name__}); set SIGHTLINE_DEBUG=1, run again and report it"
            self._fail("Bug", message, _BUG)

    @property
    def _silent(self) -> bool:
        return self._json or self._quiet

    def _fail(self, kind: str, message: str, code: int) -> None:
        if self._json:
            typer.echo(as_json({"error": {"type": kind, "message": message}}))
        else:
            typer.echo(f"sightline: {message}", err=True)
        raise typer.Exit(code) from None


def as_json(value: Any) -> str:
    """Return JSON of plain values, arrays, dataclasses and paths.

    None is null. Raises ValueError for a number that is not finite, which is a bug.
    """
    from sightline.case.canonical import plain

    return dumps(plain(value), allow_nan=False, default=_path)


def _disk_error(error: OSError) -> str:
    """Return the message of a disk error without the file's name, which may be a patient's; "" for other errors."""
    from sightline.common.atomic import advice, is_of_a_disk

    return f"disk error: {error.strerror}; {advice(error)}" if is_of_a_disk(error) else ""


def _path(value: Any) -> str:
    if not isinstance(value, Path):
        raise TypeError(f"{type(value).__name__} cannot be written as JSON")
    return str(value)


def _table(title: str, columns: Sequence[str], rows: Iterable[Sequence[object]]) -> "Table":
    from rich import box
    from rich.table import Table
    from rich.text import Text

    table = Table(title=Text(title) if title else None, title_justify="left", box=box.SIMPLE)
    for column in columns:
        table.add_column(Text(column))
    for row in rows:
        table.add_row(*(Text("-" if cell is None else str(cell)) for cell in row))
    return table


class _Step:
    """A step of work: its name while it runs, its time afterwards."""

    def __init__(self, console: "Console | None", text: str) -> None:
        self._console, self._text = console, text

    def __enter__(self) -> None:
        from rich.markup import escape

        self._started = perf_counter()
        self._status = self._console.status(escape(self._text)) if self._console else None
        if self._status:
            self._status.start()

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if self._status:
            self._status.stop()
        if self._console and kind is None:
            text = f"{self._text}: {perf_counter() - self._started:.1f} s"
            self._console.print(text, markup=False, highlight=False)


def _console(*, stderr: bool = False) -> "Console":
    """Return a console on the current stream; tests replace the streams. In a pipe a row of a table stays one line."""
    from rich.console import Console

    console = Console(stderr=stderr)
    if not console.is_terminal and "COLUMNS" not in os.environ:
        console.width = _PIPE_COLUMNS
    return console
