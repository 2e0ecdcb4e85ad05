"""Safe reading of untrusted NumPy files: no array larger than the file is allocated."""

import io
from collections.abc import Callable
from math import prod

import numpy as np

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
