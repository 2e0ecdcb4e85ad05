"""Encoding of text and numbers in OpenIGTLink: big-endian, names in fields of fixed size padded with zeros."""

import math
import struct
from typing import Any

import numpy as np

from sightline.errors import MessageError

ASCII, UTF8 = 3, 106  # MIBenum of IANA: the two text encodings that are read here


class Reader:
    """Reads a message's content once. Raises MessageError if it ends too early, or if bytes are left over."""

    def __init__(self, content: bytes):
        self._content, self._at = content, 0

    @property
    def left(self) -> int:
        """Number of bytes not yet read."""
        return len(self._content) - self._at

    def take(self, count: int) -> bytes:
        """Return the next `count` bytes."""
        if count > self.left:
            raise MessageError(f"ends {count - self.left} bytes too early")
        self._at += count
        return self._content[self._at - count : self._at]

    def unpack(self, layout: str) -> tuple[Any, ...]:
        """Return big-endian numbers, with a layout in `struct`'s format characters."""
        return struct.unpack(">" + layout, self.take(struct.calcsize(">" + layout)))

    def text(self, size: int) -> str:
        """Return the text in a field of `size` bytes, up to the first zero."""
        return text_of(self.take(size).split(b"\0", 1)[0])

    def encoded_text(self, length: int, encoding: int) -> str:
        """Return a text of `length` bytes in a stated encoding."""
        if encoding not in (ASCII, UTF8):
            raise MessageError(f"its text has encoding {encoding}; only US-ASCII (3) and UTF-8 (106) are read")
        return text_of(self.take(length))  # as UTF-8 in both cases: some peers send it and call it ASCII

    def floats(self, *shape: int) -> np.ndarray:
        """Return 32-bit floats as float64."""
        with np.errstate(invalid="ignore"):  # a signalling NaN is a NaN
            return np.frombuffer(self.take(4 * math.prod(shape)), dtype=">f4").astype(np.float64).reshape(shape)

    def doubles(self, *shape: int) -> np.ndarray:
        """Return 64-bit floats."""
        return np.frombuffer(self.take(8 * math.prod(shape)), dtype=">f8").astype(np.float64).reshape(shape)

    def finish(self) -> None:
        """Check that everything was read."""
        if self.left:
            raise MessageError(f"is {self.left} bytes too long")


def text_of(data: bytes) -> str:
    """Return bytes decoded as UTF-8. Raises MessageError."""
    try:
        return data.decode("utf-8")
    except UnicodeDecodeError as error:
        raise MessageError(f"holds text that is not UTF-8: {data[:24]!r}") from error


def field(text: str, size: int, what: str) -> bytes:
    """Return a text in a field of `size` bytes. Raises MessageError if it does not fit, rather than cut a name."""
    data = text.encode("utf-8")
    if len(data) > size:
        raise MessageError(f"{what} {text!r} has {len(data)} bytes; at most {size} fit")
    if b"\0" in data:
        raise MessageError(f"{what} {text!r} holds a zero byte, which ends it")
    return data.ljust(size, b"\0")


def encoded(text: str) -> tuple[int, bytes]:
    """Return (encoding, bytes): US-ASCII if that is enough, else UTF-8."""
    return (ASCII if text.isascii() else UTF8), text.encode("utf-8")


def floats(values: np.ndarray) -> bytes:
    """Return 32-bit floats as bytes. Raises MessageError for a finite number that is too large."""
    try:
        with np.errstate(over="raise", invalid="ignore"):
            return np.asarray(values, dtype=np.float64).astype(">f4").tobytes()
    except FloatingPointError as error:
        raise MessageError("a number is too large for the 32 bits of the wire") from error


def read_only(values: Any, what: str, shape: tuple[int | None, ...]) -> np.ndarray:
    """Return a read-only copy as float64. Raises MessageError for another shape; None in `shape` allows any size."""
    array = np.array(values, dtype=np.float64)
    if array.shape != shape and (
        array.ndim != len(shape) or any(n not in (None, m) for n, m in zip(shape, array.shape, strict=True))
    ):
        raise MessageError(f"{what} has shape {array.shape}, not {tuple('any' if n is None else n for n in shape)}")
    array.flags.writeable = False
    return array
