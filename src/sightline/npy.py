"""NumPy files of other people: nothing is made of a size that the file does not have."""

import io
from collections.abc import Callable
from math import prod

import numpy as np

Look = Callable[[tuple[int, ...], np.dtype], None]


def npy_array(data: bytes, look: Look) -> np.ndarray:
    """The array of a `.npy` file. `look` is shown its shape and type first, and raises on what is not wanted.

    Raises what `look` raises, and ValueError on what is no whole file.
    """
    stream = io.BytesIO(data)
    try:
        first = np.lib.format.read_magic(stream) == (1, 0)
        header = np.lib.format.read_array_header_1_0 if first else np.lib.format.read_array_header_2_0
        shape, _, dtype = header(stream)
    except Exception:  # the header is parsed as Python, and raises whatever that parser raises
        raise ValueError("the header is damaged") from None
    look(shape, dtype)
    if dtype.hasobject or min(shape, default=0) < 0 or stream.tell() + prod(shape) * dtype.itemsize != len(data):
        raise ValueError("the file does not hold what its header states")
    return np.load(io.BytesIO(data), allow_pickle=False)
