"""The command line `commands`, how a function becomes one of its commands, and the options that several share."""

from collections.abc import Callable
from dataclasses import MISSING, dataclass, fields, is_dataclass
from inspect import Parameter, Signature, signature
from pathlib import Path
from typing import Annotated, Any, Literal, get_type_hints

import typer
from typer.core import TyperCommand

from sightline.cli.output import Output

commands = typer.Typer(
    name="sightline",
    no_args_is_help=True,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
_EMPTY = Parameter.empty


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
) -> None: ...


_alone = typer.Typer(add_completion=False)
_alone.command()(_of_every_command)
_OF_EVERY_COMMAND = typer.main.get_command(_alone).params


class JsonCommand(TyperCommand):
    """A command that takes --json and --quiet, as every command takes --help."""

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
            if key in groups:
                spread += _fields(groups[key])
            else:
                spread.append(_parameter(key, types[key], parameter.default))

        def run(context: typer.Context, **given: Any) -> None:
            with Output(json=context.meta["json"], quiet=context.meta["quiet"]) as output:
                for key, group in groups.items():
                    given[key] = group(**{field.name: given.pop(field.name) for field in fields(group)})
                body(output, **given)

        run.__doc__ = body.__doc__
        run.__signature__ = Signature(spread)  # pyright: ignore[reportFunctionMemberAccess] - typer reads it
        run.__annotations__ = {parameter.name: parameter.annotation for parameter in spread}
        app.command(name, cls=JsonCommand, epilog="\b\n" + "\n".join(["Example:", *examples]))(run)
        return body

    return register


def _fields(group: type[Any]) -> list[Parameter]:
    types = get_type_hints(group, include_extras=True)
    return [
        _parameter(field.name, types[field.name], _EMPTY if field.default is MISSING else field.default)
        for field in fields(group)
    ]


def _parameter(name: str, annotation: Any, default: Any) -> Parameter:
    return Parameter(name, Parameter.KEYWORD_ONLY, annotation=annotation, default=default)


Invert = Annotated[
    bool,
    typer.Option("--invert", help="Invert the image first: the file shows the balls bright, whatever its header says."),
]
FrameIndex = Annotated[
    int | None, typer.Option("--frame-index", help="Which image of a multi-frame file, from 0.", show_default=False)
]
FrameName = Annotated[str, typer.Option("--frame", help="A frame file, gamma, biplane, stereo or block60.")]
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

    frame: FrameName = "gamma"
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
Seed = Annotated[int, typer.Option("--seed", min=0, help="The same seed gives the same files.")]
OutFolder = Annotated[Path, typer.Option("--out", help="Folder for the files.")]


FrameSource = Annotated[
    str, typer.Argument(metavar="FRAME", help="A frame file, or a built-in frame: gamma, biplane, stereo, block60, ...")
]
Rehearsed = Literal["hip-screw", "cannulated-hip-screws", "free-wire", "distal-interlocking"]


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
