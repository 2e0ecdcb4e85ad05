"""Decode compressed frames in a separate process, because decoders can crash on damaged data.

gdcm may call `terminate` on a damaged JPEG, which no `except` catches. Here, that ends only the helper process.
"""

import atexit
import json
import os
import subprocess
import sys
from contextlib import suppress
from pathlib import Path
from threading import Lock, Timer
from typing import IO

import numpy as np

DEADLINE_S = 30.0  # [ours] a frame of 2^25 pixels takes 2 s; includes the helper's start
MEMORY_BYTES = 4 << 30  # [ours] address space: the largest file, its largest frame twice, libraries


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
    from pydicom.pixels.utils import pixel_array

    with suppress(ImportError, ValueError):  # Windows has no such limits
        import resource

        resource.setrlimit(resource.RLIMIT_AS, (MEMORY_BYTES, MEMORY_BYTES))
    gdcm.Trace.WarningOff()
    gdcm.Trace.ErrorOff()
    out = sys.stdout.buffer
    for line in sys.stdin.buffer:
        file, index = json.loads(line)
        try:
            values = np.ascontiguousarray(pixel_array(file, index=index))
        except Exception:  # pydicom raises any exception on damaged data
            out.write(b"null\n")
        else:
            out.write(json.dumps({"shape": values.shape, "dtype": values.dtype.str}).encode() + b"\n")
            out.write(values.tobytes())
        out.flush()


if __name__ == "__main__":
    main()
