"""`--help` of every command: an example that parses, text as it was written, and completion in the shell."""

import os
import shlex
import subprocess
import sys
from collections.abc import Iterator
from typing import Any

import pytest
from typer.main import get_command

from sightline.cli import commands


def walked(command: Any, path: tuple[str, ...] = ("sightline",)) -> Iterator[tuple[tuple[str, ...], Any]]:
    """Every command with the words that call it, groups included."""
    yield path, command
    for name, below in getattr(command, "commands", {}).items():
        yield from walked(below, (*path, name))


ROOT = get_command(commands)
ALL = list(walked(ROOT))
LEAVES = [(path, command) for path, command in ALL if not hasattr(command, "commands")]
GROUPS = [(path, command) for path, command in ALL if hasattr(command, "commands")]
NAMES = {"ids": lambda value: " ".join(value) if isinstance(value, tuple) else ""}


def parsed(line: str) -> tuple[str, ...]:
    """The command that a line calls; its parameters are parsed, and it is not run."""
    words = shlex.split(line)
    path, command, rest = (words[0],), ROOT, words[1:]
    while hasattr(command, "commands"):
        path, command, rest = (*path, rest[0]), command.commands[rest[0]], rest[1:]
    command.make_context(path[-1], rest)
    return path


@pytest.mark.parametrize(("path", "command"), LEAVES, **NAMES)
def test_every_help_has_an_example_that_parses(run, path: tuple[str, ...], command: Any) -> None:
    """Brackets are not markup: `[seed, k]` stays."""
    told = run(*path[1:], "--help")
    assert told.code == 0
    _, found, examples = told.out.partition("  Example:\n")
    assert found, "no example"
    for line in examples.strip().replace("\\\n", " ").splitlines():
        called = parsed(line)
        assert called == path
    assert max(len(line) for line in told.out.splitlines()) <= 80
    shown = "".join(told.out.split())
    for parameter in command.params:
        assert "".join((parameter.help or "").split()) in shown, parameter.name


@pytest.mark.parametrize(("path", "command"), GROUPS, **NAMES)
def test_every_group_lists_its_commands_in_whole_sentences(run, path: tuple[str, ...], command: Any) -> None:
    """A line that is too long for its place would end in three dots."""
    told = run(*path[1:], "--help").out
    for name, below in command.commands.items():
        sentence = below.get_short_help_str(200)
        assert f"{name} " in told
        assert sentence and f" {sentence}\n" in told, name


READ_IMAGES = (
    "detect",
    "calibrate",
    "undistort",
    "plan",
    "assess",
    "compare",
    "watch",
    "frame self-check",
    "acquire folder",
    "acquire dicom",
    "acquire video",
    "acquire igtl",
    "export views",
    "export undistorted",
)


@pytest.mark.parametrize("name", READ_IMAGES)
def test_every_command_that_measures_in_images_can_invert_them(name: str) -> None:
    command = {" ".join(path[1:]): command for path, command in LEAVES}[name]
    assert "--invert" in [option for parameter in command.params for option in parameter.opts]


def test_a_shell_gets_its_completion_script_which_offers_commands_and_their_options() -> None:
    assert "_SIGHTLINE_COMPLETE=complete_bash" in completed({"_SIGHTLINE_COMPLETE": "source_bash"})
    assert completed(typed("sightline ca")).split() == ["calibrate", "case"]
    assert "--picks" in completed(typed("sightline plan --p")).split()


def typed(line: str) -> dict[str, str]:
    """What bash says of a line that is being completed."""
    return {"_SIGHTLINE_COMPLETE": "complete_bash", "COMP_WORDS": line, "COMP_CWORD": str(line.count(" "))}


def completed(environment: dict[str, str]) -> str:
    script = "import sys; sys.argv[0] = 'sightline'; from sightline.cli import main; main()"
    return subprocess.run(  # noqa: S603
        [sys.executable, "-c", script],
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, **environment},
        stdin=subprocess.DEVNULL,
    ).stdout


@pytest.mark.parametrize("encoding", ["ascii", "cp1252"])
def test_an_encoding_without_our_characters_ends_no_command(encoding: str) -> None:
    """As a pipe on Windows: what it lacks is spelt out, or shown as "?"."""
    script = (
        "import sys; sys.argv = ['sightline', 'procedure', 'show', 'hip-screw']; from sightline.cli import main; main()"
    )
    shown = subprocess.run(  # noqa: S603
        [sys.executable, "-c", script],
        capture_output=True,
        check=True,
        env={**os.environ, "PYTHONIOENCODING": encoding},
    ).stdout.decode(encoding)
    assert ("130° to 150°" in shown, "130deg to 150deg" in shown) == (encoding != "ascii", encoding == "ascii")
