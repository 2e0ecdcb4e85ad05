"""Two processes compile detection, labelling and calibration: where needed, what a demo calls, and they end."""

import os
import sys
from subprocess import run
from unittest.mock import patch

import numpy as np
import pytest

from sightline.calibration import calibrate
from sightline.detection.beads.candidates import find_candidates
from sightline.detection.beads.clipping import clipped_shares
from sightline.detection.beads.columns import FITTED, STATUS, U, V
from sightline.detection.beads.fit import fit_part
from sightline.detection.beads.refine import BeadFitter
from sightline.detection.labelling.joint_kernels import settle
from sightline.frame import Frame
from sightline.kernels import is_compiled
from sightline.planning import plan
from sightline.rehearsal import kernels_ahead
from sightline.rehearsal.kernels_ahead import KernelsAhead, fit_beads, label_and_plan, search_image

METHODS = ("smooth", "localized", "polynomial")


@pytest.mark.parametrize(("name", "methods"), [("gamma", METHODS), ("block60", METHODS[:1])])
def test_it_calibrates_every_view_by_every_method_and_then_the_kernels_are_there(name, methods):
    """Fails for beads that cannot be labelled, and for a view or a method that is left out."""
    frame = Frame.load(name)
    wraps = patch.object(kernels_ahead, "plan", side_effect=plan)
    with patch.object(kernels_ahead, "calibrate", wraps=calibrate) as called, wraps as planned:
        label_and_plan(frame, methods)
    views = ("pa", "lateral")
    done = [(call.args[0].view, call.kwargs["method"]) for call in called.call_args_list]
    assert done == [(view, method) for view in views for method in methods]
    views, entry_px, end_px = planned.call_args.args
    assert 20 < plan(views, entry_px, end_px).trajectory.length_mm < 40
    assert is_compiled(settle)


def test_no_process_is_started_where_the_kernels_are_there_or_no_core_is_free():
    """Fails for a process at every demo."""
    with patch.object(kernels_ahead.subprocess, "Popen", side_effect=AssertionError):
        with patch.object(kernels_ahead, "is_compiled", return_value=True), KernelsAhead("gamma", METHODS):
            pass
        alone = patch.object(kernels_ahead, "THREADS", 1)
        with alone, patch.object(kernels_ahead, "is_compiled", return_value=False), KernelsAhead("gamma", METHODS):
            pass


def test_it_fits_every_drawn_bead_where_it_is():
    """Fails for an image without beads, or in which they lie elsewhere: the fits would end before most kernels; and for
    one in which nothing is clipped."""
    wraps = patch.object(kernels_ahead, "clipped_shares", side_effect=clipped_shares)
    with (
        patch.object(BeadFitter, "__call__", autospec=True, side_effect=BeadFitter.__call__) as fitted,
        wraps as clipped,
    ):
        fit_beads()
    image, usable, _ = clipped.call_args.args
    assert image.pixels[usable].max() == image.white
    rows = BeadFitter.__call__(*fitted.call_args.args)
    assert len(rows) > 40
    assert (rows[:, STATUS] == FITTED).all()
    np.testing.assert_allclose(rows[:, [U, V]], fitted.call_args.args[1][:, [U, V]], atol=0.3)
    assert is_compiled(fit_part)


def test_it_finds_the_drawn_beads():
    """Fails for an image in which nothing is judged: those kernels would be missing."""
    with patch.object(kernels_ahead, "find_candidates", side_effect=find_candidates) as found:
        search_image()
    spots = find_candidates(*found.call_args.args)
    assert np.count_nonzero(spots.round) > 40


def test_processes_are_waited_for_and_end_with_their_block():
    """Fails for processes that outlive the demo, and for a wait that ends before they do."""
    cold = patch.object(kernels_ahead, "is_compiled", return_value=False)
    with cold, patch.object(kernels_ahead, "THREADS", 2), KernelsAhead("gamma", METHODS) as ahead:
        first, second = ahead._processes
        assert [first.poll(), second.poll()] == [None, None]
        first.kill()
        second.kill()
        ahead.wait()
        assert None not in (first.poll(), second.poll())
    with cold, patch.object(kernels_ahead, "THREADS", 2), KernelsAhead("gamma", METHODS) as ahead:
        processes = ahead._processes
    assert all(process.poll() is not None for process in processes)


@pytest.mark.slow
def test_in_an_empty_cache_each_process_compiles_what_the_check_looks_for(tmp_path):
    """Fails for a check that looks elsewhere than numba writes: processes would then be started at every demo."""
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)}

    def says() -> list[str]:
        program = "from sightline.rehearsal.kernels_ahead import *; print(is_compiled(fit_part), is_compiled(settle))"
        done = run([sys.executable, "-c", program], env=environment, capture_output=True, text=True, check=True)  # noqa: S603
        return done.stdout.split()

    assert says() == ["False", "False"]
    for name, then in (("fits", ["True", "False"]), ("labels", ["True", "True"])):
        command = [sys.executable, "-m", kernels_ahead.__name__, name, "gamma", "smooth"]
        run(command, env=environment, check=True)  # noqa: S603
        assert says() == then
