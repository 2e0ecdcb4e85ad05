"""Files and folders that are written whole or not at all: nothing half-written is ever left under their names."""

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

_BEFORE = "before"  # of a scratch folder: old files, until the new ones are in their places
_ADVICE = {
    ENOENT: "name a folder that exists",
    **dict.fromkeys((ENOSPC, EDQUOT, EFBIG), "free some space, or name a place on another disk"),
}


def write_whole(path: str | Path, data: bytes) -> Path:
    """Write a file beside its target and move it there in one step; an old file stays whole until then.

    Raises UnusableInputError where the place cannot be written, or holds anything but a regular file: a device, a pipe
    or a folder is not replaced.
    """
    target = Path(path)
    scratch = target.with_name(f".{target.name}.{os.getpid()}.{get_ident()}.part")
    with _placing(f"write {target.name}"):
        try:
            _refuse_odd(target)
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
    """Write files into a folder, made where it is missing, as `whole_folder` does. A name may begin with a sub-folder.

    Raises UnusableInputError.
    """
    with whole_folder(folder) as scratch:
        for name, data in documents.items():
            with _placing(f"write {name}"):
                (scratch / name).parent.mkdir(parents=True, exist_ok=True)
            write_whole(scratch / name, data)
    return [folder / name for name in documents]


@contextmanager
def whole_folder(path: str | Path, units: Collection[str] = ()) -> Generator[Path]:
    """`with whole_folder(out) as scratch:` what is written into the scratch folder beside `out` is put there at the
    end; after an error or an interruption nothing is.

    Other files that `out` holds stay and are never moved. A sub-folder is merged likewise, unless it is one of `units`,
    which are replaced as a whole. A process killed at any moment leaves `out` old or new:

    - where `out` is missing, the scratch folder is renamed;
    - where all that it holds is replaced, both folders change places in one step (Linux, renameat2);
    - otherwise (other files are there, `out` is the working directory or a mount point, another system) all old files
      are taken out before the first new one is put in. A kill in between leaves a part of one result, never parts of
      two; the rest lies in the scratch folder, whose name begins with a dot.

    Raises UnusableInputError where the place cannot be written. What the body raises is passed on as it is.
    """
    target = Path(os.path.realpath(path))
    said = f"write into {target.name}"
    if target.exists() and not target.is_dir():
        raise UnusableInputError(f"{target.name} is a file; name a folder")
    with _placing(said):
        target.parent.mkdir(parents=True, exist_ok=True)
        place = Path(mkdtemp(dir=target.parent, prefix=f".{target.name}-"))
    try:
        scratch = place / target.name  # with the usual permissions; those of `place` are for its owner alone
        with _placing(said):
            scratch.mkdir()
        yield scratch
        with _placing(said):
            _sync(scratch)
            _put(scratch, target, units)
            sync_folder(target.parent)
    finally:
        if not (place / _BEFORE).exists():  # else it holds old files that could not be put back
            shutil.rmtree(place, ignore_errors=True)


@contextmanager
def scratch_folder() -> Generator[Path]:
    """A folder for files on their way, removed afterwards as far as the disk lets it. Raises OSError.

    Not `TemporaryDirectory`: on a disk that can no longer be written its removal recurses without end (Python 3.11)."""
    place = Path(mkdtemp(prefix="sightline-"))
    try:
        yield place
    finally:
        shutil.rmtree(place, ignore_errors=True)


def sync_folder(folder: Path) -> None:
    """Fsync a folder to make renames in it durable; Windows has no such thing."""
    if os.name == "posix":
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)


def is_of_a_disk(error: OSError) -> bool:
    """Whether a disk is full, read-only or fails, and no program is to blame."""
    return error.errno in (ENOSPC, EDQUOT, EFBIG, EROFS, EACCES, EPERM, EIO)


def advice(error: OSError) -> str:
    """What to do about a place that cannot be written."""
    return _ADVICE.get(error.errno or 0, "name another place")


@contextmanager
def _placing(what: str) -> Generator[None]:
    try:
        yield
    except OSError as error:
        raise UnusableInputError(f"cannot {what}: {error.strerror}; {advice(error)}") from error


def _refuse_odd(place: Path) -> None:
    """Raises OSError where there is anything but a regular file."""
    if place.exists() and not place.is_file():
        raise OSError(EISDIR, "there is a folder, a device or a pipe of this name")


def _put(new: Path, target: Path, units: Collection[str]) -> None:
    items = _items(new, units)
    if not target.exists():
        new.rename(target)
    elif _items(target, units) <= items and _may_change_places(new, target) and _exchange(new, target):
        for appeared in _items(new, units) - items:  # between the look and the exchange
            (target / appeared).parent.mkdir(parents=True, exist_ok=True)
            (new / appeared).rename(target / appeared)
    else:
        _put_each(new, target, items, units)


def _items(folder: Path, units: Collection[str]) -> set[Path]:
    """Relative paths of all files, units and empty folders."""
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


def _may_change_places(new: Path, target: Path) -> bool:
    """Whether nobody would notice: not of a shell that stands in the folder, nor where the owner would change."""
    here, old, made = Path.cwd(), target.stat(), new.stat()
    if target in (here, *here.parents) or (old.st_uid, old.st_gid) != (made.st_uid, made.st_gid):
        return False
    shutil.copystat(target, new)
    return True


def _exchange(one: Path, other: Path) -> bool:
    """Let two folders change places in one step; return False where the system cannot."""
    if sys.platform != "linux" or not hasattr(libc := ctypes.CDLL(None), "renameat2"):
        return False
    here, exchange = -100, 2  # AT_FDCWD, RENAME_EXCHANGE (linux/fcntl.h, linux/fs.h)
    return libc.renameat2(here, os.fsencode(one), here, os.fsencode(other), exchange) == 0


def _put_each(new: Path, target: Path, items: Collection[Path], units: Collection[str]) -> None:
    """Every old item out, then every new one in; all is taken back where one cannot be moved. What the disk does not
    let be taken back stays in the scratch folder."""
    before = new.parent / _BEFORE
    moved: list[tuple[Path, Path]] = []

    def move(source: Path, place: Path) -> None:
        place.parent.mkdir(parents=True, exist_ok=True)
        source.rename(place)
        moved.append((source, place))

    try:
        for item in sorted(items):
            if str(item) not in units:
                _refuse_odd(target / item)
            if os.path.lexists(target / item):
                move(target / item, before / item)
        for item in sorted(items):
            move(new / item, target / item)
    except BaseException:
        try:
            for source, place in reversed(moved):
                place.rename(source)
        except OSError as error:
            lies = f"what was there could not be put back: it lies beside it, in {before.parent.name}"
            raise OSError(error.errno, f"{error.strerror}, and {lies}") from error
        shutil.rmtree(before, ignore_errors=True)
        raise
    shutil.rmtree(before, ignore_errors=True)


def _sync(folder: Path) -> None:
    """Fsync all that is in a folder."""
    for here, _, files in os.walk(folder):
        for name in files:
            with (Path(here) / name).open("rb") as file, suppress(OSError):  # Windows syncs what is written alone
                os.fsync(file.fileno())
        sync_folder(Path(here))
