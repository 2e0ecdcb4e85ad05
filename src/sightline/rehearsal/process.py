"""The robot of a rehearsal as a process of its own, as a real one is: started here, and surely ended."""

import subprocess
import sys
from contextlib import suppress
from json import JSONDecodeError, loads
from queue import Empty, SimpleQueue
from tempfile import TemporaryFile
from threading import Thread
from typing import IO

from sightline.closing import Closing
from sightline.errors import LinkError

START_S = 120.0  # imports and bone take 3 s; the very first start compiles kernels [measured]
END_S = 5.0  # what a robot takes to stop and say goodbye, and then some
_SAID = 2000  # characters of what it said that an error repeats


class RobotProcess(Closing):
    """`with RobotProcess(seed) as robot:` and a RobotClient at `robot.port`, loopback.

    The robot of `Rehearsal.draw(seed, Frame.load(frame), side)`. Blocks until it listens. It ends with the block, with
    `close`, and by itself when this process is gone, however that went. `virtual`: as fast as it computes, for clients
    without heartbeats. Raises LinkError where it does not start, with its own words.
    """

    def __init__(self, seed: int, frame: str = "gamma", side: str = "right", *, virtual: bool = False) -> None:
        command = [sys.executable, "-m", "sightline", "robot", "serve", "--attached", "--port", "0", "--quiet"]
        command += ["--rehearse", str(seed), "--frame", frame, "--side", side, *(["--virtual"] if virtual else [])]
        self._errors: IO[bytes] = TemporaryFile()  # noqa: SIM115 - closed by close
        self._process = subprocess.Popen(  # noqa: S603 - our own program, no shell
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=self._errors
        )
        try:
            self.port = self._listening_port()
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """End it: asked first, then made to. Again is nothing."""
        if self._process.stdin is not None:
            with suppress(OSError):
                self._process.stdin.close()  # which it notices
        for end in (lambda: None, self._process.terminate, self._process.kill):
            end()
            with suppress(subprocess.TimeoutExpired):
                self._process.wait(END_S)
                break
        if self._process.stdout is not None:
            self._process.stdout.close()
        self._errors.close()

    @property
    def pid(self) -> int:
        """Of the process."""
        return self._process.pid

    @property
    def alive(self) -> bool:
        """Whether it still runs."""
        return self._process.poll() is None

    def _listening_port(self) -> int:
        lines: SimpleQueue[bytes] = SimpleQueue()
        stdout = self._process.stdout
        assert stdout is not None  # noqa: S101
        # A pipe knows no time limit; a thread that waits for one line does.
        Thread(target=lambda: lines.put(stdout.readline()), name="robot's first line", daemon=True).start()
        try:
            return int(loads(lines.get(timeout=START_S))["port"])
        except Empty:
            raise LinkError(f"the simulated robot did not start within {START_S:g} s") from None
        except (JSONDecodeError, KeyError, TypeError, ValueError):
            self._process.terminate()
            with suppress(subprocess.TimeoutExpired):
                self._process.wait(END_S)
            raise LinkError(f"the simulated robot did not start: {self._said()}") from None

    def _said(self) -> str:
        self._errors.seek(0)
        return self._errors.read().decode(errors="replace").strip()[-_SAID:] or "it gave no reason"
