"""What several rooms' tests share: a set-up, and one run of the demo."""

from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner, Result

from sightline.cli import commands
from sightline.frame import Frame
from sightline.twin import SetUp, draw_setup


@pytest.fixture(scope="session")
def frame() -> Frame:
    return Frame.load("gamma")


@pytest.fixture(scope="session")
def setup(frame: Frame) -> SetUp:
    """A set-up of `frame`, drawn."""
    return draw_setup(np.random.default_rng(7), frame)


@pytest.fixture(scope="session")
def demo_run(tmp_path_factory: pytest.TempPathFactory) -> tuple[Result, Path]:
    """What `sightline demo` said, and the folder that it wrote."""
    out = tmp_path_factory.mktemp("demo") / "deep" / "demo"
    return CliRunner().invoke(commands, ["demo", "--out", str(out)]), out


@pytest.fixture(scope="session")
def demo_folder(demo_run: tuple[Result, Path]) -> Path:
    result, out = demo_run
    assert result.exit_code == 0, result.stderr
    return out
