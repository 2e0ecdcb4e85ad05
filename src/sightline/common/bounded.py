"""Safe reading of untrusted files: only regular files, and never more than a limit."""

import csv
import io
import re
from collections.abc import Callable, Generator
from contextlib import contextmanager
from errno import EISDIR
from io import BufferedReader
from math import prod
from pathlib import Path

import numpy as np

from sightline.errors import UnusableInputError

# Size limits [ours]: far above what programs write, far below what exhausts the memory of a machine.
MAX_TEXT_BYTES = 2**22  # of tables and of small documents: forty thousand beads
MAX_JSON_BYTES = 2**26  # of results, plans and frames: six times the full covariance of a built-in frame
MAX_FILE_BYTES = 2**30  # of images: a run of 500 frames of 1024² at 16 bit
MAX_PIXELS = 2**25  # of one image: twice a 43 cm flat panel at 0.105 mm


@contextmanager
def regular_file(file: Path) -> Generator[BufferedReader]:
    """Open a regular file for reading. Raises OSError, also on a folder, a device or a pipe.

    Reading a pipe may block forever, and a device may have no end.
    """
    if file.exists() and not file.is_file():
        raise OSError(EISDIR, "it is a folder, a device or a pipe, not a file")
    with file.open("rb") as stream:
        yield stream


def read_bounded(file: Path, max_bytes: int, refuse: type[UnusableInputError], hint: str) -> bytes:
    """Return the content of a file of at most `max_bytes`. Raises `refuse`; of a larger file its message has `hint`."""
    try:
        with regular_file(file) as stream:
            data = stream.read(max_bytes + 1)
    except OSError as error:
        raise refuse(f"cannot read {file.name}: {error.strerror}") from error
    if len(data) > max_bytes:
        size = f"{max_bytes >> 20} MiB" if max_bytes >= 2**20 else f"{max_bytes >> 10} KiB"
        raise refuse(f"{file.name} is larger than {size}; {hint}")
    return data


def read_csv(file: Path, max_bytes: int, refuse: type[UnusableInputError], hint: str) -> str:
    """Return the text of a table of at most `max_bytes`, in UTF-8, with commas between cells and decimal points.

    Raises `refuse`.
    """
    try:
        text = read_bounded(file, max_bytes, refuse, hint).decode("utf-8-sig")
        return _with_commas(text)
    except UnicodeDecodeError as error:
        raise refuse(f"{file.name} is not a text file in UTF-8; {hint}") from error
    except csv.Error as error:
        raise refuse(f"{file.name} is not a table (CSV): {error}") from None
    except ValueError as error:
        raise refuse(f"{file.name}: {error}") from None


_DECIMAL_COMMA = re.compile(r"\s*[+-]?\d*,\d+(?:[eE][+-]?\d+)?\s*")
_DECIMAL_POINT = re.compile(r"\s*[+-]?\d*\.\d+(?:[eE][+-]?\d+)?\s*")


def _with_commas(text: str) -> str:
    """Return a table whose cells are separated by semicolons or tabs with commas instead, and its decimal commas as
    points. Raises ValueError where it has numbers of both kinds: one of them may separate thousands."""
    first = text.partition("\n")[0]
    separator = next((mark for mark in ";\t" if mark in first), None)
    if separator is None:
        return text
    rows = list(csv.reader(io.StringIO(text, newline=""), delimiter=separator, strict=True))
    cells = [cell for row in rows for cell in row]
    comma = next((cell for cell in cells if _DECIMAL_COMMA.fullmatch(cell)), None)
    point = next((cell for cell in cells if _DECIMAL_POINT.fullmatch(cell)), None)
    if comma and point:
        raise ValueError(f"{comma.strip()} has a decimal comma and {point.strip()} a point; write all numbers alike")
    written = io.StringIO()
    csv.writer(written, lineterminator="\n").writerows(
        [cell.replace(",", ".") if _DECIMAL_COMMA.fullmatch(cell) else cell for cell in row] for row in rows
    )
    return written.getvalue()


CheckArray = Callable[[tuple[int, ...], np.dtype], None]


def npy_array(data: bytes, check: CheckArray) -> np.ndarray:
    """Return the array of a `.npy` file. `check` is called with its shape and type first, and may raise.

    Raises the errors of `check`, and ValueError on a damaged file.
    """
    stream = io.BytesIO(data)
    try:
        first = np.lib.format.read_magic(stream) == (1, 0)
        header = np.lib.format.read_array_header_1_0 if first else np.lib.format.read_array_header_2_0
        shape, _, dtype = header(stream)
    except Exception:  # the header is parsed as Python, which may raise any exception
        raise ValueError("the header is damaged") from None
    check(shape, dtype)
    if dtype.hasobject or min(shape, default=0) < 0 or stream.tell() + prod(shape) * dtype.itemsize != len(data):
        raise ValueError("the file does not hold what its header states")
    return np.load(io.BytesIO(data), allow_pickle=False)
