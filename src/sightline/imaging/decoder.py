"""Decode compressed frames in a separate process, because decoders can crash on damaged data.

A frame is decoded only if its own header states the size that the file states.
gdcm may call `terminate` on a damaged JPEG, which no `except` catches. Here, that ends only the helper process.
"""

import atexit
import json
import os
import struct
import subprocess
import sys
from contextlib import suppress
from itertools import pairwise
from pathlib import Path
from threading import Lock, Timer
from typing import IO

import numpy as np

from sightline.common.bounded import MAX_FILE_BYTES
from sightline.imaging.formats import refuse_longer

DEADLINE_S = 30.0  # [ours] a frame of 2^25 pixels takes 2 s; includes the helper's start
MEMORY_BYTES = 4 * MAX_FILE_BYTES  # address space: the largest file, its largest frame twice, libraries


class UndecodableError(Exception):
    """The frame is damaged, or compressed in a way that the libraries do not support."""


class Decoder:
    """A helper process, started at first use and again after it died; one thread uses it at a time."""

    def __init__(self) -> None:
        self._lock = Lock()
        self._helper: subprocess.Popen[bytes] | None = None
        self._owner = 0
        atexit.register(self.close)

    def decode(self, file: Path, index: int) -> np.ndarray:
        """Return the stored values of one frame, (H, W) or (H, W, 3). Raises UndecodableError."""
        with self._lock:
            helper = self._running()
            assert helper.stdin is not None  # noqa: S101
            assert helper.stdout is not None  # noqa: S101
            timer = Timer(DEADLINE_S, helper.kill)
            timer.start()
            try:
                helper.stdin.write(json.dumps([str(file.absolute()), index]).encode() + b"\n")
                helper.stdin.flush()
                return _read_answer(helper.stdout)
            except (OSError, ValueError):  # it died, perhaps within its answer
                self._end()
                raise UndecodableError from None
            finally:
                timer.cancel()

    def close(self) -> None:
        """End the helper process."""
        with self._lock:
            self._end()

    def _running(self) -> "subprocess.Popen[bytes]":
        if self._owner != os.getpid():  # after a fork the helper is the parent's
            self._helper, self._owner = None, os.getpid()
        if self._helper is None or self._helper.poll() is not None:
            self._end()
            self._helper = subprocess.Popen(
                [sys.executable, "-m", "sightline.imaging.decoder"],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,  # decoders' messages quote the file
                env={**os.environ, "OPENBLAS_NUM_THREADS": "1"},
                start_new_session=True,  # Ctrl-C is for the parent
            )
        return self._helper

    def _end(self) -> None:
        helper, self._helper = self._helper, None
        if helper is None or self._owner != os.getpid():
            return
        helper.kill()
        for pipe in (helper.stdin, helper.stdout):
            if pipe is not None:
                with suppress(OSError):
                    pipe.close()
        helper.wait()


def _read_answer(stream: IO[bytes]) -> np.ndarray:
    """Return the helper's answer. Raises UndecodableError if it refuses, ValueError if it ended within its answer."""
    head = json.loads(stream.readline())
    if head is None:
        raise UndecodableError
    shape, dtype = tuple(head["shape"]), np.dtype(head["dtype"])
    data = stream.read(int(np.prod(shape)) * dtype.itemsize)
    return np.frombuffer(data, dtype).reshape(shape)


def main() -> None:
    """Run the helper: for each line `[file, frame]`, write a line `{shape, dtype}` and the values, or `null`."""
    import gdcm
    from pydicom import dcmread
    from pydicom.pixels.utils import pixel_array

    with suppress(ImportError, ValueError):  # Windows has no such limits
        import resource

        resource.setrlimit(resource.RLIMIT_AS, (MEMORY_BYTES, MEMORY_BYTES))
    gdcm.Trace.WarningOff()
    gdcm.Trace.ErrorOff()
    stdout = sys.stdout.buffer
    for line in sys.stdin.buffer:
        file, index = json.loads(line)
        try:
            # All allocated bits: with fewer, gdcm drops those above.
            bits = dcmread(file, stop_before_pixels=True, specific_tags=["BitsAllocated"]).BitsAllocated
            values = np.ascontiguousarray(pixel_array(file, index=index, bits_stored=int(bits)))
        except Exception:  # pydicom raises any exception on damaged data
            stdout.write(b"null\n")
        else:
            stdout.write(json.dumps({"shape": values.shape, "dtype": values.dtype.str}).encode() + b"\n")
            stdout.write(values.tobytes())
        stdout.flush()


if __name__ == "__main__":
    main()


_J2K_SIZE = b"\xff\x4f\xff\x51"  # start of a codestream and its SIZ segment (ISO/IEC 15444-1, A.4 and A.5)
_JP2 = b"\x00\x00\x00\x0cjP  "  # a JP2 file around the codestream; the standard forbids it, some devices write it
_FRAME_HEADERS = {*range(0xC0, 0xD0), 0xF7} - {0xC4, 0xC8, 0xCC}  # SOF of JPEG; F7: of JPEG-LS
_RLE_SEGMENTS = 6  # PS3.5, G.3: two bytes of three colours
_RLE_HEADER = 64  # bytes


def starts_image(fragment: bytes, syntax: str) -> bool:
    """Return whether a fragment of compressed data begins a frame; RLE has one frame in each (PS3.5, A.4.2)."""
    from pydicom.uid import RLELossless

    return syntax == RLELossless or fragment.startswith((b"\xff\xd8", _J2K_SIZE, _JP2))


def unpacks_to(coded: bytes, syntax: str, shape: tuple[int, int], name: str) -> bool:
    """Return whether a frame's header states `shape` (H, W), with three components and two bytes at most.

    `name`: of the file, for messages. Raises ImageError for RLE of at least a row or a column more.
    """
    # Here, because other formats are read without pydicom.
    from pydicom.uid import JPEG2000TransferSyntaxes, JPEGLSTransferSyntaxes, JPEGTransferSyntaxes, RLELossless

    if syntax == RLELossless:
        return _rle_fits(coded, shape, name)
    if syntax in JPEGTransferSyntaxes or syntax in JPEGLSTransferSyntaxes:
        return jpeg_shape(coded) == shape
    return syntax in JPEG2000TransferSyntaxes and _j2k_shape(coded) == shape


def jpeg_shape(coded: bytes) -> tuple[int, int] | None:
    """Return height and width of the first frame header (ITU-T T.81, B.2.2); None where there is none."""
    at = 2
    while at + 9 <= len(coded) and coded[at] == 0xFF:
        if coded[at + 1] == 0xFF:  # a fill byte
            at += 1
            continue
        if coded[at + 1] in _FRAME_HEADERS:
            height, width, components = struct.unpack_from(">HHB", coded, at + 5)
            return (height, width) if components <= 3 else None
        at += 2 + struct.unpack_from(">H", coded, at + 2)[0]
    return None


def _j2k_shape(coded: bytes) -> tuple[int, int] | None:
    """Return height and width of the image area; None for other data and for more than three components."""
    at = coded.find(_J2K_SIZE, 0, 1024) if coded.startswith(_JP2) else 0
    if at < 0 or coded[at : at + 4] != _J2K_SIZE or len(coded) < at + 42:
        return None
    right, bottom, left, top = struct.unpack_from(">IIII", coded, at + 8)
    (components,) = struct.unpack_from(">H", coded, at + 40)
    return (bottom - top, right - left) if components <= 3 else None


def _rle_fits(coded: bytes, shape: tuple[int, int], name: str) -> bool:
    """Return whether each segment of a frame holds all pixels, in at most two bytes for each (PS3.5, G.3).

    Raises ImageError where a segment holds at least a row or a column more; less than that is padding.
    """
    pixels = shape[0] * shape[1]
    if len(coded) < _RLE_HEADER:
        return False
    segments, *starts = struct.unpack_from("<16I", coded)
    if not 0 < segments <= _RLE_SEGMENTS or len(coded) > _RLE_HEADER + segments * 2 * (pixels + max(shape)):
        return False
    bounds = [*starts[:segments], len(coded)]
    held = [_rle_length(coded[start:end]) for start, end in pairwise(bounds)]
    refuse_longer(pixels, max(held), *shape, name)
    return min(held) >= pixels


def _rle_length(segment: bytes) -> int:
    """Return how many bytes a segment unpacks to."""
    at = length = 0
    while at < len(segment) - 1:
        code = segment[at]
        count = 0 if code == 128 else code + 1 if code < 128 else 257 - code
        length += min(count, len(segment) - at - 1) if code < 128 else count
        at += 1 + (count if code < 128 else code > 128)
    return length
