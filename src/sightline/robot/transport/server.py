"""The server: several clients on one port."""

import asyncio
from collections.abc import Callable
from types import TracebackType
from typing import Self

from sightline.errors import LinkError
from sightline.robot.igtl import MAX_BODY_BYTES, Event
from sightline.robot.transport.connection import Connection, Handler

LOOPBACK = "127.0.0.1"
PORT = 18936  # of the needle robots' convention
MAX_CLIENTS = 8  # [ours] navigation, its stop connection, displays; more is a fault or an attack

Urgent = Callable[[Event], bool]  # whether an event must be handled however many clients there are


class Server:
    """A server on one port, made by `serve`; `async with` closes it."""

    def __init__(
        self,
        handler: Handler,
        silence_s: float | None,
        max_body_bytes: int,
        mute_s: float | None,
        kept_for: Urgent | None,
    ):
        self.refused = 0  # clients turned away because there were too many
        self._handler = handler
        self._silence_s, self._max_body_bytes = silence_s, max_body_bytes
        self._mute_s, self._kept_for = mute_s, kept_for
        self._connections: dict[Connection, None] = {}  # connections that the handler knows
        self._kept: Connection | None = None  # the connection in the reserved place
        self._mute: dict[Connection, asyncio.TimerHandle] = {}
        self._server: asyncio.Server

    @property
    def port(self) -> int:
        """The port that it listens on."""
        return self._server.sockets[0].getsockname()[1]

    @property
    def connections(self) -> tuple[Connection, ...]:
        """The connected clients, oldest first."""
        return tuple(self._connections)

    async def listen(self, host: str, port: int) -> None:
        """Start listening. Raises LinkError if the port cannot be opened."""
        loop = asyncio.get_running_loop()
        try:
            self._server = await loop.create_server(
                lambda: Connection(self, self._silence_s, self._max_body_bytes), host, port
            )
        except OSError as error:
            raise LinkError(f"cannot listen at {host}:{port}: {error.strerror}; choose another port") from error

    async def close(self) -> None:
        """Close all connections and stop listening."""
        self._server.close()
        connections = list(self._connections)
        if self._kept is not None and self._kept not in self._connections:
            connections.append(self._kept)
        for connection in connections:
            connection.close("the server ends")
        for connection in connections:
            await connection.wait_closed()
        await self._server.wait_closed()

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(
        self, error_type: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        await self.close()

    # The server is the handler of its connections, so that it can count them, and forwards to its own handler.

    def opened(self, connection: Connection) -> None:
        """Accept a connection, give it the place reserved for urgent messages, or refuse it."""
        if len(self._connections.keys() - {self._kept}) < MAX_CLIENTS:
            self._welcome(connection)
        elif self._kept_for is None:
            self._turn_away(connection)
            return
        else:
            if self._kept is not None:
                self._kept.close("another client needs the last place")
            self._kept = connection
        if self._mute_s is not None:
            text = f"it said nothing for {self._mute_s:g} s"
            self._mute[connection] = asyncio.get_running_loop().call_later(self._mute_s, connection.close, text)

    def received(self, connection: Connection, event: Event) -> None:
        """Forward an event. In the reserved place, a first message that is not urgent ends the connection."""
        self._speaks(connection)
        if connection is self._kept and self._kept_for is not None:
            urgent, known = self._kept_for(event), connection in self._connections
            if not urgent:
                if not known:
                    self._turn_away(connection)
                return
            if not known:
                self._welcome(connection)
        if connection in self._connections:
            self._handler.received(connection, event)

    def silent(self, connection: Connection) -> None:
        """Forward the silence of a client."""
        if connection in self._connections:
            self._handler.silent(connection)

    def lost(self, connection: Connection, reason: str) -> None:
        """Forward the loss of a client."""
        self._speaks(connection)
        if connection is self._kept:
            self._kept = None
        if connection in self._connections:
            del self._connections[connection]
            self._handler.lost(connection, reason)

    def _welcome(self, connection: Connection) -> None:
        self._connections[connection] = None
        self._handler.opened(connection)

    def _turn_away(self, connection: Connection) -> None:
        self.refused += 1
        connection.close("too many clients")

    def _speaks(self, connection: Connection) -> None:
        timer = self._mute.pop(connection, None)
        if timer is not None:
            timer.cancel()


async def serve(
    handler: Handler,
    host: str = LOOPBACK,
    port: int = PORT,
    *,
    silence_s: float | None = None,
    max_body_bytes: int = MAX_BODY_BYTES,
    mute_s: float | None = None,
    kept_for: Urgent | None = None,
) -> Server:
    """Return a listening server; port 0 chooses a free one.

    After `silence_s` without a message, `silent` is called for a client; a client that has sent nothing at all is
    disconnected after `mute_s`. Beyond the last place one is reserved for a client that sends only messages that
    `kept_for` calls urgent; the next client takes that place over. Anyone who reaches the port can send: the protocol
    has no password. Raises LinkError if the port cannot be opened.
    """
    server = Server(handler, silence_s, max_body_bytes, mute_s, kept_for)
    await server.listen(host, port)
    return server
