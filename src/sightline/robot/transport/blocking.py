"""The calling side without an event loop: send, and wait for what comes."""

import select
import socket
import time
from collections import deque
from contextlib import suppress
from threading import Lock

from sightline.closing import Closing
from sightline.errors import LinkError
from sightline.robot.igtl import Event, Message, Rejected, Stream, encode
from sightline.robot.transport.client import CONNECT_S
from sightline.robot.transport.heartbeat import Heartbeat, Pace
from sightline.robot.transport.server import LOOPBACK, PORT
from sightline.robot.transport.sockets import prepare

# Bytes read at once, some twenty messages: a call shows after each piece that it goes on. A client that lags decodes
# 64 KiB in 25 ms, which takes it 0.5 s where nine others want its processor [measured].
_PIECE = 1 << 12
_SEND_S = 5.0  # [ours] a peer that reads nothing for so long is given up


class BlockingClient(Closing):
    """A connection: any thread may send and close, one at a time receive. Raises LinkError where it cannot be made in
    time.

    It does not connect again by itself, and it hears nothing between two calls.
    """

    def __init__(self, host: str = LOOPBACK, port: int = PORT):
        self._stream = Stream()
        self._events: deque[Event] = deque()
        try:
            self._socket = socket.create_connection((host, port), timeout=CONNECT_S)
        except OSError as error:
            raise LinkError(f"cannot connect to {host}:{port}: {error.strerror or error}") from error
        prepare(self._socket)
        self._writer = self._socket.dup()  # a socket's time limit is its own: receiving must not shorten sending
        self._writer.settimeout(_SEND_S)
        self._writing = Lock()

    def send(self, message: Message) -> None:
        """Send it. Raises LinkError where the connection is gone, MessageError as `encode` does."""
        self.send_bytes(encode(message))

    def heartbeat(self, message: Message, pace: Pace) -> Heartbeat:
        """Heartbeats on this connection from a process of their own. Raises LinkError where it does not start."""
        try:
            return Heartbeat(self._writer, encode(message), pace)
        except OSError as error:
            raise LinkError(f"heartbeats cannot be sent: {error}") from error

    def send_bytes(self, *pieces: bytes) -> None:
        """The same, of what may be no message and in several pieces: a test of the peer."""
        try:
            with self._writing:
                for piece in pieces:
                    # What is writable takes a message of the contract whole: no heartbeat comes within a piece.
                    if not select.select([], [self._writer], [], _SEND_S)[1]:
                        raise TimeoutError("the peer does not read")
                    self._writer.sendall(piece)
        except (OSError, ValueError) as error:  # the latter: closed by another thread
            self.close()
            raise LinkError(f"the connection was lost: {error}") from error

    def receive(self, timeout_s: float) -> Event | None:
        """What came next, in order; None where nothing was complete in time. With a time of 0, what is there already.
        Raises LinkError after the end."""
        end = time.monotonic() + timeout_s
        while not self._events:
            left = end - time.monotonic()
            self._hear(max(left, 0.0))
            if left <= 0 and not self._events:
                return None
        event = self._events.popleft()
        if isinstance(event, Rejected) and event.fatal:
            self.close()
        return event

    @property
    def closed(self) -> bool:
        """Whether it has ended."""
        return self._socket.fileno() < 0

    def close(self) -> None:
        """End it; the peer and a thread that receives notice at once."""
        with suppress(OSError):
            self._socket.shutdown(socket.SHUT_RDWR)
        self._socket.close()
        self._writer.close()

    def _hear(self, timeout_s: float) -> None:
        try:
            self._socket.settimeout(timeout_s)
            data = self._socket.recv(_PIECE)
        except (TimeoutError, BlockingIOError):
            return
        except OSError as error:
            self.close()
            raise LinkError(f"the connection was lost: {error}") from error
        if not data:
            self.close()
            raise LinkError("the connection was closed by the peer")
        self._events += self._stream.feed(data)
