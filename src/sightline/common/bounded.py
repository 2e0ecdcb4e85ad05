"""Safe reading of untrusted files: only regular files, and never more than a limit."""

import io
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
MAX_FILE_BYTES = 2**30  # of files that are read whole
MAX_RUN_BYTES = 2**32 - 2  # of DICOM runs, which are read by the frame: their length has 32 bits [PS3.5, 7.1]
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
