"""Files that are whole or not there: nothing half-written is ever left behind."""

import os
from contextlib import suppress
from pathlib import Path

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
