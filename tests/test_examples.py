"""The examples run, on what the demo wrote."""

import runpy
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import MagicMock, patch
from xml.etree import ElementTree

import pytest

EXAMPLES = Path(__file__).parents[1] / "examples"
# Of docs/live.md, and the CT that a person loads.
LIVE_NAMES = {
    "live",
    "live-to-cfcs",
    "pa",
    "wire-to-cfcs",
    "tool-to-cfcs",
    "ct-to-cfcs",
    "cfcs-to-ras",
    "verdict",
    "CT",
}


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
        "ros2_live.py",  # tests/robot/test_ros2.py
        "slicer_live.py",
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


def test_in_slicer_everything_hangs_below_the_patient_and_only_a_go_shows_the_wire() -> None:
    """On a stand-in of Slicer's scene: nodes by name, each below its parent."""
    nodes: dict[str, MagicMock] = {}

    def added(kind: str, name: str) -> MagicMock:
        nodes[name] = MagicMock()
        nodes[name].GetID.return_value = name
        return nodes[name]

    scene = SimpleNamespace(AddNewNodeByClass=added, GetFirstNodeByName=nodes.get)
    modules = {"slicer": SimpleNamespace(mrmlScene=scene), "qt": MagicMock(), "vtk": MagicMock()}
    with patch.dict(sys.modules, modules):
        script = runpy.run_path(str(EXAMPLES / "slicer_live.py"))
    for name in LIVE_NAMES:
        added("", name)
    nodes["Sightline"].GetState.return_value = nodes["Sightline"].StateConnected
    seen = []
    for verdict in ("NO-GO (gap)", "GO"):
        nodes["verdict"].GetText.return_value = verdict
        script["arrange"]()
        seen.append(nodes["planned wire"].SetDisplayVisibility.call_args.args[0])
    nodes["Sightline"].GetState.return_value = None
    script["arrange"]()
    seen.append(nodes["planned wire"].SetDisplayVisibility.call_args.args[0])
    assert seen == [False, True, False]
    parents = {
        name: node.SetAndObserveTransformNodeID.call_args.args[0]
        for name, node in nodes.items()
        if node.SetAndObserveTransformNodeID.called
    }
    path = ["CT"]
    while path[-1] in parents:
        path.append(parents[path[-1]])
    assert path == ["CT", "ras-to-lps", "ct-to-cfcs", "cfcs-to-ras"]
    assert parents["planned wire"] == "wire-to-cfcs"
    assert all(parents[name] == "cfcs-to-ras" for name in LIVE_NAMES - {"CT", "verdict", "cfcs-to-ras"})
