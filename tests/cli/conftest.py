"""The real command line, and files for it: a pair of the twin's images, and its beads as CSV."""

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.worked import Worked, make_once
from typer.testing import CliRunner

from sightline.cli import commands
from sightline.detection.csv_files import write_observations
from sightline.detection.results import Observations
from sightline.imaging import write_dicom
from sightline.twin import bead_images, hip_scene, render

VIEWS = ("pa", "lateral")


@dataclass(frozen=True)
class Ran:
    """What a command left: exit code, stdout, stderr."""

    code: int
    out: str
    err: str

    @property
    def document(self) -> Any:
        """The one JSON document on stdout."""
        return json.loads(self.out)

    @property
    def failing(self) -> set[str]:
        """The names of the checks that failed."""
        return {check["name"] for check in self.document["checks"] if not check["passed"]}

    @property
    def said(self) -> str:
        """What stands on stderr, in one line."""
        return " ".join(self.err.split())


@pytest.fixture(scope="session")
def run() -> Callable[..., Ran]:
    """`run(ARGUMENTS)`: `sightline ARGUMENTS` in this process."""

    def ran(*arguments: object) -> Ran:
        result = CliRunner().invoke(commands, [str(argument) for argument in arguments])
        return Ran(result.exit_code, result.stdout, result.stderr)

    return ran


@pytest.fixture(scope="session")
def pair(setup, worked: Worked) -> dict[str, Path]:
    """A DICOM image of each view, drawn once for all processes. Read-only: tests that spoil a file copy it first."""
    folder = worked.folder / "pair"

    def draw() -> None:
        folder.mkdir()
        rng = np.random.default_rng(8)
        scene = hip_scene(setup, rng).scene
        for view in VIEWS:
            write_dicom(render(setup, view, scene, rng), folder / f"{view}.dcm")

    make_once(worked.folder, "pair", draw)
    return {view: folder / f"{view}.dcm" for view in VIEWS}


@pytest.fixture(scope="session")
def observations(setup) -> dict[str, Observations]:
    """Beads of each view with 0.1 px of noise."""
    rng = np.random.default_rng(9)
    found = {view: bead_images(setup, view, rng, 0.1) for view in VIEWS}
    noise = 0.01 * np.eye(2)
    return {
        view: Observations(view, tuple(ids), uv_px, np.repeat(noise[None], len(ids), axis=0))
        for view, (ids, uv_px) in found.items()
    }


@pytest.fixture(scope="session")
def beads_csv(observations, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Both views' beads in one file."""
    return write_observations(observations.values(), tmp_path_factory.mktemp("beads") / "beads.csv")
