"""The robot of a rehearsal in a process of its own, which is started and reliably ended here."""

import subprocess
import sys
from contextlib import suppress
from functools import cached_property
from json import JSONDecodeError, loads
from queue import Empty, SimpleQueue
from tempfile import TemporaryFile
from threading import Thread
from typing import IO

from sightline.common.closing import Closing
from sightline.errors import LinkError

START_S = 120.0  # imports and bone take 3 s; the first start compiles kernels [measured]
END_S = 5.0  # time for a robot to stop and close its link, with a margin
_SHOWN = 2000  # last characters of its error output that a message repeats


class RobotProcess(Closing):
    """The robot of `Rehearsal.draw(seed, Frame.load(frame), side, procedure, arm)`, listening at `port` on loopback.

    Use it as `with RobotProcess(seed) as robot:`, with a RobotClient at `robot.port`, which waits until the robot
    listens. The process ends with the block, with `close`, and when this process ends in any way. `virtual`: run as
    fast as possible, without regard to heartbeats.
    """

    def __init__(
        self,
        seed: int,
        frame: str = "gamma",
        side: str = "right",
        procedure: str = "hip-screw",
        arm: str = "manipulator",
        *,
        virtual: bool = False,
    ) -> None:
        command = [sys.executable, "-m", "sightline", "robot", "serve", "--attached", "--port", "0", "--quiet"]
        command += ["--rehearse", str(seed), "--frame", frame, "--side", side, "--procedure", procedure]
        command += ["--arm", arm]
        command += ["--virtual"] if virtual else []
        self._errors: IO[bytes] = TemporaryFile()  # noqa: SIM115 - closed by close
        self._process = subprocess.Popen(  # noqa: S603 - our own program, no shell
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=self._errors
        )
        self._lines: SimpleQueue[bytes] = SimpleQueue()
        # Reading a pipe has no time limit; waiting for a thread that reads it has.
        Thread(target=self._read_line, name="robot's first line", daemon=True).start()

    def close(self) -> None:
        """End the process: ask, then terminate, then kill it. A second call does nothing.

        Until it listens it does not hear the question, and is terminated at once."""
        hears = "port" in self.__dict__ or not self._lines.empty()
        if self._process.stdin is not None:
            with suppress(OSError):
                self._process.stdin.close()  # the robot ends when its input closes
        asked = [lambda: None] if hears else []
        for end in (*asked, self._process.terminate, self._process.kill):
            end()
            with suppress(subprocess.TimeoutExpired):
                self._process.wait(END_S)
                break
        if self._process.stdout is not None:
            self._process.stdout.close()
        self._errors.close()

    @property
    def pid(self) -> int:
        """The process id."""
        return self._process.pid

    @property
    def alive(self) -> bool:
        """Whether the process is running."""
        return self._process.poll() is None

    @cached_property
    def port(self) -> int:
        """Where it listens; waits until it does. Raises LinkError, with its error output, if it does not start."""
        try:
            return int(loads(self._lines.get(timeout=START_S))["port"])
        except Empty:
            raise LinkError(f"the simulated robot did not start within {START_S:g} s") from None
        except (JSONDecodeError, KeyError, TypeError, ValueError):
            self._process.terminate()
            with suppress(subprocess.TimeoutExpired):
                self._process.wait(END_S)
            raise LinkError(f"the simulated robot did not start: {self._error_output()}") from None

    def _read_line(self) -> None:
        assert self._process.stdout is not None  # noqa: S101
        with suppress(ValueError):  # closed meanwhile
            self._lines.put(self._process.stdout.readline())

    def _error_output(self) -> str:
        self._errors.seek(0)
        return self._errors.read().decode(errors="replace").strip()[-_SHOWN:] or "it gave no reason"
