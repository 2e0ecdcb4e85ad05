"""Atomic writes of files, and of folders by two renames (see `whole_folder`)."""

import json
import os
import shutil
from collections.abc import Collection, Generator, Mapping
from contextlib import contextmanager, suppress
from errno import EACCES, EDQUOT, EFBIG, EIO, EISDIR, ENOENT, ENOSPC, EPERM, EROFS
from pathlib import Path
from tempfile import mkdtemp
from threading import get_ident

from sightline.errors import UnusableInputError

MANIFEST = ".sightline.json"  # in each folder of results: the names of its files
_LITTER = {".DS_Store", "Thumbs.db", "desktop.ini"}  # of file managers
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
    with _refusing_os_errors(f"write {target.name}"):
        if target.exists() and not target.is_file():
            raise OSError(EISDIR, "there is a folder, a device or a pipe of this name")
        replace_file(target, data)
    return target


def replace_file(target: Path, data: bytes, mode: int | None = None) -> None:
    """Write a file next to `target` to the disk and rename it in one step; `mode`: its permissions. Raises OSError."""
    scratch = target.with_name(f".{target.name}.{os.getpid()}.{get_ident()}.part")
    try:
        with scratch.open("wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        if mode is not None:
            scratch.chmod(mode)
        scratch.replace(target)
    finally:
        with suppress(OSError):
            scratch.unlink(missing_ok=True)


def write_files(folder: Path, documents: Mapping[str, bytes]) -> None:
    """Write files into a folder, each as `write_whole` does. Names may begin with a sub-folder.

    Raises UnusableInputError.
    """
    for name, data in documents.items():
        with _refusing_os_errors(f"write {name}"):
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
        write_whole(folder / name, data)


def write_folder(folder: Path, documents: Mapping[str, bytes]) -> list[Path]:
    """Write a folder with these files as `whole_folder` does; return their paths. Raises UnusableInputError."""
    with whole_folder(folder) as scratch:
        write_files(scratch, documents)
    return [folder / name for name in documents]


@contextmanager
def whole_folder(path: str | Path, units: Collection[str] = ()) -> Generator[Path]:
    """Yield a scratch folder next to `path`; at the end of the `with` block it takes the place of `path`.

    `path` is missing, empty, or an older result: a folder in which MANIFEST names all files. An older result is renamed
    to NAME.old, the new one to NAME, then the older one is removed. So NAME is the old result or the new one; after a
    kill between the two renames the old one is NAME.old, and the next run puts it back. After an error or an
    interruption nothing has changed.

    `units`: sub-folders that belong to the result with everything that is added to them later, such as a case.

    Raises UnusableInputError for any other folder, the working directory and a mount point, before the block runs, and
    where nothing can be written. Exceptions of the block are passed on.
    """
    target = Path(os.path.realpath(path))
    what = f"write the folder {target.name}"
    with _refusing_os_errors(what):
        target.parent.mkdir(parents=True, exist_ok=True)
        _put_back(target)
        _refuse_foreign(target)
        place = Path(mkdtemp(dir=target.parent, prefix=f".{target.name}-"))
    try:
        scratch = place / target.name  # with the usual permissions; `place` is accessible to its owner only
        with _refusing_os_errors(what):
            scratch.mkdir()
        yield scratch
        with _refusing_os_errors(what):
            names = [*sorted(_items(scratch, units)), *(f"{unit}/" for unit in units)]
            (scratch / MANIFEST).write_text(json.dumps({"files": names}, indent=1), "utf-8")
            _sync(scratch)
            _refuse_foreign(target)
            _replace(target, scratch)
            sync_folder(target.parent)
    finally:
        _remove(place)


@contextmanager
def scratch_folder() -> Generator[Path]:
    """Yield a temporary folder, removed afterwards as far as possible. Raises OSError.

    Not `TemporaryDirectory`: its removal recurses endlessly on a disk that has become read-only (Python 3.11).
    """
    place = Path(mkdtemp(prefix="sightline-"))
    try:
        yield place
    finally:
        _remove(place)


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


def _old(target: Path) -> Path:
    return target.with_name(f"{target.name}.old")


def _put_back(target: Path) -> None:
    """Finish what a kill left: an old result goes back where its place is free, and is removed where it is taken."""
    old = _old(target)
    if _is_result(old):
        if target.exists():
            _discard(old)
        else:
            old.rename(target)


def _discard(folder: Path) -> None:
    """Remove a folder. It is hidden first, so that a kill leaves no part of it under its name."""
    hidden = Path(mkdtemp(dir=folder.parent, prefix=f".{folder.name}-"))
    folder.rename(hidden / folder.name)
    _remove(hidden)


def _remove(folder: Path) -> None:
    """Remove a folder as far as possible, also where a second Ctrl-C interrupts that."""
    try:
        shutil.rmtree(folder, ignore_errors=True)
    except KeyboardInterrupt:
        shutil.rmtree(folder, ignore_errors=True)
        raise


def _replace(target: Path, new: Path) -> None:
    """Rename `target` away and `new` to it; undo the first where the second fails."""
    old = _old(target)
    if target.exists():
        shutil.copymode(target, new)
        target.rename(old)
    try:
        new.rename(target)
    except BaseException:
        if old.exists():
            old.rename(target)
        raise
    if old.exists():
        _discard(old)


def _refuse_foreign(target: Path) -> None:
    """Raise UnusableInputError where `target` is neither missing nor empty nor an older result."""
    if _old(target).exists():
        raise UnusableInputError(f"{_old(target).name} is in the way: it is where an old result is kept; rename it")
    if not target.exists():
        return
    if not target.is_dir():
        raise UnusableInputError(f"{target.name} is a file; name a folder")
    here = Path.cwd()
    if target in (here, *here.parents) or target.is_mount():
        raise UnusableInputError(
            f"the folder {target.name} is the working directory or a mount point, which cannot be replaced; "
            "name a folder in it"
        )
    if any(target.iterdir()) and not _is_result(target):
        raise UnusableInputError(
            f"the folder {target.name} holds files that no earlier result wrote; name another folder, or move them away"
        )


def _is_result(folder: Path) -> bool:
    """Return whether the folder's MANIFEST names everything in it; file managers' own files do not count."""
    try:
        names = set(json.loads((folder / MANIFEST).read_bytes())["files"])
        units = {name[:-1] for name in names if name.endswith("/")}
        return {name for name in _items(folder, units) if Path(name).name not in _LITTER} <= names | {MANIFEST}
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return False


def _items(folder: Path, units: Collection[str]) -> set[str]:
    """Return the relative paths of all files, links and empty folders outside the `units`, with / between folders."""
    items: set[str] = set()
    for here, folders, files in os.walk(folder):
        place = Path(here).relative_to(folder)
        if place == Path():
            folders[:] = [name for name in folders if name not in units]
        links = [name for name in folders if (folder / place / name).is_symlink()]
        items |= {(place / name).as_posix() for name in (*files, *links)}
        if not folders and not files and place != Path():
            items.add(place.as_posix())
    return items


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
