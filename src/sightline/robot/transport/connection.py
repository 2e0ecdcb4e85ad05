"""Connections of an event loop, with bounded queues, and the server of several clients on one port."""

import asyncio
import socket
from collections.abc import Callable, Generator
from contextlib import AbstractAsyncContextManager, contextmanager
from types import TracebackType
from typing import Concatenate, ParamSpec, Protocol, cast

from sightline.errors import LinkError
from sightline.robot.igtl import MAX_BODY_BYTES, Event, Message, Rejected, Stream, encode

# What waits for a peer [ours]: telemetry of a third of a second at 200 Hz, since older is useless; and thousands of
# answers: a peer that has not read these reads none.
TELEMETRY_MESSAGES, ANSWER_BYTES = 64, 1 << 20
# How long a peer may take [ours]: to accept a connection, which a robot in the same room does in milliseconds; to
# complete a message, 16 MiB at 30 Mbit/s, after which its size must be wrong. One that vanished is detected within 4 s.
CONNECT_S, MESSAGE_S = 2.0, 5.0
_IDLE_S, _INTERVAL_S, _PROBES = 1, 1, 3
P = ParamSpec("P")

_PIECE = 1 << 15  # bytes: some hundred messages, which take ten milliseconds [ours]
GOODBYE_S = float(_INTERVAL_S)  # time limit to send what waits when closing, as between two probes


class Outbox:
    """Waiting messages. If too much telemetry waits, the oldest is dropped; answers are never dropped."""

    def __init__(self):
        self.dropped = 0  # number of dropped telemetry messages
        self._newest: dict[str, bytes] = {}  # by name, taken after all others
        self._waiting: dict[int, bytes] = {}  # by number, in common order of answers and telemetry
        self._telemetry: dict[int, None] = {}  # the numbers of telemetry, oldest first
        self._answer_bytes = 0
        self._next = 0

    def __len__(self) -> int:
        return len(self._waiting) + len(self._newest)

    def put_answer(self, data: bytes) -> None:
        """Add an answer. Raises LinkError if so many answers wait that the peer cannot be reading."""
        if self._answer_bytes + len(data) > ANSWER_BYTES and self._answer_bytes:
            raise LinkError(f"the peer does not read: {self._answer_bytes} bytes of answers wait for it")
        self._answer_bytes += len(data)
        self._put(data)

    def put_telemetry(self, data: bytes) -> None:
        """Add telemetry; the oldest is dropped if too much waits."""
        if len(self._telemetry) == TELEMETRY_MESSAGES:
            oldest = next(iter(self._telemetry))
            del self._telemetry[oldest], self._waiting[oldest]
            self.dropped += 1
        self._telemetry[self._next] = None
        self._put(data)

    def put_newest(self, name: str, data: bytes) -> None:
        """Add telemetry in place of what waits under its name, which is dropped."""
        self.dropped += name in self._newest
        self._newest[name] = data

    def take(self) -> bytes:
        """Remove and return the next message. Raises KeyError if nothing waits."""
        number = next(iter(self._waiting), None)
        if number is None:
            if not self._newest:
                raise KeyError("nothing waits")
            return self._newest.pop(next(iter(self._newest)))
        data = self._waiting.pop(number)
        if number in self._telemetry:
            del self._telemetry[number]
        else:
            self._answer_bytes -= len(data)
        return data

    def _put(self, data: bytes) -> None:
        self._waiting[self._next] = data
        self._next += 1


def prepare(sock: socket.socket) -> None:
    """Set a socket to send without delay, to probe an idle peer, and to give up one that acknowledges nothing.

    This detects a lost peer within seconds; faster detection needs a heartbeat.
    """
    sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    for name, value in (
        ("TCP_KEEPIDLE", _IDLE_S),
        ("TCP_KEEPALIVE", _IDLE_S),  # its name on macOS
        ("TCP_KEEPINTVL", _INTERVAL_S),
        ("TCP_KEEPCNT", _PROBES),
        ("TCP_USER_TIMEOUT", 1000 * (_IDLE_S + _INTERVAL_S * _PROBES)),  # Linux
    ):
        option = getattr(socket, name, None)
        if option is not None:
            sock.setsockopt(socket.IPPROTO_TCP, option, value)


class Handler(Protocol):
    """Callbacks of a connection, called in the event loop's thread; they must return at once.

    An exception in one of them ends that connection, and `lost` is called; other connections continue.
    """

    def opened(self, connection: "Connection") -> None:
        """A peer has connected."""

    def received(self, connection: "Connection", event: Event) -> None:
        """A message, or a rejected one, has arrived. After a fatal rejection the connection closes by itself."""

    def silent(self, connection: "Connection") -> None:
        """No message came for `silence_s`; called once until the next one comes."""

    def lost(self, connection: "Connection", reason: str) -> None:
        """The connection has ended; called once."""


class Connection(asyncio.Protocol):
    """A connection of the event loop. Only the loop's thread may use it; others use `loop.call_soon_threadsafe`.

    `peer`: address and port. `heard_at`: event loop time of the last message. Messages sent after the end are
    discarded; `Handler.lost` reports the end.
    """

    def __init__(self, handler: Handler, silence_s: float | None = None, max_body_bytes: int = MAX_BODY_BYTES):
        self.peer = "nobody yet"
        self.heard_at = 0.0
        self._handler = handler
        self._silence_s = silence_s
        self._stream = Stream(max_body_bytes)
        self._outbox = Outbox()
        self._loop = asyncio.get_running_loop()
        self._ended: asyncio.Future[None] = self._loop.create_future()
        self._transport: asyncio.Transport | None = None
        self._paused = False
        self._joined: list[bytes] | None = None
        self._reason = ""
        self._silence: asyncio.TimerHandle | None = None
        self._completion: asyncio.TimerHandle | None = None
        self._goodbye: asyncio.TimerHandle | None = None

    @property
    def is_open(self) -> bool:
        """Whether messages can still be sent."""
        return self._transport is not None and not self._transport.is_closing()

    @property
    def dropped(self) -> int:
        """Number of telemetry messages dropped because the peer read too slowly."""
        return self._outbox.dropped

    def send(self, message: Message) -> None:
        """Send an answer: it arrives in order, or the connection ends. Raises MessageError as `encode` does."""
        data = encode(message)
        if self._written_at_once(data):
            return
        try:
            self._outbox.put_answer(data)
        except LinkError as error:
            self._abort(str(error))

    def stream(self, message: Message) -> None:
        """Send telemetry in order; if the peer reads too slowly, the oldest is dropped and counted."""
        data = encode(message)
        if not self._written_at_once(data):
            self._outbox.put_telemetry(data)

    def show(self, name: str, data: bytes) -> None:
        """Send an encoded message; while the peer reads too slowly, only the newest of its `name` waits."""
        if not self._written_at_once(data):
            self._outbox.put_newest(name, data)

    @contextmanager
    def joined(self) -> Generator[None]:
        """Write what is sent and streamed in this block at its end, in one system call instead of one a message."""
        self._joined = pieces = []
        try:
            yield
        finally:
            self._joined = None
            if pieces and self._transport is not None and self.is_open:
                self._transport.write(b"".join(pieces))

    def close(self, reason: str) -> None:
        """Close the connection after sending what waits; that may take a second."""
        if self._transport is None or not self.is_open:
            return
        self._reason = reason
        while self._outbox:
            self._transport.write(self._outbox.take())
        self._transport.close()
        self._goodbye = self._loop.call_later(GOODBYE_S, self._transport.abort)

    async def wait_closed(self) -> None:
        """Wait until the connection has ended."""
        await asyncio.shield(self._ended)

    def _abort(self, reason: str) -> None:
        """Close the connection now; discard what waits."""
        if self._transport is not None:
            self._reason = self._reason or reason
            self._transport.abort()

    def _written_at_once(self, data: bytes) -> bool:
        if self._transport is None or self._transport.is_closing():
            return True  # no peer: discard it
        if self._paused:
            return False
        if self._joined is None:
            self._transport.write(data)
        else:
            self._joined.append(data)
        return True

    # Callbacks of asyncio.

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """A peer has connected."""
        self._transport = cast(asyncio.Transport, transport)
        self.peer = "{}:{}".format(*transport.get_extra_info("peername")[:2])
        prepare(transport.get_extra_info("socket"))
        self._heard()
        self._tell(self._handler.opened)

    def data_received(self, data: bytes) -> None:
        """Bytes have arrived. They are decoded in pieces, so that a disconnected peer's data are not all decoded
        first."""
        heard = False
        for start in range(0, len(data), _PIECE):
            if not self.is_open:
                return
            for event in self._stream.feed(data[start : start + _PIECE]):
                heard = True
                if isinstance(event, Message):
                    self._heard()
                if not self.is_open:
                    return
                self._tell(self._handler.received, event)
                if isinstance(event, Rejected) and event.fatal:
                    self.close(f"{event.fault.value}: {event.reason}")
                    return
        self._expect_completion(begun_anew=heard)

    def pause_writing(self) -> None:
        """The peer reads too slowly."""
        self._paused = True

    def resume_writing(self) -> None:
        """The peer reads again."""
        self._paused = False
        while self._outbox and not self._paused and self.is_open:
            self._written_at_once(self._outbox.take())

    def connection_lost(self, exc: Exception | None) -> None:
        """The connection has ended."""
        for timer in (self._silence, self._completion, self._goodbye):
            if timer is not None:
                timer.cancel()
        if not self._ended.done():
            self._ended.set_result(None)
        self._handler.lost(self, self._reason or (f"{exc}" if exc else "closed by the peer"))

    def _heard(self) -> None:
        self.heard_at = self._loop.time()
        if self._silence is None and self._silence_s is not None:
            self._silence = self._loop.call_later(self._silence_s, self._listen, self._silence_s)

    def _listen(self, silence_s: float) -> None:
        # One timer, rescheduled when it fires, is cheaper than a new one for each message.
        due = self.heard_at + silence_s
        if self._loop.time() < due:
            self._silence = self._loop.call_at(due, self._listen, silence_s)
        else:
            self._silence = None
            self._tell(self._handler.silent)

    def _tell(self, what: Callable[Concatenate["Connection", P], None], *args: P.args, **kwargs: P.kwargs) -> None:
        try:
            what(self, *args, **kwargs)
        except Exception:
            self._abort("what was to handle it failed")
            raise

    def _expect_completion(self, begun_anew: bool) -> None:
        if self._completion is not None and (begun_anew or not self._stream.partial):
            self._completion.cancel()
            self._completion = None
        if self._completion is None and self._stream.partial:
            self._completion = self._loop.call_later(
                MESSAGE_S, self._abort, f"a message was not complete after {MESSAGE_S:.0f} s"
            )


LOOPBACK = "127.0.0.1"
PORT = 18936  # of the needle robots' convention
MAX_CLIENTS = 8  # [ours] navigation, its stop connection, displays; more is a fault or an attack

Urgent = Callable[[Event], bool]  # whether an event must be handled however many clients there are


class Server(AbstractAsyncContextManager["Server"]):
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
