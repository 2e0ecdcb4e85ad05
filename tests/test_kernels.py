"""Results of compiled code depend neither on when it was compiled nor on what else a process has loaded."""

import ast
import inspect
import os
import pkgutil
import subprocess
import sys
from importlib import import_module
from pathlib import Path
from types import FunctionType, ModuleType

import pytest
from numba.core.registry import CPUDispatcher

import sightline
from sightline.common.kernels import version

# Functions that numba compiles to instructions of the caller. Others are kernels of numba's own, with the options of
# whatever was compiled first.
_TYPES = {"float32", "int32", "uint32", "uint64", "int"}
_OF_THE_CALLER = _TYPES | {"exp", "log", "sqrt", "zeros", "empty", "len", "range", "min", "max"}


def _kernels() -> dict[str, CPUDispatcher]:
    """Return the package's kernels by module and name."""
    walked = pkgutil.walk_packages(sightline.__path__, "sightline.")
    names = [module.name for module in walked if not {"app", "arms", "ros2"} & set(module.name.split("."))]  # extras
    held = [value for name in names if "__main__" not in name for value in vars(import_module(name)).values()]
    kernels = [value for value in held if isinstance(value, CPUDispatcher)]
    return {f"{kernel.py_func.__module__}.{kernel.__name__}": kernel for kernel in kernels}


def _read_by(kernel: CPUDispatcher) -> dict[str, object]:
    """Return what a kernel reads from its module by name."""
    here = kernel.py_func.__globals__
    return {name: here[name] for name in kernel.py_func.__code__.co_names if name in here}


def _called(kernel: CPUDispatcher) -> set[str]:
    """Return the names of functions and operators of numba's own in a kernel."""
    (function,) = ast.parse(inspect.getsource(kernel.py_func)).body
    assert isinstance(function, ast.FunctionDef)
    names, read = set[str](), _read_by(kernel)
    for node in (node for statement in function.body for node in ast.walk(statement)):
        if isinstance(node, ast.BinOp | ast.AugAssign) and isinstance(node.op, ast.Pow | ast.MatMult):
            names.add(type(node.op).__name__)
        if isinstance(node, ast.Call):
            names.add(node.func.attr if isinstance(node.func, ast.Attribute) else ast.unparse(node.func))
    return names - read.keys()


def test_fastmath_is_for_kernels_that_python_calls_and_uses_no_kernel_of_numba() -> None:
    kernels = _kernels()
    assert len(kernels) > 60
    fast = {name for name, kernel in kernels.items() if kernel.targetoptions["fastmath"]}
    assert {name: _called(kernels[name]) - _OF_THE_CALLER for name in fast} == {name: set() for name in fast}
    for name, caller in kernels.items():
        assert caller.targetoptions.keys() >= {"fastmath", "error_model", "forceinline", "boundscheck"}, name
        called = [value for value in _read_by(caller).values() if isinstance(value, CPUDispatcher)]
        assert not [part for part in called if part.targetoptions["fastmath"] and not part.targetoptions["forceinline"]]


def test_every_constant_of_a_kernel_is_in_a_file_that_the_version_counts() -> None:
    """A constant under a name in lower case, or one read through a module, would outlive its change."""
    for name, kernel in _kernels().items():
        for read, value in _read_by(kernel).items():
            if isinstance(value, ModuleType):
                assert read == "np", name
            elif not isinstance(value, CPUDispatcher | FunctionType | type):
                assert read.isupper(), f"{name} reads {read}"


_CALLER = """
from sightline.common.kernels import kernel
from sightline.callee import halved
from sightline.limits import LIMIT

@kernel()
def called(x):
    return LIMIT - halved(x)

@kernel()
def second(x):
    return x[1]
"""
_CALLEE = """
from sightline.common.kernels import kernel

@kernel()
def halved(x):
    return 0.5 * x
"""
_CALL = """
import numpy as np
from sightline.caller import called, second
x = np.arange(4.0)
print(called(3.0), second(x), sum(called.stats.cache_hits.values()))
"""


def _run(program: str, folder: Path) -> subprocess.Popen[str]:
    environment = {name: value for name, value in os.environ.items() if name != "NUMBA_CACHE_DIR"}
    environment["PYTHONPATH"] = str(folder)
    command = [sys.executable, "-B", "-c", program]
    return subprocess.Popen(command, cwd=folder, env=environment, stdout=subprocess.PIPE, text=True)  # noqa: S603 - ours


def _printed(program: str, folder: Path) -> str:
    return _run(program, folder).communicate()[0]


@pytest.fixture
def package(tmp_path: Path) -> Path:
    """A folder with a package of two modules with kernels, one with a constant, and one with neither."""
    package = tmp_path / "sightline"
    package.mkdir()
    texts = {"__init__": "", "caller": _CALLER, "callee": _CALLEE, "limits": "LIMIT = 10.0", "other": "LIMIT = 1"}
    for name, text in texts.items():
        (package / f"{name}.py").write_text(text)
    (package / "common").mkdir()
    (package / "common" / "__init__.py").touch()
    (package / "common" / "kernels.py").write_text(Path(inspect.getfile(version)).read_text())
    return package


def test_a_version_is_told_by_the_files_with_kernels_and_those_with_their_constants(package: Path) -> None:
    first = version(package)
    (package / "other.py").write_text("LIMIT = 2")
    assert version(package) == first
    versions = {first}
    for name, text in (
        ("limits", "LIMIT = 15.5"),
        ("callee", _CALLEE.replace("0.5", "2.0")),
        ("caller", _CALLER + "\n"),
    ):
        (package / f"{name}.py").write_text(text)
        versions.add(version(package))
    assert len(versions) == 4


def test_kernels_are_compiled_once_in_a_folder_that_replaces_the_oldest(package: Path) -> None:
    for k in range(4):
        folder = package / "__pycache__" / f"kernels-{k}"
        folder.mkdir(parents=True)
        os.utime(folder, (k, k))
    assert [_printed(_CALL, package.parent) for _ in range(2)] == ["8.5 1.0 0\n", "8.5 1.0 1\n"]
    kept = {path.name for path in (package / "__pycache__").iterdir()}
    assert kept == {"kernels-2", "kernels-3", f"kernels-{version(package)}"}


def test_another_cache_folder_is_used_where_the_package_cannot_be_written(package: Path, monkeypatch) -> None:
    (package / "__pycache__").write_text("no folder")
    monkeypatch.setenv("XDG_CACHE_HOME", str(package.parent / "cache"))
    assert _printed(_CALL, package.parent) == "8.5 1.0 0\n"
    assert len(list((package.parent / "cache" / "sightline").rglob("*.nbc"))) >= 2


# As numba writes: first the index, then the code. The pause lets another process come between.
_SLOW = """
import time
from numba.core.caching import IndexDataCacheFile
write = IndexDataCacheFile._save_index
def slowly(self, overloads):
    time.sleep(1.0)
    write(self, overloads)
IndexDataCacheFile._save_index = slowly
import numpy as np
from sightline.caller import second
print(second(np.arange(4, dtype=DTYPE)))
"""


@pytest.mark.slow  # three programs compile
def test_two_processes_that_compile_for_different_types_leave_code_for_both(package: Path) -> None:
    """Without a lock one names the file that the other writes, whose code then runs on arguments of other types."""
    both = [_run(_SLOW.replace("DTYPE", f'"{dtype}"'), package.parent) for dtype in ("f8", "f4")]
    assert [process.communicate()[0] for process in both] == ["1.0\n", "1.0\n"]
    program = "import numpy as np\nfrom sightline.caller import second\n"
    program += "print(second(np.arange(4.0)), second(np.arange(4, dtype='f4')), len(second.stats.cache_misses))"
    assert _printed(program, package.parent) == "1.0 1.0 0\n"


_CAST = """
import hashlib
import numpy as np
from scipy.spatial.transform import RigidTransform
from sightline.from_images.registration.cast import RayBundle, shadow_and_derivatives
from sightline.imaging.volumes.volume import Volume
rng = np.random.default_rng(1)
volume = Volume(rng.random((20, 20, 20), np.float32), np.full(3, -9.5), np.ones(3))
along = np.array([0.0, 0.0, 1.0]) + 0.1 * rng.standard_normal((500, 3))
rays = RayBundle(np.array([0.0, 0.0, -100.0]), along / np.linalg.norm(along, axis=1)[:, None])
sums, derivatives = shadow_and_derivatives(rays, volume, RigidTransform.identity(), np.zeros(3))
assert sums.max() > 5.0
print(hashlib.sha256(sums.tobytes() + derivatives.tobytes()).hexdigest())
"""


@pytest.mark.slow
def test_shadows_are_the_same_whether_their_kernel_was_compiled_now_or_before(tmp_path: Path) -> None:
    """Of a kernel whose sums may be reordered."""

    def cast(**cache: str) -> str:
        command, environment = [sys.executable, "-c", _CAST], os.environ | cache
        ran = subprocess.run(command, env=environment, check=True, capture_output=True, text=True)  # noqa: S603 - ours
        return ran.stdout

    compiled = cast(NUMBA_CACHE_DIR=str(tmp_path))
    assert any(tmp_path.rglob("cast._cast*.nbc"))
    kept = {file: file.stat().st_mtime_ns for file in tmp_path.rglob("*.nb?")}
    assert len(compiled) > 60 and cast(NUMBA_CACHE_DIR=str(tmp_path)) == compiled
    assert {file: file.stat().st_mtime_ns for file in tmp_path.rglob("*.nb?")} == kept  # nothing was compiled again
    assert cast() == compiled  # by whatever ran first in this checkout, in another order
