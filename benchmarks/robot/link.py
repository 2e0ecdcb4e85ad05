"""The link to a robot: round trips on loopback, a burst, an image, and 500 of each fault.

Servers run in separate processes. The peer is pyigtl, its client with its own server. A round trip is one TRANSFORM
there and back.
"""

import asyncio
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import pyigtl
from tests.robot.igtl_faults import FAULTS

from benchmarks.rows import Row
from sightline.robot.igtl import Event, Image, Message, Stream, Transform, encode
from sightline.robot.transport import BlockingClient, Client, Connection

REQUIRED_MS = 0.3
BURST = 1000
OF_EACH_FAULT = 500
PATIENCE_S = 20.0

_ECHO = """
import asyncio
from sightline.robot.transport import serve
class Echo:
    def opened(self, connection): pass
    def silent(self, connection): pass
    def lost(self, connection, reason): pass
    def received(self, connection, event): connection.send(event)
async def main():
    async with await serve(Echo(), port=0) as server:
        print(server.port, flush=True)
        await asyncio.Event().wait()
asyncio.run(main())
"""


def run(quick: bool) -> list[Row]:
    """Return the rows of this benchmark."""
    trips = 300 if quick else 3000
    with _server("-c", _ECHO) as port:
        blocking = _blocking_trips(port, trips)
        looped = asyncio.run(_looped_trips(port, trips))
        arrived, in_order = _burst(port)
    with _server("-m", "tests.robot.pyigtl_peer", "echo") as port:
        peer, peer_arrived = _pyigtl_trips(port, trips // 30)
    image, image_peer = _image_ms(30 if quick else 100)
    group = "robot link, loopback"
    median = float(np.median(blocking))
    return [
        Row(
            group,
            "TRANSFORM there and back, median",
            _spread(blocking),
            f"<= {REQUIRED_MS} ms",
            f"pyigtl {np.median(peer):.1f} ms",
            median <= REQUIRED_MS,
        ),
        Row(group, "the same from an event loop", _spread(looped)),
        Row(
            group,
            f"burst of {BURST} of one device, back and in order",
            f"{arrived}",
            f"{BURST}",
            f"pyigtl {peer_arrived}",
            in_order and arrived == BURST,
        ),
        Row(
            group, "IMAGE of 2 MB, written and read, CRC verified", f"{image:.0f} ms", "", f"pyigtl {image_peer:.0f} ms"
        ),
        *_fault_rows(OF_EACH_FAULT // 10 if quick else OF_EACH_FAULT),
    ]


def _spread(times_ms: list[float]) -> str:
    return f"{np.median(times_ms):.3f} ms (99 %: {np.percentile(times_ms, 99):.3f})"


@contextmanager
def _server(*arguments: str) -> Iterator[int]:
    """Yield the port that a program prints."""
    with subprocess.Popen([sys.executable, *arguments], stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            yield int(process.stdout.readline())
        finally:
            process.kill()


def _message(number: int = 0) -> Message:
    return Message(Transform(np.eye(4)), "TGT_1", timestamp=number)


def _times_ms(turn: Callable[[], object], count: int) -> list[float]:
    taken = []
    for _ in range(count):
        started = time.perf_counter()
        turn()
        taken.append(1e3 * (time.perf_counter() - started))
    return taken


def _blocking_trips(port: int, count: int) -> list[float]:
    with BlockingClient(port=port) as client:

        def trip() -> None:
            client.send(_message())
            assert client.receive(PATIENCE_S) is not None

        return _times_ms(trip, count)


async def _looped_trips(port: int, count: int) -> list[float]:
    class Waiting:
        answer: asyncio.Future[Event]

        def opened(self, connection: Connection) -> None: ...
        def silent(self, connection: Connection) -> None: ...
        def lost(self, connection: Connection, reason: str) -> None: ...
        def received(self, connection: Connection, event: Event) -> None:
            self.answer.set_result(event)

    handler, taken = Waiting(), []
    async with Client(handler, port=port) as client:
        assert client.connection is not None
        for _ in range(count):
            handler.answer = asyncio.get_running_loop().create_future()
            started = time.perf_counter()
            client.connection.send(_message())
            await handler.answer
            taken.append(1e3 * (time.perf_counter() - started))
    return taken


def _burst(port: int) -> tuple[int, bool]:
    with BlockingClient(port=port) as client:
        for number in range(BURST):
            client.send(_message(number + 1))
        times = []
        while len(times) < BURST:
            event = client.receive(PATIENCE_S)
            if not isinstance(event, Message):
                break
            times.append(event.timestamp)
    return len(times), times == list(range(1, BURST + 1))


def _pyigtl_trips(port: int, count: int) -> tuple[list[float], int]:
    """Return the times of round trips, and how many different messages of a burst come back."""
    client: Any = pyigtl.OpenIGTLinkClient(host="127.0.0.1", port=port)
    while not client.is_connected():
        time.sleep(0.01)

    def trip() -> None:
        client.send_message(pyigtl.TransformMessage(np.eye(4), device_name="TGT_1"), wait=True)
        assert client.wait_for_message("TGT_1", timeout=PATIENCE_S) is not None

    taken = _times_ms(trip, count)
    for number in range(BURST):
        client.send_message(
            pyigtl.TransformMessage(np.eye(4), timestamp=number + 1, device_name="TGT_1"), wait=number % 50 == 49
        )
    seen = set()
    while (message := client.wait_for_message("TGT_1", timeout=0.5)) is not None:
        seen.add(round(message.timestamp))
    client.stop()
    return taken, len(seen)


def _image_ms(count: int) -> tuple[float, float]:
    pixels = np.random.default_rng(1).integers(0, 65535, (1, 1024, 1024), dtype=np.uint16)
    message = Message(Image(pixels, np.eye(4)), "PA")

    def ours() -> None:
        (event,) = Stream().feed(encode(message))
        assert isinstance(event, Message)

    def peers() -> None:
        data = pyigtl.ImageMessage(pixels, device_name="PA").pack()
        pyigtl.ImageMessage().unpack(pyigtl.ImageMessage.parse_header(data[:58]), data[58:])

    return float(np.median(_times_ms(ours, count))), float(np.median(_times_ms(peers, count)))


def _fault_rows(count: int) -> list[Row]:
    rows = []
    for name, fault in FAULTS.items():
        harmless = sum(fault(np.random.default_rng(seed)) for seed in range(count))
        rows.append(
            Row("robot link, faults", f"{name}: no harm done", f"{harmless}", f"{count}", "", harmless == count)
        )
    return rows
