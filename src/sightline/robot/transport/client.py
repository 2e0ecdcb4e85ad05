"""Clients: one for an event loop, which reconnects, and one that blocks."""

import asyncio
import select
import socket
import time
from collections import deque
from contextlib import suppress
from threading import Lock
from types import TracebackType
from typing import Self

from sightline.common.closing import Closing
from sightline.errors import LinkError
from sightline.robot.igtl import Event, Message, Rejected, Stream, encode
from sightline.robot.transport.connection import CONNECT_S, LOOPBACK, MESSAGE_S, PORT, Connection, Handler, prepare
from sightline.robot.transport.heartbeat import Heartbeat, Pace

_FIRST_RETRY_S, _LAST_RETRY_S = CONNECT_S / 20, CONNECT_S  # doubled from one to the other
# Bytes read at once, some twenty messages: a call shows progress after each piece. A client with a backlog decodes
# 64 KiB in 25 ms, or in 0.5 s when nine others compete for its processor [measured].
_PIECE = 1 << 12


class Client:
    """`async with Client(handler)` connects, or raises LinkError; later it reconnects when the connection is lost.

    `opened` of the handler is called for every new connection. A robot may have stopped or restarted meanwhile, so
    query its state first. `connection` is None while there is none.
    """

    def __init__(self, handler: Handler, host: str = LOOPBACK, port: int = PORT):
        self.connection: Connection | None = None
        self._handler, self._host, self._port = handler, host, port
        self._keeper: asyncio.Task[None]

    async def __aenter__(self) -> Self:
        self.connection = await self._connect()
        self._keeper = asyncio.create_task(self._keep())
        return self

    async def __aexit__(
        self, error_type: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._keeper.cancel()
        with suppress(asyncio.CancelledError):
            await self._keeper
        if self.connection is not None:
            self.connection.close("the client ends")
            await self.connection.wait_closed()
            self.connection = None

    async def _connect(self) -> Connection:
        loop = asyncio.get_running_loop()
        address = f"{self._host}:{self._port}"
        try:
            async with asyncio.timeout(CONNECT_S):
                _, connection = await loop.create_connection(lambda: Connection(self._handler), self._host, self._port)
        except TimeoutError as error:
            raise LinkError(f"{address} did not answer within {CONNECT_S:g} s") from error
        except OSError as error:
            raise LinkError(f"cannot connect to {address}: {error.strerror or error}") from error
        return connection

    async def _keep(self) -> None:
        while True:
            if self.connection is not None:
                await self.connection.wait_closed()
                self.connection = None
            wait_s = _FIRST_RETRY_S
            while self.connection is None:
                await asyncio.sleep(wait_s)
                wait_s = min(2 * wait_s, _LAST_RETRY_S)
                with suppress(LinkError):
                    self.connection = await self._connect()


class BlockingClient(Closing):
    """A connection. Any thread may send and close; one thread at a time may receive. Raises LinkError if it cannot
    connect in time.

    It does not reconnect by itself, and it reads nothing between calls.
    """

    def __init__(self, host: str = LOOPBACK, port: int = PORT):
        self._stream = Stream()
        self._events: deque[Event] = deque()
        try:
            self._socket = socket.create_connection((host, port), timeout=CONNECT_S)
        except OSError as error:
            raise LinkError(f"cannot connect to {host}:{port}: {error.strerror or error}") from error
        prepare(self._socket)
        self._writer = self._socket.dup()  # has its own timeout, which receiving must not shorten
        self._writer.settimeout(MESSAGE_S)
        self._writing = Lock()

    def send(self, message: Message) -> None:
        """Send a message. Raises LinkError if the connection is lost, MessageError as `encode` does."""
        self.send_bytes(encode(message))

    def heartbeat(self, message: Message, pace: Pace) -> Heartbeat:
        """Start heartbeats on this connection from a separate process. Raises LinkError if it does not start."""
        try:
            return Heartbeat(self._writer, encode(message), pace)
        except OSError as error:
            raise LinkError(f"heartbeats cannot be sent: {error}") from error

    def send_bytes(self, *pieces: bytes) -> None:
        """Send raw bytes, possibly in several pieces, to test the peer. Raises LinkError."""
        try:
            with self._writing:
                for piece in pieces:
                    # A writable socket accepts any message of the contract at once: no heartbeat comes within a piece.
                    if not select.select([], [self._writer], [], MESSAGE_S)[1]:
                        raise TimeoutError("the peer does not read")
                    self._writer.sendall(piece)
        except (OSError, ValueError) as error:  # the latter: closed by another thread
            self.close()
            raise LinkError(f"the connection was lost: {getattr(error, 'strerror', None) or error}") from error

    def receive(self, timeout_s: float) -> Event | None:
        """Return the next event in order, or None if none was complete in time; with a timeout of 0, one that is
        already there. Raises LinkError once the connection has ended."""
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
        """Whether the connection has ended."""
        return self._socket.fileno() < 0

    def close(self) -> None:
        """Close the connection; the peer and a receiving thread notice at once."""
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
            raise LinkError(f"the connection was lost: {error.strerror or error}") from error
        if not data:
            self.close()
            raise LinkError("the connection was closed by the peer")
        self._events += self._stream.feed(data)
