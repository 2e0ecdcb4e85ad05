"""The command line, one file per command or group of commands.

A command lives in a file that `_FILES` below names ("frame.make" is frame/make.py), and is a function decorated so:

    @command(commands, "plan", "sightline plan ...")      # the lines are the example in its help
    def plan(output: Output, pa: Annotated[Path, typer.Argument(help=...)], options: PlanOptions) -> None:
        "First line of the docstring: what `sightline --help` lists, at most 60 characters."
        from sightline.planning import ...       # heavy imports here: `sightline --help` stays below 0.5 s
        with output.step("finding beads"):
            ...
        output.table("Points", ("point", "x mm"), rows)
        output.result({"points": points, ...}, checks=verdict.checks)   # exit code 3 where a check failed

`Output` (cli/base.py) prints, encodes and turns errors into exit codes; every command takes its --json and --quiet.
A parameter whose type is a dataclass (`PlanOptions`) stands for its fields (cli/base.py).

At its top a command file imports the standard library, typer and `sightline.cli`, and nothing that is slow. Help is
plain text: Rich would take `[...]` for markup.
"""

import codecs
import os
import signal
import sys
from importlib import import_module
from io import TextIOWrapper
from typing import Annotated

import typer

from sightline import __version__
from sightline.cli.base import Terminated, commands

_FILES = (  # in the order in which `sightline --help` lists their commands
    "demo",
    "calibrate",
    "plan",
    "check_shot",
    "biplane.grid",
    "biplane.undistort",
    "biplane.reconstruct",
    "biplane.balls",
    "twin.simulate",
    "bone.render",
    "bone.register_bone",
    "twin.study",
    "frame.make",
    "frame.measured",
    "procedure",
    "robot.commands",
    "robot.drive",
    "acquire",
    "app",
    "case",
    "watch",
    "export",
    "bone.export_bone",
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

    Every command takes --json and --quiet. Exit codes: 0 done; 2 unusable arguments or files; 3 refused by a
    check; 4 done, but not verified; 5 not all asked.
    Research software, not a medical device.
    """


for _file in _FILES:
    import_module(f"sightline.cli.{_file}")


# Matrices here are small: threads of the linear algebra cost more than they save. With them a detection takes twice
# as long [measured on two cores]. The user's own setting takes precedence.
_BLAS_THREADS = ("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


def main() -> None:
    """Entry point of `sightline`."""
    for name in _BLAS_THREADS:
        os.environ.setdefault(name, "1")  # read when numpy is first imported, which no command file does at its top
    codecs.register_error(_spell_out.__name__, _spell_out)
    for stream in (sys.stdin, sys.stdout, sys.stderr):
        if isinstance(stream, TextIOWrapper):
            # A pipe on Windows has no "σ", another no "°": that is no reason to fail when all files are written. Every
            # command prints to these streams, by `Output` and typer; files are written in UTF-8.
            stream.reconfigure(errors=_spell_out.__name__)
    # A shell without job control starts background jobs with SIGINT ignored, and Python would leave it ignored.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    for number in _ends():
        signal.signal(number, _terminate)
    commands()


# What the messages use beyond ASCII, for streams that lack it: units would be lost as "?" [ours].
_SPELT = {
    "°": "deg", "σ": "s.d.", "χ": "chi", "Γ": "gamma", "µ": "u", "ø": "diameter ", "±": "+/-", "·": "*", "×": "x",
    "²": "^2", "³": "^3", "⁴": "^4", "⁻": "^-", "¹": "1", "–": "-", "…": "...", "“": '"', "”": '"',
}  # fmt: skip


def _spell_out(error: UnicodeError) -> tuple[str | bytes, int]:
    """Spell a character that the stream's encoding lacks, as an error handler of `codecs`; others become "?"."""
    if isinstance(error, UnicodeEncodeError):
        return "".join(_SPELT.get(character, "?") for character in error.object[error.start : error.end]), error.end
    return codecs.replace_errors(error)


def _ends() -> list[signal.Signals]:
    """Return the signals of service managers and shutdowns, and of a closed terminal unless nohup ignores it."""
    names = [name for name in ("SIGHUP", "SIGBREAK") if hasattr(signal, name)]  # of POSIX, of Windows
    closed = [number for number in map(signal.Signals.__getitem__, names) if signal.getsignal(number) != signal.SIG_IGN]
    return [signal.SIGTERM, *closed]


def _terminate(number: int, _: object) -> None:
    """End a command as Ctrl-C does, once: a second signal must not interrupt the removal of what is half written."""
    signal.signal(number, signal.SIG_IGN)
    raise Terminated(number)
