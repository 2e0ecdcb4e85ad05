"""What several rooms' tests share: a set-up, and one run of the demo."""

import json
import os
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from tests.worked import Worked, make_once
from typer import testing
from typer.testing import CliRunner

from sightline.cli import commands
from sightline.frame import Frame
from sightline.twin import SetUp, draw_setup
from sightline.twin.xray.setup import chain_for

# Typer builds every command anew for each call, which takes longer than most calls that are refused.
testing._get_command = cache(testing._get_command)


@pytest.fixture(scope="session")
def frame() -> Frame:
    return Frame.load("gamma")


@pytest.fixture(scope="session")
def setup(frame: Frame) -> SetUp:
    """A set-up of `frame`, drawn."""
    return draw_setup(np.random.default_rng(7), frame)


@dataclass(frozen=True)
class Ran:
    """How a command ended, and what it said."""

    exit_code: int
    stdout: str
    stderr: str


def shared(tmp_path_factory: pytest.TempPathFactory, name: str) -> Path:
    """Return a folder of all processes of a test run."""
    base = tmp_path_factory.getbasetemp()
    folder = (base.parent if os.environ.get("PYTEST_XDIST_WORKER") else base) / name
    folder.mkdir(exist_ok=True)
    return folder


@pytest.fixture(scope="module")
def few_pixels() -> Iterator[None]:
    """From here on the images of blocks come from a panel of fewer pixels."""
    with pytest.MonkeyPatch.context() as patch:
        few = lambda frame: chain_for(frame) if frame.solid is None else "flat-panel-0.3"  # noqa: E731
        patch.setattr("sightline.twin.xray.setup.chain_for", few)
        yield


@pytest.fixture(scope="session")
def demo_run(tmp_path_factory: pytest.TempPathFactory) -> tuple[Ran, Path]:
    """What `sightline demo` said, and the folder that it wrote."""
    folder = shared(tmp_path_factory, "demo-run")
    out, said = folder / "deep" / "demo", folder / "said.json"

    def run() -> None:
        result = CliRunner().invoke(commands, ["demo", "--out", str(out)])
        said.write_text(json.dumps([result.exit_code, result.stdout, result.stderr]))

    make_once(folder, "demo", run)
    return Ran(*json.loads(said.read_text())), out


@pytest.fixture(scope="session")
def demo_folder(demo_run: tuple[Ran, Path]) -> Path:
    ran, out = demo_run
    assert ran.exit_code == 0, ran.stderr
    return out


@pytest.fixture(scope="session")
def worked(tmp_path_factory: pytest.TempPathFactory) -> Worked:
    """Two images, a plan on them and two check images, made in seconds."""
    return Worked(shared(tmp_path_factory, "worked"))
