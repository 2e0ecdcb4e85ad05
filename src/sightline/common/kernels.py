"""Kernels: functions that numba compiles, and keeps on the disk for the processes to come.

Estimates are bit-identical on one machine, whichever kernel was compiled first. numba takes options that are not stated
from the caller that is compiled first; so all are stated here. A function that is not inlined is there once for each
kernel that calls it, and the linker may take any of these copies. Their bits agree as long as no sum is reordered.
Therefore fastmath is only for kernels that Python calls and for parts that are inlined in these.
"""

import os
import re
import shutil
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator
from functools import cache
from hashlib import sha256
from pathlib import Path
from typing import IO, Any

import numba as nb
from numba.core import config, event

_CONFIG: Any = config  # which NUMBA_CACHE_DIR and the other variables set
_PACKAGE = Path(__file__).parents[1]
_NAME = "kernels-"  # a folder's name begins like this
_KEPT_VERSIONS = 3  # so that a change of branches compiles nothing [ours]
_IMPORTED = re.compile(rb"^from (sightline[\w.]*) import (\([^)]*\)|.*)", re.MULTILINE)
_CONSTANT = re.compile(rb"\b[A-Z][A-Z0-9_]+\b")
# The part of fastmath that lets sums be reordered, and keeps NaN and infinity.
_FASTMATH = {"reassoc", "contract", "arcp", "nsz"}


def kernel(
    *, nogil: bool = False, fastmath: bool = False, inlined: bool = False
) -> Callable[[Callable[..., Any]], Any]:
    """Return a decorator that compiles a function on its first call.

    `nogil`: other threads of Python run meanwhile. `fastmath`: sums may be reordered; with operators, sqrt, exp and log
    alone, because numba's own functions state no options. `inlined`: compiled into each caller, for parts with
    `fastmath` and for what is called a thousand times an image.
    Division by zero gives infinity or NaN.
    """
    options: dict[str, Any] = {
        "nogil": nogil,
        "fastmath": _FASTMATH if fastmath else False,
        "forceinline": inlined,
        "error_model": "numpy",
        "boundscheck": False,
    }

    def compiled(function: Callable[..., Any]) -> Any:
        folder, before = cache_folder(), _CONFIG.CACHE_DIR
        # numba reads the folder when it decorates. Other programs' kernels in this process keep their own.
        _CONFIG.CACHE_DIR = str(folder or "")
        try:
            return nb.njit(cache=folder is not None, **options)(function)
        finally:
            _CONFIG.CACHE_DIR = before

    return compiled


@cache
def cache_folder() -> Path | None:
    """Return the folder of this version's compiled kernels; None where no folder can be written.

    It is in NUMBA_CACHE_DIR where that is set, else in the package, else in the user's cache. The oldest versions
    beside it are removed.
    """
    chosen = _CONFIG.CACHE_DIR
    home = os.environ.get("XDG_CACHE_HOME") or os.environ.get("LOCALAPPDATA") or Path.home() / ".cache"
    for place in [Path(chosen)] if chosen else [_PACKAGE / "__pycache__", Path(home) / "sightline"]:
        folder = place / f"{_NAME}{version(_PACKAGE)}"
        try:
            folder.mkdir(parents=True, exist_ok=True)
            tempfile.TemporaryFile(dir=folder).close()
        except OSError:
            continue
        others = [path for path in place.glob(f"{_NAME}*") if path != folder]
        for old in sorted(others, key=lambda path: path.stat().st_mtime)[: 1 - _KEPT_VERSIONS]:
            shutil.rmtree(old, ignore_errors=True)
        event.register("numba:compiler_lock", _OneProcess(folder / "lock"))
        return folder
    return None


def version(package: Path) -> str:
    """Return a hash of numba's version and of the files that kernels are made from.

    These are the files that import this module, and those from which they import constants. Only they count, so that a
    change elsewhere compiles nothing: all kernels take a minute. numba itself looks only at the file of a kernel, not
    at what the kernel calls or reads in other files.
    """
    texts = {path: path.read_bytes() for path in package.rglob("*.py")}
    made_from = [path for path, text in texts.items() if b"from sightline.common.kernels import" in text]
    for path in made_from:  # which grows
        made_from += [other for other in _constants_of(texts[path], package) if other not in made_from]
    whole = sha256(f"{nb.__version__}\n".encode())
    for path in sorted({*made_from, package / "common/kernels.py"} & texts.keys()):
        whole.update(str(path.relative_to(package)).encode() + texts[path])
    return whole.hexdigest()[:16]


def _constants_of(text: bytes, package: Path) -> Iterator[Path]:
    """Yield the modules from which a module imports constants."""
    for module, names in _IMPORTED.findall(text):
        if _CONSTANT.search(names):
            path = package.parent.joinpath(*module.decode().split("."))
            yield from (file for file in (path.with_suffix(".py"), path / "__init__.py") if file.is_file())


class _OneProcess(event.Listener):
    """Lets one process at a time compile: a file is locked as long as numba's own lock is held.

    Of two processes that add code for different types to a kernel, one could name the file that the other writes: code
    would run on arguments of another type. A process that has waited finds on the disk what the other has compiled.
    """

    def __init__(self, path: Path) -> None:
        self._path, self._held = path, threading.local()

    def on_start(self, event: Any) -> None:
        """Wait for the file. numba's lock is re-entrant, so it counts."""
        depth = self._held.depth = getattr(self._held, "depth", 0) + 1
        if depth == 1:
            self._held.file = _locked(self._path)

    def on_end(self, event: Any) -> None:
        """Close the file, which unlocks it."""
        self._held.depth -= 1
        if self._held.depth == 0:
            self._held.file.close()


def _locked(path: Path) -> IO[bytes]:
    """Return an open file that no other process or thread has locked; wait for it."""
    path.parent.mkdir(parents=True, exist_ok=True)  # another version may have removed it
    file = path.open("wb")
    if sys.platform == "win32":
        import msvcrt

        while True:
            try:
                msvcrt.locking(file.fileno(), msvcrt.LK_LOCK, 1)  # for ten seconds
                return file
            except OSError:
                continue
    import fcntl

    fcntl.flock(file, fcntl.LOCK_EX)
    return file
