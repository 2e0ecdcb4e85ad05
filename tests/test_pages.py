"""The snippets of the pages run as written, where `sightline demo` was run; every command that a page names exists."""

import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import typer
from tests.worked import Worked
from typer.testing import CliRunner

from sightline.cli import commands
from sightline.robot.kinematics.measured import RobotFile

ROOT = Path(__file__).parents[1]
PAGES = [
    ROOT / "README.md",
    ROOT / "CONTRIBUTING.md",
    *sorted((ROOT / "docs").glob("*.md")),
    *sorted((ROOT / "docs" / "procedures").glob("*.md")),
]
# Run whole: their Python reads what their commands write.
WALKED = (
    "tour.md",
    "your-first-frame.md",
    "interop.md",
    "answers.md",
    "register-bone.md",
)
LONG = {
    "robot-link.md",
    "twin.md",
    "check-shot.md",
    "bones.md",
    "planning.md",
    "watch.md",
}  # seconds of physics or images
# README.md has a test of its own; tests/test_interlocking.py calls what interlocking.md shows, on rendered images.
ELSEWHERE = {"README.md", "interlocking.md"}
COMMAND: Any = typer.main.get_command(commands)


def blocks(page: Path, *languages: str) -> list[str]:
    """The code blocks of a page in one of the languages."""
    found = re.findall(r"^```(\w*)\n(.*?)^```", page.read_text(), flags=re.MULTILINE | re.DOTALL)
    return [text for language, text in found if language in languages]


RUN = [page for page in PAGES if blocks(page, "python") and page.name not in {*WALKED, *ELSEWHERE}]


def commands_in(text: str) -> list[list[str]]:
    """The words after `sightline` of each of its commands in shell text; the demo has been run."""
    lines = [shlex.split(line, comments=True) for line in text.replace("\\\n", " ").splitlines()]
    return [words[1:] for words in lines if words[:1] == ["sightline"] and words != ["sightline", "demo"]]


def named_commands(page: Path) -> list[list[str]]:
    """The words of each `sightline ...` that stands in a sentence or a table."""
    text = re.sub(r"^```.*?^```", "", page.read_text(), flags=re.MULTILINE | re.DOTALL)
    named = re.findall(r"`(sightline [^`]+)`", text)
    return [words.split()[1:] for words in named if "COMMAND" not in words]


def told(words: list[str]) -> tuple[Any, list[str]]:
    """The command that the words name, and the words after its name."""
    command = COMMAND
    while hasattr(command, "commands") and words and not words[0].startswith("-"):
        assert words[0] in command.commands, f"no command {words[0]} in {command.name}"
        command, words = command.commands[words[0]], words[1:]
    return command, words


def options_of(command: Any) -> set[str]:
    """Every spelling of every option."""
    return {"--help", "-h", "--json", "--quiet"}.union(
        *(set(one.opts) | set(one.secondary_opts) for one in command.params)
    )


def run(text: str, page: str) -> dict[str, Any]:
    """Run Python of a page, and return its names."""
    known: dict[str, Any] = {"__name__": "__page__"}
    exec(compile(text, page, "exec"), known)  # noqa: S102 - our own page
    return known


@pytest.fixture
def place(request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder that the pages stand in, with the demo's images; for slow tests `sightline demo` was run there."""
    slow = request.node.get_closest_marker("slow") is not None
    demo = request.getfixturevalue("demo_folder") if slow else request.getfixturevalue("worked").demo
    shutil.copytree(demo, tmp_path / "out" / "demo")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_the_plan_of_the_readme_is_near_the_truth(place: Path, worked: Worked, capsys) -> None:
    (block,) = blocks(ROOT / "README.md", "python")
    path = run(block, "README.md")["plan"].trajectory
    assert capsys.readouterr().out.startswith("go [")
    entry_mm, end_mm = worked.rehearsal.hip.wire_mm
    assert np.linalg.norm(path.entry_mm - entry_mm) < path.entry_error_95_mm
    assert np.linalg.norm(path.end_mm - end_mm) < path.end_error_95_mm


@pytest.mark.parametrize("page", [page for page in RUN if page.name not in LONG], ids=lambda page: page.name)
def test_the_python_of_a_page_runs(page: Path, place: Path) -> None:
    run("\n".join(blocks(page, "python")), page.name)


@pytest.mark.slow
@pytest.mark.parametrize("page", [page for page in RUN if page.name in LONG], ids=lambda page: page.name)
def test_the_python_of_a_page_runs_in_a_fresh_process(page: Path, place: Path) -> None:
    script = place / "page.py"
    script.write_text("\n".join(blocks(page, "python")))
    done = subprocess.run([sys.executable, script], capture_output=True, text=True, check=False)  # noqa: S603 - ours
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_command_of_a_page_exists_and_takes_its_options(page: Path) -> None:
    for words in commands_in("\n".join(blocks(page, "sh"))):
        command, rest = told(words)
        if "..." in rest:
            assert {word for word in rest if word.startswith("--")} <= options_of(command), words
        else:
            command.make_context("sightline", rest)
    for words in named_commands(page):
        command, rest = told([word for word in words if word not in ("...", "|")] if "|" not in words else words[:1])
        options = {word.rstrip(".,;:").split("=")[0] for word in rest if word.startswith("--")}
        assert options <= options_of(command), f"`sightline {' '.join(words)}`"


@pytest.mark.parametrize("name", ["frame-file.md", "procedures.md", "undistort.md"])
def test_the_quick_commands_of_a_page_run_one_after_another(name: str, place: Path) -> None:
    """Those that need no table of measurements of the reader's own, nor his images."""
    ran = 0
    for words in commands_in("\n".join(blocks(ROOT / "docs" / name, "sh"))):
        if words[0] in ("frame", "procedure", "undistort") and words[1] != "draw" and "csv" not in " ".join(words):
            done = CliRunner().invoke(commands, words)
            assert done.exit_code == 0, f"sightline {' '.join(words)}: {done.stderr}"
            ran += 1
    assert ran


@pytest.mark.slow
def test_samples_are_calibrated_as_on_the_page_of_a_robot(place: Path) -> None:
    page = ROOT / "docs" / "real-robot.md"
    for words in [*named_commands(page), *commands_in("\n".join(blocks(page, "sh")))]:
        if words[:2] == ["robot", "calibrate"] and len(words) > 2:
            done = CliRunner().invoke(commands, words)
            assert done.exit_code == 0, f"sightline {' '.join(words)}: {done.stderr}"
    six = RobotFile.read(place / "out" / "arm" / "robot.json")
    assert RobotFile.read(place / "robot.json").frame != six.frame
    assert len(six.manipulator.joints) == 6


@pytest.mark.slow
@pytest.mark.parametrize("name", WALKED)
def test_a_walk_runs_from_top_to_bottom(name: str, place: Path) -> None:
    """Commands and Python in the order of the page; a file that the page shows, `NAME.csv` or `NAME.json`, is written
    first. Its output is as shown, but for what `...` leaves out."""
    page = ROOT / "docs" / name
    shown = r"`([\w.-]+\.(?:csv|json))`:\n\n```(?:csv|json)\n(.*?)^```"
    for file, table in re.findall(shown, page.read_text(), re.MULTILINE | re.DOTALL):
        (place / file).write_text(table)
    known: dict[str, Any] = {}
    came = ""
    for language, text in re.findall(r"^```(\w*)\n(.*?)^```", page.read_text(), re.MULTILINE | re.DOTALL):
        if language == "python":
            exec(compile(text, name, "exec"), known)  # noqa: S102 - our own page
        for words in commands_in(text) if language == "sh" else ():
            done = CliRunner().invoke(commands, words)
            assert done.exit_code == 0, f"sightline {' '.join(words)}: {done.stderr}"
            came = " ".join(done.stdout.split())
        for line in text.splitlines() if language == "text" else ():
            assert "..." in line or "─" in line or " ".join(line.split()) in came, line
