"""The listening side: several clients at one port."""

import asyncio
from types import TracebackType
from typing import Self

from sightline.errors import LinkError
from sightline.robot.igtl import MAX_BODY_BYTES, Event
from sightline.robot.transport.connection import Connection, Handler

LOOPBACK = "127.0.0.1"
PORT = 18936  # that of the needle robots' convention
MAX_CLIENTS = 8  # [ours] navigation, a stop on its own connection, displays; more is a fault or an attack


class Server:
    """Clients of a port; `serve` makes one. `async with` closes it."""

    def __init__(self, handler: Handler, silence_s: float | None, max_body_bytes: int):
        self.refused = 0  # clients turned away because there were too many
        self._handler = handler
        self._silence_s, self._max_body_bytes = silence_s, max_body_bytes
        self._connections: dict[Connection, None] = {}
        self._server: asyncio.Server

    @property
    def port(self) -> int:
        """Where it listens."""
        return self._server.sockets[0].getsockname()[1]

    @property
    def connections(self) -> tuple[Connection, ...]:
        """Clients that are there, the first come first."""
        return tuple(self._connections)

    async def listen(self, host: str, port: int) -> None:
        """Begin. Raises LinkError where the port cannot be had."""
        loop = asyncio.get_running_loop()
        try:
            self._server = await loop.create_server(
                lambda: Connection(self, self._silence_s, self._max_body_bytes), host, port
            )
        except OSError as error:
            raise LinkError(f"cannot listen at {host}:{port}: {error.strerror}; choose another port") from error

    async def close(self) -> None:
        """Say goodbye to all, and listen no more."""
        self._server.close()
        connections = self.connections
        for connection in connections:
            connection.close("the server ends")
        for connection in connections:
            await connection.wait_closed()
        await self._server.wait_closed()

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        await self.close()

    # It stands between its connections and the handler, to know who is there.

    def opened(self, connection: Connection) -> None:
        """Take it, or turn it away."""
        if len(self._connections) == MAX_CLIENTS:
            self.refused += 1
            connection.close("too many clients")
            return
        self._connections[connection] = None
        self._handler.opened(connection)

    def received(self, connection: Connection, event: Event) -> None:
        """Pass it on."""
        if connection in self._connections:
            self._handler.received(connection, event)

    def silent(self, connection: Connection) -> None:
        """Pass it on."""
        if connection in self._connections:
            self._handler.silent(connection)

    def lost(self, connection: Connection, reason: str) -> None:
        """Pass it on."""
        if connection in self._connections:
            del self._connections[connection]
            self._handler.lost(connection, reason)


async def serve(
    handler: Handler,
    host: str = LOOPBACK,
    port: int = PORT,
    *,
    silence_s: float | None = None,
    max_body_bytes: int = MAX_BODY_BYTES,
) -> Server:
    """A server that listens; port 0 takes a free one. After `silence_s` without a message a client is `silent`.

    Whoever reaches the port can send: the protocol knows no password. Raises LinkError where the port cannot be had.
    """
    server = Server(handler, silence_s, max_body_bytes)
    await server.listen(host, port)
    return server
