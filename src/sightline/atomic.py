"""Files that are whole or not there: nothing half-written is ever left behind."""

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from tempfile import TemporaryDirectory

from sightline.errors import UnusableInputError


def write_whole(path: str | Path, data: bytes) -> Path:
    """Write a file beside its target and move it there in one step; an old file stays whole until then.

    Raises UnusableInputError where the place cannot be written.
    """
    target = Path(path)
    scratch = target.with_name(f".{target.name}.{os.getpid()}.part")
    try:
        with scratch.open("wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        scratch.replace(target)
    except OSError as error:
        raise UnusableInputError(f"cannot write {target.name}: {error.strerror}; name a folder that exists") from error
    finally:
        with suppress(OSError):
            scratch.unlink(missing_ok=True)
    return target


@contextmanager
def whole_folder(path: str | Path) -> Iterator[Path]:
    """`with whole_folder(out) as scratch:` what is written into the scratch folder beside `out` is moved there at the
    end; after an error or an interruption nothing is.

    Files that `out` holds under other names stay; a folder in it is replaced as a whole.
    Raises UnusableInputError where the place cannot be written.
    """
    target = Path(path)
    try:
        if target.exists() and not target.is_dir():
            raise UnusableInputError(f"{target.name} is a file; name a folder")
        target.parent.mkdir(parents=True, exist_ok=True)
        with TemporaryDirectory(dir=target.parent, prefix=f".{target.name}-") as scratch:
            yield Path(scratch)
            target.mkdir(exist_ok=True)
            for file in sorted(Path(scratch).iterdir()):
                place = target / file.name
                if file.is_dir() and place.exists():
                    place.rename(Path(scratch) / f".{file.name}.before")  # goes with the scratch folder
                file.replace(place)
    except OSError as error:
        raise UnusableInputError(f"cannot write into {target.name}: {error.strerror}; name another folder") from error
