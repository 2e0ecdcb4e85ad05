"""A second process compiles labelling and calibration: where it is needed, of what a demo calls, and it ends."""

import os
import sys
from subprocess import run
from unittest.mock import patch

import pytest

from sightline.calibration import calibrate
from sightline.frame import Frame
from sightline.rehearsal import kernels_ahead
from sightline.rehearsal.kernels_ahead import KernelsAhead, compiled, label_and_calibrate

METHODS = ("smooth", "localized", "polynomial")


@pytest.mark.parametrize(("name", "methods"), [("gamma", METHODS), ("block60", METHODS[:1])])
def test_it_calibrates_every_view_by_every_method_and_then_the_kernels_are_there(name, methods):
    """Fails for beads that cannot be labelled, and for a view or a method that is left out."""
    frame = Frame.load(name)
    with patch.object(kernels_ahead, "calibrate", wraps=calibrate) as called:
        label_and_calibrate(frame, methods)
    views = ("pa", "lateral")
    done = [(call.args[0].view, call.kwargs["method"]) for call in called.call_args_list]
    assert done == [(view, method) for view in views for method in methods]
    assert compiled()


def test_no_process_is_started_where_the_kernels_are_there_or_no_core_is_free():
    """Fails for a process at every demo."""
    with patch.object(kernels_ahead.subprocess, "Popen", side_effect=AssertionError):
        with patch.object(kernels_ahead, "compiled", return_value=True), KernelsAhead("gamma", METHODS):
            pass
        alone = patch.object(kernels_ahead, "THREADS", 1)
        with alone, patch.object(kernels_ahead, "compiled", return_value=False), KernelsAhead("gamma", METHODS):
            pass


def test_the_process_ends_with_its_block():
    """Fails for a process that outlives the demo."""
    cold = patch.object(kernels_ahead, "compiled", return_value=False)
    with cold, patch.object(kernels_ahead, "THREADS", 2), KernelsAhead("gamma", METHODS) as ahead:
        process = ahead._process
        assert process is not None
        assert process.poll() is None
    assert process.poll() is not None


@pytest.mark.slow
def test_in_an_empty_cache_the_process_compiles_what_the_check_looks_for(tmp_path):
    """Fails for a check that looks elsewhere than numba writes: a process would then be started at every demo."""
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)}

    def says() -> str:
        program = "from sightline.rehearsal.kernels_ahead import compiled; print(compiled())"
        return run([sys.executable, "-c", program], env=environment, capture_output=True, text=True, check=True).stdout  # noqa: S603

    assert says().strip() == "False"
    command = [sys.executable, "-m", kernels_ahead.__name__, "gamma", "smooth"]
    run(command, env=environment, check=True)  # noqa: S603
    assert says().strip() == "True"
