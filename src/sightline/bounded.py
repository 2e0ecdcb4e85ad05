"""Files of other people: regular files alone are opened, and read whole but never beyond a limit."""

from collections.abc import Generator
from contextlib import contextmanager
from errno import EISDIR
from io import BufferedReader
from pathlib import Path

from sightline.errors import UnusableInputError


@contextmanager
def regular_file(file: Path) -> Generator[BufferedReader]:
    """Open a regular file for reading. Raises OSError, also on a folder, a device or a pipe.

    A pipe would be waited for without end, and a device may have no end.
    """
    if file.exists() and not file.is_file():
        raise OSError(EISDIR, "it is a folder, a device or a pipe, not a file")
    with file.open("rb") as stream:
        yield stream


def read_bounded(file: Path, most_bytes: int, refuse: type[UnusableInputError], hint: str) -> bytes:
    """A whole file of at most `most_bytes`. Raises `refuse`, for one that is too large with the `hint` what to give."""
    try:
        with regular_file(file) as stream:
            data = stream.read(most_bytes + 1)
    except OSError as error:
        raise refuse(f"cannot read {file.name}: {error.strerror}") from error
    if len(data) > most_bytes:
        size = f"{most_bytes >> 20} MiB" if most_bytes >= 2**20 else f"{most_bytes >> 10} KiB"
        raise refuse(f"{file.name} is larger than {size}; {hint}")
    return data


def read_text(file: Path, most_bytes: int, refuse: type[UnusableInputError], hint: str) -> str:
    """The same as UTF-8. Raises `refuse`."""
    try:
        return read_bounded(file, most_bytes, refuse, hint).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise refuse(f"{file.name} is not a text file in UTF-8; {hint}") from error
