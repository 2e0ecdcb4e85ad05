"""A robot that knows the old convention alone: what a needle robot of another laboratory answers, and no more."""

import asyncio
import threading
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np

from sightline.robot.igtl import Message, Rejected, Status, String, Transform
from sightline.robot.transport import Connection, serve

PHASES = (
    "START_UP", "PLANNING", "CALIBRATION", "TARGETING", "MOVE_TO_TARGET", "MANUAL", "STOP", "EMERGENCY",
)  # fmt: skip
STEPS = 20  # of its motion, 10 ms each


class OldRobot:
    """Headers of version 1, one client, no CAPABILITY. As of 2013, it sends no STATUS on entering PLANNING or
    CALIBRATION, and unless `answers_all` none for a command that it does not know."""

    def __init__(self, answers_all: bool) -> None:
        self.answers_all = answers_all
        self.phase, self.registered = "UNDEFINED", False
        self.target: np.ndarray | None = None
        self.tip = np.eye(4)
        self.tip[:3, 3] = (0.0, 0.0, -150.0)
        self.moving: asyncio.Task | None = None

    def opened(self, connection: Connection) -> None: ...

    def silent(self, connection: Connection) -> None: ...

    def lost(self, connection: Connection, reason: str) -> None:
        self._halt()

    def received(self, connection: Connection, event: Message | Rejected) -> None:
        if isinstance(event, Rejected):
            return
        kind, _, number = event.device_name.partition("_")
        match kind, event.body:
            case "CMD", String(text):
                self._command(connection, number, text)
            case "CLB", Transform() as transform:
                connection.send(Message(transform, f"ACK_{number}"))
                self.registered = transform.fault is None
                connection.send(Message(Status(1 if self.registered else 10), "CALIBRATION"))
            case "TGT", Transform() as transform:
                self._target(connection, number, transform)
            case _, String(text) if "CURRENT_POSITION" in (text, event.device_name):
                connection.send(Message(Transform(self.tip), "CURRENT_POSITION"))
            case _, String(text) if "CURRENT_STATUS" in (text, event.device_name):
                connection.send(Message(Status(1), self.phase))

    def _command(self, connection: Connection, number: str, text: str) -> None:
        if text not in PHASES and not self.answers_all:
            return
        connection.send(Message(String(text), f"ACK_{number}"))
        code = self._refusal(text)
        if code == 1:
            self._halt()
            self.phase = text
        connection.send(Message(Status(1, self.phase), "CURRENT_STATUS"))
        if code == 1 and text == "MOVE_TO_TARGET":
            self.moving = asyncio.get_running_loop().create_task(self._move(connection))
        elif code != 1 or text not in ("PLANNING", "CALIBRATION"):
            connection.send(Message(Status(code), text[:20] or "UNKNOWN"))

    def _refusal(self, text: str) -> int:
        if text not in PHASES:
            return 12
        if text == "TARGETING" and not self.registered:
            return 13
        if text == "MOVE_TO_TARGET":
            return 14 if self.phase == "MANUAL" else 13 if self.target is None else 1
        return 1

    def _target(self, connection: Connection, number: str, transform: Transform) -> None:
        connection.send(Message(transform, f"ACK_{number}"))
        good = transform.fault is None and np.abs(transform.matrix[:3, 3]).max() < 200.0 and self.phase == "TARGETING"
        self.target = transform.matrix if good else None
        connection.send(Message(Status(1 if good else 10), "TARGET"))
        if good:
            connection.send(Message(transform, "TARGET"))
            connection.send(Message(transform, "REACHABLE_TARGET"))

    async def _move(self, connection: Connection) -> None:
        assert self.target is not None
        start = self.tip
        for step in range(1, STEPS + 1):
            await asyncio.sleep(0.01)
            self.tip = self.target.copy()
            self.tip[:3, 3] = start[:3, 3] + step / STEPS * (self.target[:3, 3] - start[:3, 3])
            connection.send(Message(Transform(self.tip), "CURRENT_POSITION"))
        connection.send(Message(Status(1), "MOVE_TO_TARGET"))
        connection.send(Message(Transform(self.tip), "CURRENT_POSITION"))

    def _halt(self) -> None:
        if self.moving is not None:
            self.moving.cancel()


@contextmanager
def old_robot(answers_all: bool = True) -> Iterator[int]:
    """Its port."""
    ports, ready = [], threading.Event()
    loop, end = asyncio.new_event_loop(), asyncio.Event()

    async def main() -> None:
        async with await serve(OldRobot(answers_all), port=0) as server:
            ports.append(server.port)
            ready.set()
            await end.wait()

    thread = threading.Thread(target=lambda: loop.run_until_complete(main()))
    thread.start()
    assert ready.wait(5.0)
    try:
        yield ports[0]
    finally:
        loop.call_soon_threadsafe(end.set)
        thread.join()
        loop.close()
