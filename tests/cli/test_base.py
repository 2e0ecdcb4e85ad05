"""What all commands share: help, version, one JSON document, exit codes, no traceback."""

import errno
import json
import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import pytest
import typer
from typer.testing import CliRunner

import sightline
from sightline.cli.base import Output, Terminated, as_json, command
from sightline.common.checks import Check
from sightline.errors import ImageError, LabellingRefusedError

PASSED = Check("bead count", True, 98.0, 60.0, "beads", "98 beads are used.")
FAILED = Check("chi-square", False, None, 1.2, "", "It could not be measured.")


def invoke(body, *arguments: str):
    """A command whose body is `body(out)`, run with arguments."""
    app = typer.Typer(pretty_exceptions_enable=False)

    @command(app, "probe", "probe")
    def probe(out: Output) -> None:
        body(out)

    return CliRunner().invoke(app, list(arguments))


@dataclass(frozen=True)
class Grouped:
    """Options of a command, one an argument."""

    file: Annotated[Path, typer.Argument(help="A file.")]
    count: Annotated[int, typer.Option(help="A number.")] = 3
    names: Annotated[list[str] | None, typer.Option("--name", help="Names.")] = None


def test_a_dataclass_of_options_is_spread_over_them() -> None:
    app, given = typer.Typer(pretty_exceptions_enable=False), []

    @command(app, "probe", "probe a.txt --count 4")
    def probe(out: Output, grouped: Grouped, flag: Annotated[bool, typer.Option("--flag", help="A flag.")] = False):
        """Probe the options."""
        given.append((grouped, flag))
        out.result({"count": grouped.count})

    for words, group, flag in (
        (["a.txt"], Grouped(Path("a.txt")), False),
        (["--name", "x", "--name", "y", "a.txt", "--flag"], Grouped(Path("a.txt"), 3, ["x", "y"]), True),
    ):
        ran = CliRunner().invoke(app, [*words, "--json"])
        assert (ran.exit_code, json.loads(ran.stdout)) == (0, {"count": 3})
        assert given[-1] == (group, flag)
    assert CliRunner().invoke(app, []).exit_code == 2  # without the file
    told = CliRunner().invoke(app, ["--help"]).stdout
    for words in ("Probe the options.", "A file.", "--count", "[default: 3]", "--name", "--flag", "--json", "--quiet"):
        assert words in told
    assert "probe a.txt --count 4" in told


def test_help_loads_nothing_that_is_slow() -> None:
    """What makes `sightline --help` slow are these; a time is no test."""
    script = (
        "import sys; from sightline.cli import commands\n"
        "print(sorted({'numpy', 'scipy', 'cv2', 'numba', 'pydicom', 'matplotlib', 'pydantic'} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)  # noqa: S603
    assert done.stdout.strip() == "[]"


def test_the_version_is_the_package_s(run) -> None:
    assert run("--version").out.strip() == f"sightline {sightline.__version__}"


def test_without_a_command_or_with_a_wrong_one_the_exit_code_is_2(run) -> None:
    assert run().code == 2
    assert run("planet").code == 2
    assert run("detect").code == 2


@pytest.mark.parametrize(
    ("error", "code"), [(ImageError("a.dcm is empty"), 2), (LabellingRefusedError("the beads cannot be told"), 3)]
)
def test_an_error_is_its_message_and_its_exit_code(error: Exception, code: int) -> None:
    def body(_: Output) -> None:
        raise error

    plain, machine = invoke(body), invoke(body, "--json")
    assert (plain.exit_code, machine.exit_code) == (code, code)
    assert plain.stdout == ""
    assert plain.stderr == f"sightline: {error}\n"
    assert json.loads(machine.stdout) == {"error": {"type": type(error).__name__, "message": str(error)}}


def test_a_bug_is_one_line_and_its_traceback_is_for_who_asks(monkeypatch: pytest.MonkeyPatch) -> None:
    def body(_: Output) -> None:
        raise ZeroDivisionError("secret detail")

    monkeypatch.delenv("SIGHTLINE_DEBUG", raising=False)
    result = invoke(body)
    assert result.exit_code == 1
    assert "ZeroDivisionError" in result.stderr
    assert "SIGHTLINE_DEBUG=1" in result.stderr
    assert "secret detail" not in result.stderr
    assert len(result.stderr.splitlines()) == 1
    monkeypatch.setenv("SIGHTLINE_DEBUG", "1")
    assert "secret detail" in invoke(body).stderr


@pytest.mark.parametrize(("error", "code"), [(KeyboardInterrupt, 130), (Terminated, 143), (Terminated(1), 129)])
def test_a_signal_ends_a_command_cleanly(error: type[BaseException] | BaseException, code: int) -> None:
    def body(_: Output) -> None:
        raise error

    result = invoke(body)
    assert result.exit_code == code
    assert "Traceback" not in result.stderr


def everything(out: Output) -> None:
    with out.step("finding [beads]"):
        out.note("a note")
    with out.progress("trials", 2) as advance:
        advance()
        advance()
    out.say("a line [bold]")
    out.table("Title [x]", ("name", "x mm"), [("[red]b1", 1.5), ("b2", None)])
    out.result({"xyz_mm": np.array([1.0, 2.0]), "n": np.int64(3), "unknown": None, "path": Path("a") / "b"}, [PASSED])


def test_with_json_stdout_holds_one_document_and_stderr_nothing() -> None:
    result = invoke(everything, "--json")
    assert result.exit_code == 0
    document = json.loads(result.stdout)
    assert document["xyz_mm"] == [1.0, 2.0]
    assert document["n"] == 3
    assert document["unknown"] is None
    assert document["checks"][0]["name"] == "bead count"
    assert result.stderr == ""


def test_people_read_tables_on_stdout_and_progress_on_stderr() -> None:
    result = invoke(everything)
    for text in ("a line [bold]", "Title [x]", "[red]b1", "1 check passed; --all lists them"):
        assert text in result.stdout
    assert "\npass bead count: 98 beads, at least 60 beads, 98 beads are used." in invoke(everything, "--all").stdout
    for text in ("finding [beads]", "a note"):
        assert text in result.stderr


def test_quiet_prints_nothing() -> None:
    result = invoke(everything, "--quiet")
    assert (result.exit_code, result.stdout, result.stderr) == (0, "", "")


@pytest.mark.parametrize("machine", [True, False])
def test_a_failed_check_is_exit_code_3_with_the_result_still_printed(machine: bool) -> None:
    result = invoke(lambda out: out.result({"rms_mm": 0.25}, [PASSED, FAILED]), *["--json"] * machine)
    assert result.exit_code == 3
    if machine:
        assert json.loads(result.stdout)["rms_mm"] == 0.25
        assert [check["passed"] for check in json.loads(result.stdout)["checks"]] == [True, False]
    else:
        assert result.stdout.endswith(
            f"FAIL {FAILED.name}: {FAILED.sentence}\n1 of 2 checks passed; --all lists them\n"
        )


@pytest.mark.parametrize(
    ("number", "says", "code"),
    [(errno.ENOSPC, "disk error", 2), (errno.EROFS, "disk error", 2), (errno.ECONNREFUSED, "a bug", 1)],
)
def test_a_disk_that_refuses_is_no_bug(number: int, says: str, code: int) -> None:
    """Nor is its file named: names hold patients' names."""

    def body(_: Output) -> None:
        raise OSError(number, os.strerror(number), "/mnt/doe-john.dcm")

    result = invoke(body)
    assert result.exit_code == code
    assert says in result.stderr and "doe" not in result.stderr
    assert len(result.stderr.splitlines()) == 1


def test_a_value_that_is_not_finite_is_a_bug_not_a_document() -> None:
    with pytest.raises(ValueError, match="JSON compliant"):
        as_json({"x": np.array([np.nan])})
    assert invoke(lambda out: out.result({"x": np.inf}), "--json").exit_code == 1


@pytest.mark.parametrize(
    ("words", "code", "out", "err"),
    [
        (["--version"], 0, f"sightline {sightline.__version__}\n", ""),
        pytest.param(
            ["watch", "nowhere.mp4"],
            2,
            "frame: gamma (assumed; --frame names another)\n",
            "sightline: no file or folder nowhere.mp4 exists",
            marks=pytest.mark.slow,
        ),
    ],
)
def test_the_installed_command_answers_in_one_line_without_a_traceback(words, code: int, out: str, err: str) -> None:
    script = [sys.executable, "-c", "from sightline.cli import main; main()", *words]
    done = subprocess.run(script, capture_output=True, text=True, check=False, stdin=subprocess.DEVNULL)  # noqa: S603
    assert (done.returncode, done.stdout) == (code, out)
    assert len(done.stderr.splitlines()) == bool(err) and done.stderr.startswith(err)
