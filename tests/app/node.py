"""Runs the browser's geometry in Node.js, without a browser."""

import os
import shutil
import subprocess
from pathlib import Path

import pytest

XRAY = Path(__file__).resolve().parents[2] / "src/sightline/app/drawing/xray"


def run_node(*arguments: str, text: str = "") -> str:
    """Return what `node *arguments` prints for `text`; skip the test without Node.js, and fail it where CI=true."""
    node = shutil.which("node") or shutil.which("nodejs")
    if node is None:
        said = "Node.js is not installed"
        if os.environ.get("CI") == "true":
            pytest.fail(said)
        pytest.skip(said)
    done = subprocess.run([node, *arguments], input=text, capture_output=True, text=True, check=False)  # noqa: S603
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout
