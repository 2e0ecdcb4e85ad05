"""Atomic writes of files and, where the system allows it, of folders (see `whole_folder`)."""

import ctypes
import os
import shutil
import sys
from collections.abc import Collection, Generator, Mapping
from contextlib import contextmanager, suppress
from errno import EACCES, EDQUOT, EFBIG, EIO, EISDIR, ENOENT, ENOSPC, EPERM, EROFS
from pathlib import Path
from tempfile import mkdtemp
from threading import get_ident

from sightline.errors import UnusableInputError

_BEFORE = "before"  # sub-folder of a scratch folder: old files until the new ones are in place
_ADVICE = {
    ENOENT: "name a folder that exists",
    **dict.fromkeys((ENOSPC, EDQUOT, EFBIG), "free some space, or name a place on another disk"),
}


def write_whole(path: str | Path, data: bytes) -> Path:
    """Write a file next to its target and rename it in one step; return the path. An old file stays until then.

    Raises UnusableInputError where the target cannot be written, or exists and is not a regular file: devices, pipes
    and folders are not replaced.
    """
    target = Path(path)
    scratch = target.with_name(f".{target.name}.{os.getpid()}.{get_ident()}.part")
    with _refusing_os_errors(f"write {target.name}"):
        try:
            _refuse_special(target)
            with scratch.open("wb") as file:
                file.write(data)
                file.flush()
                os.fsync(file.fileno())
            scratch.replace(target)
        finally:
            with suppress(OSError):
                scratch.unlink(missing_ok=True)
    return target


def write_folder(folder: Path, documents: Mapping[str, bytes]) -> list[Path]:
    """Write files into a folder as `whole_folder` does; return their paths. Names may begin with a sub-folder.

    Raises UnusableInputError.
    """
    with whole_folder(folder) as scratch:
        for name, data in documents.items():
            with _refusing_os_errors(f"write {name}"):
                (scratch / name).parent.mkdir(parents=True, exist_ok=True)
            write_whole(scratch / name, data)
    return [folder / name for name in documents]


@contextmanager
def whole_folder(path: str | Path, units: Collection[str] = ()) -> Generator[Path]:
    """Yield a scratch folder next to `path`; at the end of the `with` block its files are moved into `path`.

    After an error or an interruption nothing is moved. Files in `path` that are not replaced stay there. Sub-folders
    are merged, except those named in `units`, which are replaced as a whole.

    1. Where `path` is missing, the scratch folder is renamed.
    2. Where all its files are replaced, both folders are exchanged in one step (Linux, renameat2).
    3. Otherwise all old files are moved out before the first new one is moved in. This holds where `path` has other
       files, is the working directory or a mount point, or on another system.

    In the first two cases the replacement is atomic. In the third it is not: a kill can leave `path` with part of one
    result, never with parts of two. The rest is then in the scratch folder, whose name begins with a dot.

    Raises UnusableInputError where `path` cannot be written. Exceptions of the body are passed on.
    """
    target = Path(os.path.realpath(path))
    said = f"write into {target.name}"
    if target.exists() and not target.is_dir():
        raise UnusableInputError(f"{target.name} is a file; name a folder")
    with _refusing_os_errors(said):
        target.parent.mkdir(parents=True, exist_ok=True)
        place = Path(mkdtemp(dir=target.parent, prefix=f".{target.name}-"))
    try:
        scratch = place / target.name  # with the usual permissions; `place` is accessible to its owner only
        with _refusing_os_errors(said):
            scratch.mkdir()
        yield scratch
        with _refusing_os_errors(said):
            _sync(scratch)
            _put(scratch, target, units)
            sync_folder(target.parent)
    finally:
        if not (place / _BEFORE).exists():  # else it holds old files that could not be moved back
            shutil.rmtree(place, ignore_errors=True)


@contextmanager
def scratch_folder() -> Generator[Path]:
    """Yield a temporary folder, removed afterwards as far as possible. Raises OSError.

    Not `TemporaryDirectory`: its removal recurses endlessly on a disk that has become read-only (Python 3.11).
    """
    place = Path(mkdtemp(prefix="sightline-"))
    try:
        yield place
    finally:
        shutil.rmtree(place, ignore_errors=True)


def sync_folder(folder: Path) -> None:
    """Fsync a folder to make renames in it durable; does nothing on Windows, which has no such call."""
    if os.name == "posix":
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)


def is_of_a_disk(error: OSError) -> bool:
    """Return whether an error comes from a full, read-only or failing disk, or from missing permissions."""
    return error.errno in (ENOSPC, EDQUOT, EFBIG, EROFS, EACCES, EPERM, EIO)


def advice(error: OSError) -> str:
    """Return what to do about a place that cannot be written."""
    return _ADVICE.get(error.errno or 0, "name another place")


@contextmanager
def _refusing_os_errors(what: str) -> Generator[None]:
    try:
        yield
    except OSError as error:
        raise UnusableInputError(f"cannot {what}: {error.strerror}; {advice(error)}") from error


def _refuse_special(place: Path) -> None:
    """Raise OSError where `place` exists and is not a regular file."""
    if place.exists() and not place.is_file():
        raise OSError(EISDIR, "there is a folder, a device or a pipe of this name")


def _put(new: Path, target: Path, units: Collection[str]) -> None:
    items = _items(new, units)
    if not target.exists():
        new.rename(target)
    elif _items(target, units) <= items and _may_exchange(new, target) and _exchange(new, target):
        for appeared in _items(new, units) - items:  # moved back: written to `target` between check and exchange
            (target / appeared).parent.mkdir(parents=True, exist_ok=True)
            (new / appeared).rename(target / appeared)
    else:
        _put_each(new, target, items, units)


def _items(folder: Path, units: Collection[str]) -> set[Path]:
    """Return the relative paths of all files, units and empty folders."""
    found: set[Path] = set()
    for here, folders, files in os.walk(folder):
        place = Path(here).relative_to(folder)
        if place == Path():
            found |= {Path(name) for name in folders if name in units}
            folders[:] = [name for name in folders if name not in units]
        links = [name for name in folders if (folder / place / name).is_symlink()]
        found |= {place / name for name in (*files, *links)}
        if not folders and not files and place != Path():
            found.add(place)
    return found


def _may_exchange(new: Path, target: Path) -> bool:
    """Return whether exchanging is safe; if so, first copy the permissions and times of `target` to `new`.

    It is safe where this process's working directory is not in `target` and the owner stays the same.
    """
    here, old, made = Path.cwd(), target.stat(), new.stat()
    if target in (here, *here.parents) or (old.st_uid, old.st_gid) != (made.st_uid, made.st_gid):
        return False
    shutil.copystat(target, new)
    return True


def _exchange(one: Path, other: Path) -> bool:
    """Exchange two folders in one step; return False where the system cannot."""
    if sys.platform != "linux" or not hasattr(libc := ctypes.CDLL(None), "renameat2"):
        return False
    here, exchange = -100, 2  # AT_FDCWD, RENAME_EXCHANGE (linux/fcntl.h, linux/fs.h)
    return libc.renameat2(here, os.fsencode(one), here, os.fsencode(other), exchange) == 0


def _put_each(new: Path, target: Path, items: Collection[Path], units: Collection[str]) -> None:
    """Move every old item out, then every new one in; undo all where one cannot be moved.

    Items that cannot be moved back stay in the scratch folder.
    """
    before = new.parent / _BEFORE
    moved: list[tuple[Path, Path]] = []

    def move(source: Path, place: Path) -> None:
        place.parent.mkdir(parents=True, exist_ok=True)
        source.rename(place)
        moved.append((source, place))

    try:
        for item in sorted(items):
            if str(item) not in units:
                _refuse_special(target / item)
            if os.path.lexists(target / item):
                move(target / item, before / item)
        for item in sorted(items):
            move(new / item, target / item)
    except BaseException:
        try:
            for source, place in reversed(moved):
                place.rename(source)
        except OSError as error:
            where = f"{before.parent.name}/{before.name}, next to {target.name}"
            said = f"and the old files could not be moved back; they are in {where}: move them back into {target.name}"
            raise OSError(error.errno, f"{error.strerror}, {said}") from error
        shutil.rmtree(before, ignore_errors=True)
        raise
    shutil.rmtree(before, ignore_errors=True)


def _sync(folder: Path) -> None:
    """Fsync all files and folders in a folder; does nothing on Windows, which can only sync files open for writing.

    Raises OSError: a failed write must not pass for a durable one.
    """
    if os.name == "posix":
        for here, _, files in os.walk(folder):
            for name in files:
                with (Path(here) / name).open("rb") as file:
                    os.fsync(file.fileno())
            sync_folder(Path(here))
