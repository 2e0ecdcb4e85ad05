"""The command line, one file per command.

A command lives in `cli/<name>.py`, stands in `_COMMANDS` below and has a function

    def register(app: typer.Typer) -> None:
        app.command("plan", epilog=example("sightline plan ..."))(plan)    # or, for a command with sub-commands:
        app.add_typer(frame_app, name="frame")

The body runs inside one `Output` (cli/output.py), which prints, encodes and turns errors into exit codes:

    def plan(pa: Path, ..., json: Json = False, quiet: Quiet = False) -> None:
        "First line of the docstring: what `sightline --help` lists, at most 60 characters."
        with Output(json=json, quiet=quiet) as out:
            from sightline.planning import ...       # heavy imports here: `sightline --help` stays below 0.5 s
            with out.step("finding beads"):
                ...
            out.table("Points", ("point", "x mm"), rows)
            out.result({"points": points, ...}, checks=verdict.checks)   # exit code 3 where a check failed

At its top a command file imports the standard library, typer and `sightline.cli`, and nothing that is slow. Help is
plain text: Rich would take `[...]` for markup.
"""

import os
import signal
from importlib import import_module
from importlib.util import find_spec
from typing import Annotated

import typer

from sightline import __version__
from sightline.cli.output import Terminated

_COMMANDS = (
    "demo",
    "detect",
    "calibrate",
    "undistort",
    "planning.plan",
    "planning.check_shot",
    "studies.assess",
    "simulate",
    "studies.study",
    "studies.compare",
    "frames.frame",
    "procedure",
    "robots.robot",
    "acquire",
    "app",
    "case",
    "watch",
    "export",
)

commands = typer.Typer(
    name="sightline",
    no_args_is_help=True,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)


def _show_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"sightline {__version__}")
        raise typer.Exit


@commands.callback()
def _sightline(
    version: Annotated[
        bool, typer.Option("--version", callback=_show_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    """Two ordinary C-arm images of a bead frame become a planned guide-wire trajectory with its error bound.

    Every command takes --json and --quiet. Exit codes: 0 done; 2 unusable arguments or files; 3 refused by a check.
    Research software, not a medical device.
    """


for _name in _COMMANDS:
    if find_spec(f"sightline.cli.{_name}"):
        import_module(f"sightline.cli.{_name}").register(commands)


# Matrices here are small: threads of the linear algebra cost more than they save. With them a detection takes twice
# as long [measured on two cores]. The user's own setting takes precedence.
_BLAS_THREADS = ("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


def main() -> None:
    """Entry point of `sightline`."""
    for name in _BLAS_THREADS:
        os.environ.setdefault(name, "1")  # read when numpy is first imported, which no command file does at its top
    # A shell without job control starts background jobs with SIGINT ignored, and Python would leave it ignored.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    signal.signal(signal.SIGTERM, _terminate)
    commands()


def _terminate(*_: object) -> None:
    """End a command on SIGTERM, from a service manager or at a shutdown, as Ctrl-C does."""
    raise Terminated
