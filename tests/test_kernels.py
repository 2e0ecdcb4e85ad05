"""Results of compiled code depend neither on when it was compiled nor on what else a process has loaded."""

import ast
import inspect
import os
import pkgutil
import subprocess
import sys
from importlib import import_module
from pathlib import Path

import numba as nb
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


# Functions and methods that numba compiles to instructions of the caller, or to a call of the C library, and those that
# compute nothing but indices. All others are kernels of numba's own.
_OF_THE_CALLER = {"exp", "log", "sqrt", "float32", "int32", "int64", "uint8", "uint32", "uint64"} | {
    *("array", "copy", "empty", "ones", "reshape", "zeros"),
}


def _kernels() -> dict[str, CPUDispatcher]:
    """Return the package's kernels by module and name."""
    names = [one.name for one in pkgutil.walk_packages(sightline.__path__, "sightline.") if ".app" not in one.name]
    held = [value for name in names if "__main__" not in name for value in vars(import_module(name)).values()]
    kernels = [value for value in held if isinstance(value, CPUDispatcher)]
    return {f"{one.py_func.__module__}.{one.__name__}": one for one in kernels}


def _called_by(kernel: CPUDispatcher) -> list[CPUDispatcher]:
    here = kernel.py_func.__globals__
    return [here[name] for name in kernel.py_func.__code__.co_names if isinstance(here.get(name), CPUDispatcher)]


def test_kernels_state_how_they_are_compiled_and_fastmath_is_for_python_or_inlined() -> None:
    kernels = _kernels()
    assert len(kernels) > 60
    assert {"fit_part", "_cast_volume"} <= {one.__name__ for one in kernels.values() if _is_fast(one)}
    for caller in kernels.values():
        assert caller.targetoptions.keys() >= {"fastmath", "error_model", "forceinline"}, caller.__name__
        copied = [one for one in _called_by(caller) if _is_fast(one) and not one.targetoptions["forceinline"]]
        assert [one.__name__ for one in copied] == [], caller.__name__


def _is_fast(kernel: CPUDispatcher) -> bool:
    return bool(kernel.targetoptions.get("fastmath"))


def _with_inlined(kernel: CPUDispatcher) -> list[CPUDispatcher]:
    """Return a kernel and those that become part of it before it is compiled."""
    inlined = [one for one in _called_by(kernel) if one.targetoptions.get("inline") == "always"]
    return [kernel, *(part for one in inlined for part in _with_inlined(one))]


def _kernels_of_numba(kernel: CPUDispatcher) -> set[str]:
    """Return the operators, functions and methods in a kernel for which numba has kernels of its own."""
    found = set[str]()
    for part in _with_inlined(kernel):
        (function,) = ast.parse(inspect.getsource(part.py_func)).body
        assert isinstance(function, ast.FunctionDef)
        for node in (node for statement in function.body for node in ast.walk(statement)):
            if isinstance(node, ast.BinOp | ast.AugAssign) and isinstance(node.op, ast.Pow | ast.MatMult):
                found.add(type(node.op).__name__)
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute):
                found.add(node.func.attr)
    return found - _OF_THE_CALLER


def test_no_kernel_with_fastmath_uses_a_kernel_of_numba_which_any_other_may_have_compiled_without() -> None:
    fast = [one for one in _kernels().values() if _is_fast(one)]
    assert {one.__name__: found for one in fast if (found := _kernels_of_numba(one))} == {}


@nb.njit(inline="always")
def _root(x: float, y: float) -> float:
    return np.hypot(x, y)


@nb.njit(fastmath=True)
def _raised(x: np.ndarray) -> float:
    return _root(x[0], x[1]) + x.sum() ** 2 + np.sqrt(x[0])


def test_kernels_of_numba_are_found_where_they_are_inlined() -> None:
    assert isinstance(_raised, CPUDispatcher)
    assert _kernels_of_numba(_raised) == {"Pow", "sum", "hypot"}


_CALLER = """
from sightline.kernels import exact
from callee import halved
from limits import LIMIT

@exact
def called(x):
    return LIMIT - halved(x)

@exact
def second(x):
    return x[1]
"""
_CALLEE = """
from sightline.kernels import exact

@exact
def halved(x):
    return 0.5 * x
"""
_CALL = """
import numpy as np
from caller import called, second
from sightline.kernels import is_compiled
x = np.arange(4.0)
print(is_compiled(called), called(3.0), second(x[::2]), second(x))
"""


def _print_calls(folder: Path) -> str:
    command = [sys.executable, "-B", "-c", _CALL]
    environment = {name: value for name, value in os.environ.items() if name != "NUMBA_CACHE_DIR"}
    ran = subprocess.run(command, cwd=folder, env=environment, check=True, capture_output=True, text=True)  # noqa: S603 - ours
    return ran.stdout


@pytest.fixture
def compiled(tmp_path: Path) -> Path:
    """A folder with two modules whose kernels are on the disk."""
    (tmp_path / "caller.py").write_text(_CALLER)
    (tmp_path / "callee.py").write_text(_CALLEE)
    (tmp_path / "limits.py").write_text("LIMIT = 10.0")
    assert _print_calls(tmp_path) == "False 8.5 2.0 1.0\n"
    assert len(list(tmp_path.rglob("caller.second-*.nbc"))) == 2
    return tmp_path


@pytest.mark.parametrize(
    ("file", "new", "want"), [("callee", _CALLEE.replace("0.5", "2.0"), "4.0"), ("limits", "LIMIT = 15.5", "14.0")]
)
def test_a_kernel_is_compiled_again_when_another_file_has_changed(
    file: str, new: str, want: str, compiled: Path
) -> None:
    (compiled / f"{file}.py").write_text(new)
    assert _print_calls(compiled) == f"False {want} 2.0 1.0\n"
    assert len(list(compiled.rglob("caller.called-*.nbc"))) == 2


def test_code_for_other_types_than_its_index_says_is_not_run(compiled: Path) -> None:
    one, other = sorted(compiled.rglob("caller.second-*.nbc"))  # as two processes leave it that write at once
    held = one.read_bytes()
    one.write_bytes(other.read_bytes())
    other.write_bytes(held)
    assert _print_calls(compiled) == "True 8.5 2.0 1.0\n"


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
    kept = {file: file.stat().st_mtime_ns for file in tmp_path.rglob("*.nb?")}
    assert len(compiled) > 60 and found(NUMBA_CACHE_DIR=str(tmp_path)) == compiled
    assert {file: file.stat().st_mtime_ns for file in tmp_path.rglob("*.nb?")} == kept  # nothing was compiled again
    assert found() == compiled  # by whatever ran first in this checkout, in another order
