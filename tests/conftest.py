"""What several rooms' tests share: one run of the demo."""

from pathlib import Path

import pytest
from typer.testing import CliRunner, Result

from sightline.cli import app


@pytest.fixture(scope="session")
def demo_run(tmp_path_factory: pytest.TempPathFactory) -> tuple[Result, Path]:
    """What `sightline demo` said, and the folder that it wrote."""
    out = tmp_path_factory.mktemp("demo") / "deep" / "demo"
    return CliRunner().invoke(app, ["demo", "--out", str(out)]), out


@pytest.fixture(scope="session")
def demo_folder(demo_run: tuple[Result, Path]) -> Path:
    result, out = demo_run
    assert result.exit_code == 0, result.stderr
    return out
