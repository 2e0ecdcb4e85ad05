"""Results of compiled code depend neither on when it was compiled nor on what else a process has loaded."""

import os
import pkgutil
import subprocess
import sys
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
from numba.core.registry import CPUDispatcher

import sightline
from sightline.case.views import NAMES
from sightline.imaging.files import write_png
from sightline.twin import hip_scene, render

_FIND = """
import hashlib, sys
import sightline as sl
frame, whole = sl.Frame.load("gamma"), hashlib.sha256()
for path in sys.argv[1:]:
    found = sl.detect(sl.read_image(path))
    labelled = sl.label(found, frame)
    for values in (found.uv_px, found.covariance_px2, labelled.uv_px, sl.calibrate(labelled, frame).focal_point_mm):
        whole.update(values.tobytes())
print(whole.hexdigest())
"""


def _kernels() -> dict[str, CPUDispatcher]:
    """Return the package's kernels by module and name."""
    names = [one.name for one in pkgutil.walk_packages(sightline.__path__, "sightline.") if ".app" not in one.name]
    held = [value for name in names if "__main__" not in name for value in vars(import_module(name)).values()]
    kernels = [value for value in held if isinstance(value, CPUDispatcher)]
    return {f"{one.py_func.__module__}.{one.__name__}": one for one in kernels}


def _called_by(kernel: CPUDispatcher) -> list[CPUDispatcher]:
    here = kernel.py_func.__globals__
    return [here[name] for name in kernel.py_func.__code__.co_names if isinstance(here.get(name), CPUDispatcher)]


def _leaves_open(kernel: CPUDispatcher) -> bool:
    """Return whether a kernel's compilation may differ from caller to caller."""
    options = kernel.targetoptions
    if options.get("inline") == "always":
        return False
    stated = {"fastmath", "error_model"} <= options.keys()
    return not stated or bool(options["fastmath"] and not options["forceinline"])


def test_no_kernel_of_detection_calls_one_that_leaves_open_how_it_is_compiled() -> None:
    kernels = _kernels()
    assert len(kernels) > 60
    detection = [one for name, one in kernels.items() if name.startswith("sightline.detection.")]
    fast = [one for one in kernels.values() if one.targetoptions.get("fastmath")]
    assert len(detection) > 40
    assert {"fit_part", "_cast_volume"} <= {one.__name__ for one in fast}
    for caller in {*fast, *(one for one in detection if "labelling" not in one.py_func.__module__)}:
        assert [one.__name__ for one in _called_by(caller) if _leaves_open(one)] == [], caller.__name__


@pytest.mark.slow
def test_beads_are_the_same_whether_their_kernels_were_compiled_now_or_before(tmp_path: Path, setup) -> None:
    rng = np.random.default_rng(8)
    scene = hip_scene(setup, rng).scene
    images = [write_png(render(setup, view, scene, rng), tmp_path / f"{view}.png") for view in NAMES]

    def found(**cache: str) -> str:
        command = [sys.executable, "-c", _FIND, *map(str, images)]
        environment = os.environ | cache
        ran = subprocess.run(command, env=environment, check=True, capture_output=True, text=True)  # noqa: S603 - ours
        return ran.stdout

    compiled = found(NUMBA_CACHE_DIR=str(tmp_path))
    assert any(tmp_path.rglob("fit.fit_part*.nbc"))
    assert len(compiled) > 60 and found(NUMBA_CACHE_DIR=str(tmp_path)) == compiled
    assert found() == compiled  # by whatever ran first in this checkout, in another order
