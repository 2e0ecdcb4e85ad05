"""The examples run, on what the demo wrote."""

import subprocess
import sys
from pathlib import Path
from xml.etree import ElementTree

import pytest

EXAMPLES = Path(__file__).parents[1] / "examples"


def run(name: str, *arguments: Path | str) -> str:
    command = [sys.executable, str(EXAMPLES / name), *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)  # noqa: S603 - our own files
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_every_example_is_run_here() -> None:
    assert {file.name for file in EXAMPLES.glob("*.py")} == {
        "frame_accuracy.py",
        "plan_from_csv.py",
        "plant_template.py",  # tests/cli/test_real_robot.py
        "readme_picture.py",
    }


@pytest.mark.slow
def test_a_plan_from_csv(demo_folder: Path) -> None:
    said = run("plan_from_csv.py", demo_folder / "observations.csv")
    assert "within" in said
    assert said.count("mm rms at the tip") == 5


@pytest.mark.slow
def test_the_picture_of_the_readme_is_whole_and_small(demo_folder: Path, tmp_path: Path) -> None:
    run("readme_picture.py", demo_folder, tmp_path / "plan.svg")
    drawn = tmp_path / "plan.svg"
    assert drawn.stat().st_size < 300_000
    root = ElementTree.parse(drawn).getroot()  # noqa: S314 - our own markup
    assert len(list(root.iter("{http://www.w3.org/2000/svg}image"))) == 2


@pytest.mark.slow
def test_the_accuracy_of_a_frame() -> None:
    said = run("frame_accuracy.py", "gamma", "3")
    assert "careful clicks" in said
    assert "refused 0" in said
