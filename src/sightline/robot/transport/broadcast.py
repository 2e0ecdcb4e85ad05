"""What a program shows, to several readers on this machine: ten times a second, the newest message of each name.

A reader that reads slowly loses messages, images above all, and delays no other. What readers send is discarded.
"""

import asyncio
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from contextlib import suppress
from threading import Thread

from sightline.common.closing import Closing
from sightline.errors import UnusableInputError
from sightline.robot.igtl import Event, Message, encode
from sightline.robot.transport.connection import Connection, serve

PERIOD_S = 0.1  # [ours] displays of a procedure need no more; live images are calibrated at about this rate
MAX_QUERY_BYTES = 1 << 16  # [ours] of a message from a reader: a query has a header alone, a CAPABILITY some hundreds
_END_S = 5.0  # time for the snapshot in work, with a margin
_SCHEME = "igtl"


def port_of(address: str) -> int:
    """Return the port of `igtl:PORT`. Raises UnusableInputError."""
    scheme, _, port = address.partition(":")
    if scheme != _SCHEME or not (port.isdecimal() and port.isascii() and int(port) < 1 << 16):
        raise UnusableInputError(
            f"{address!r} cannot be served; give {_SCHEME}:PORT, such as {_SCHEME}:18944, or ros2:/NAMESPACE"
        )
    return int(port)


class Broadcast(Closing):
    """A server of its own thread on 127.0.0.1, until it is closed. `port`: where it listens.

    `snapshot` returns the messages of now, each with a device name of its own; it is called in another thread, while
    there are readers. A message is sent once to each reader: make a new one for whatever is to be sent again. Port 0
    takes a free one. Raises LinkError if the port cannot be opened.
    """

    def __init__(self, snapshot: Callable[[], Sequence[Message]], port: int) -> None:
        self._snapshot = snapshot
        self._sent: dict[Connection, dict[str, Message]] = {}  # by reader and device name
        started: Future[int] = Future()
        self._thread = Thread(target=lambda: asyncio.run(self._run(port, started)), name="broadcast", daemon=True)
        self._thread.start()
        self.port = started.result()

    def close(self) -> None:
        """Disconnect the readers and stop listening."""
        with suppress(RuntimeError):  # the loop has ended
            self._loop.call_soon_threadsafe(self._end.set)
        self._thread.join(_END_S)

    async def _run(self, port: int, started: "Future[int]") -> None:
        self._loop, self._end = asyncio.get_running_loop(), asyncio.Event()
        try:
            server = await serve(self, port=port, max_body_bytes=MAX_QUERY_BYTES)
        except Exception as error:  # raised where it was made
            return started.set_exception(error)
        async with server:
            started.set_result(server.port)
            due = self._loop.time()
            while not self._end.is_set():
                if self._sent:
                    self._publish(await asyncio.to_thread(self._snapshot))
                due = max(due + PERIOD_S, self._loop.time())
                with suppress(TimeoutError):
                    await asyncio.wait_for(self._end.wait(), due - self._loop.time())
        return None

    def _publish(self, messages: Sequence[Message]) -> None:
        encoded: dict[str, bytes] = {}
        for reader, sent in self._sent.items():
            for message in messages:
                name = message.device_name
                if sent.get(name) is not message:
                    encoded[name] = encoded.get(name) or encode(message)
                    sent[name] = message
                    reader.show(name, encoded[name])

    # Callbacks of the connections.

    def opened(self, connection: Connection) -> None:
        """A reader has connected."""
        self._sent[connection] = {}

    def received(self, connection: Connection, event: Event) -> None:
        """Discard what a reader sends."""

    def silent(self, connection: Connection) -> None:
        """Readers may be silent."""

    def lost(self, connection: Connection, reason: str) -> None:
        """Forget a reader."""
        del self._sent[connection]
