"""Heartbeats from a separate process: the client's computation cannot delay them, and they end if the client hangs.

Run as a program, this file imports nothing of the package, so that it starts in 30 ms. It sends on the client's own
connection. Over a socket pair the client repeats WAITING while a call waits for the robot, and sends IDLE when none
does. The process ends when the client ends for any reason, because that closes the pair.
"""

import os
import select
import signal
import socket
import subprocess
import sys
import threading
import time
from contextlib import suppress
from typing import NamedTuple

WAITING, IDLE = b"w", b"i"
START_S = 10.0  # time limit to start; a busy machine takes a second [measured]
TICK_S = 0.02  # [ours] period of WAITING from a client that waits: two and more in each period of heartbeats
_PRIORITY = 1  # lowest real-time priority, if the system allows it: each heartbeat takes 50 µs


class Pace(NamedTuple):
    """Timing, s: period of heartbeats while a call waits; time without progress after which a call counts as hung;
    period of heartbeats while no call waits."""

    every_s: float
    alive_s: float
    idle_s: float


def beat(link: socket.socket, reports: socket.socket, message: bytes, pace: Pace) -> None:
    """Send heartbeats until the client or the connection has ended."""
    waiting, quiet_s, sent_s, turned_s = False, 0.0, -pace.idle_s, time.monotonic()
    while True:
        now = time.monotonic()
        # At most this much of a pause of this process counts: the client, on the same machine, may have paused too.
        quiet_s += min(now - turned_s, 2 * pace.every_s)
        turned_s = now
        due = quiet_s < pace.alive_s if waiting else now - sent_s >= pace.idle_s
        if due and now - sent_s >= pace.every_s:
            if not _sent(link, message):
                return
            sent_s = now
        left = sent_s + pace.every_s - time.monotonic()
        if select.select([reports], [], [], min(max(left, 0.001), pace.every_s))[0]:
            report = reports.recv(4096)
            if not report:
                return
            waiting, quiet_s, turned_s = report.endswith(WAITING), 0.0, time.monotonic()


def _sent(link: socket.socket, message: bytes) -> bool:
    """Send a heartbeat unless the peer reads nothing: half a message would corrupt what follows. Returns whether the
    connection stands."""
    try:
        return not select.select([], [link], [], 0.0)[1] or link.send(message) == len(message)
    except OSError:
        return False


class Heartbeat:
    """Sends heartbeats on `link` from now on. Others must write to `link` whole messages only, when it is writable."""

    def __init__(self, link: socket.socket, message: bytes, pace: Pace) -> None:
        self._own, reports = socket.socketpair()
        self._own.setblocking(False)
        self._ticked_s = 0.0
        self._process: subprocess.Popen[bytes] | None = None
        if os.name == "posix":
            numbers = (link.fileno(), reports.fileno())
            command = [sys.executable, "-I", "-S", __file__, *map(str, numbers), message.hex(), *map(str, pace)]
            self._process = subprocess.Popen(command, pass_fds=numbers, stdin=subprocess.DEVNULL)  # noqa: S603
            reports.close()
        else:  # Windows does not inherit sockets; a thread can be delayed by the interpreter lock
            threading.Thread(target=beat, args=(link, reports, message, pace), name="heartbeat", daemon=True).start()
            return
        if not select.select([self._own], [], [], START_S)[0] or not self._own.recv(1):
            self.close()
            raise OSError("heartbeats did not start")

    def waits(self) -> None:
        """Report that a call is waiting for the robot and makes progress."""
        now = time.monotonic()
        if now - self._ticked_s >= TICK_S:
            self._ticked_s = now
            self._say(WAITING)

    def idles(self) -> None:
        """Report that no call is waiting."""
        self._ticked_s = 0.0
        self._say(IDLE)

    def close(self) -> None:
        """Stop sending heartbeats."""
        self._own.close()
        if self._process is not None:
            with suppress(subprocess.TimeoutExpired):
                self._process.wait(START_S)

    def _say(self, what: bytes) -> None:
        with suppress(OSError):  # the process has ended, or has unread reports already
            self._own.send(what)


def _main(link: str, reports: str, message: str, *pace: str) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the client handles Ctrl-C and ends this process
    with suppress(OSError, AttributeError):
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(_PRIORITY))
    pair = socket.socket(fileno=int(reports))
    pair.send(b"r")
    beat(socket.socket(fileno=int(link)), pair, bytes.fromhex(message), Pace(*map(float, pace)))


if __name__ == "__main__":
    _main(*sys.argv[1:])
