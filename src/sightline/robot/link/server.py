"""The robot as a server: the control loop in one thread, the link in another, and collision checks in a third. Both the
loop and the link act on a stop."""

import asyncio
import gc
import os
import sys
import threading
import time
import traceback
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from itertools import groupby
from operator import attrgetter
from typing import Self

from sightline.common.closing import Closing
from sightline.errors import LinkError, MessageError
from sightline.robot import contract
from sightline.robot.contract import Code
from sightline.robot.control.controller import Controller
from sightline.robot.control.drilling import DRILL_MM_S
from sightline.robot.control.timing import LoopClock
from sightline.robot.igtl import Event, timestamp_of
from sightline.robot.link.dialogue import Dialogue
from sightline.robot.link.inbox import Change, Inbox, InboxItem, stop_of
from sightline.robot.link.outgoing import SIGHTLINE, Dialect, Outgoing
from sightline.robot.plant import CYCLE_S, Plant
from sightline.robot.transport import LOOPBACK, PORT, Connection, serve
from sightline.robot.transport.connection import TELEMETRY_MESSAGES

LATE_S = CYCLE_S / 5  # a cycle that begins later than this counts as missed
SWITCH_S = CYCLE_S / 10  # Python's thread switch interval
PRIORITY = 10  # [ours] real-time priority of the loop's thread, if the system allows it: above all programs without one
STALLED_S = 3 * CYCLE_S  # after this time without a cycle the link itself stops the drives
READ_S = CYCLE_S  # longest time between rounds in which the link reads its sockets
REQUESTS_PER_CYCLE = 32  # the others wait, so that a flood of requests makes no cycle late [ours]
WAITING_BATCHES = TELEMETRY_MESSAGES  # that the link has not sent; newer telemetry is dropped
# Period of telemetry in virtual time: a tenth of a millimetre drilled; a shorter one takes half of all time.
VIRTUAL_TELEMETRY_S = 0.1 / DRILL_MM_S
START_S = 5.0
MAX_BODY_BYTES = 1 << 20  # a hundred times the largest message of the contract
_AFTER_REQUEST = 20  # cycles that virtual time runs on after a request


@dataclass(frozen=True)
class Simulation:
    """How a simulated plant is run. `advance(dt_s)` advances its time, which stands still while this program does not.

    With `virtual`, time runs as fast as possible while something moves and stands still otherwise: for trials.
    Heartbeats are then not watched. `truth`: text for simulated imaging devices (robot/link/record.py).
    """

    advance: Callable[[float], None]
    virtual: bool = False
    truth: Callable[[], str] | None = None


class RobotServer(Closing):
    """`with RobotServer(controller, plant):` listens at `port` until the block ends.

    A real plant has no `simulation`. `dialect`: see robot/link/outgoing.py. Raises LinkError if the port cannot be
    opened.
    """

    def __init__(
        self,
        controller: Controller,
        plant: Plant,
        simulation: Simulation | None = None,
        *,
        host: str = LOOPBACK,
        port: int = PORT,
        dialect: Dialect = SIGHTLINE,
    ) -> None:
        self.port = port
        self._advance = simulation.advance if simulation else None
        self._virtual = virtual = simulation is not None and simulation.virtual
        truth, telemetry_s = simulation and simulation.truth, VIRTUAL_TELEMETRY_S if virtual else contract.TELEMETRY_S
        self.dialogue = Dialogue(controller, simulation is not None, truth, telemetry_s, dialect)
        self._controller, self._plant = controller, plant
        self._host = host
        self._inbox = Inbox()
        self._connections: dict[int, Connection] = {}
        self._numbers: dict[Connection, int] = {}
        self._next = 1
        # Batches of messages: the first is counted by the loop's thread, the second by the link's.
        self._handed = self._delivered = 0
        self._cycled_s = time.monotonic()
        self._rounds = 0  # how often the link's thread has read all its sockets
        self._end = threading.Event()
        self._listening: threading.Event = threading.Event()
        self._failed: LinkError | None = None
        self._event_loop: asyncio.AbstractEventLoop
        self._closing: asyncio.Event
        self._link = threading.Thread(target=self._run_link, name="link", daemon=True)
        self._control = threading.Thread(target=self._run_control, name="control", daemon=True)
        # Real-time priority avoids priority inversion: this thread holds the interpreter lock that the loop waits for.
        prefer = None if virtual else lambda: prefer_this_thread(PRIORITY - 2)
        self._checker = ThreadPoolExecutor(1, "collision check", prefer)
        controller.check_executor = self._checker.submit
        controller.machine.lease.watches = not virtual

    def __enter__(self) -> Self:
        self._link.start()
        if not self._listening.wait(START_S) or self._failed is not None:
            raise self._failed or LinkError("the link did not start")
        self._control.start()
        return self

    def close(self) -> None:
        """Stop the robot, close all connections, and end the threads."""
        self._end.set()
        if self._control.is_alive():
            self._control.join()
        self._plant.hold()
        if self._link.is_alive():
            self._close_link()
            self._link.join()
        self._checker.shutdown(wait=False, cancel_futures=True)

    def wait(self) -> None:
        """Wait until the link ends, or for a KeyboardInterrupt."""
        if not self._virtual:
            prefer_this_thread(PRIORITY - 1)  # against priority inversion: it holds the interpreter lock when it wakes
        while self._link.is_alive():
            self._link.join(1.0)

    # The link's thread.

    def _run_link(self) -> None:
        if not self._virtual:
            prefer_this_thread(PRIORITY - 1)  # against priority inversion: decoding holds the interpreter lock
        try:
            asyncio.run(self._listen())
        except LinkError as error:
            self._failed = error
        finally:
            self._end.set()
            self._listening.set()

    async def _listen(self) -> None:
        self._event_loop, self._closing = asyncio.get_running_loop(), asyncio.Event()
        async with await serve(
            self, self._host, self.port, max_body_bytes=MAX_BODY_BYTES, mute_s=contract.MUTE_S, kept_for=_stops
        ) as server:
            self.port = server.port
            self._count_round()
            self._listening.set()
            await self._closing.wait()

    def _count_round(self) -> None:
        """Count a round. The event loop calls this after reading all sockets: all that had arrived by the round before
        is then in the inbox."""
        self._rounds += 1
        self._event_loop.call_later(READ_S, self._count_round)

    def opened(self, connection: Connection) -> None:
        """See transport.Handler."""
        self._connections[self._next], self._numbers[connection] = connection, self._next
        self._inbox.put(self._next, Change.JOINED)
        self._next += 1

    def received(self, connection: Connection, event: Event) -> None:
        """See transport.Handler. A stop overtakes all that waits; if the loop is stalled, it stops the plant
        directly."""
        client = self._numbers[connection]
        stops = _stops(event)
        if self._inbox.waiting(client) >= contract.MAX_KEPT and not stops:
            connection.close("too many requests at once")
            return
        self._inbox.put(client, event)
        if stops and time.monotonic() - self._cycled_s > STALLED_S and not self._virtual:
            self._plant.hold()

    def silent(self, connection: Connection) -> None:
        """See transport.Handler. Ignored: the loop judges silence, by the command lease."""

    def lost(self, connection: Connection, reason: str) -> None:
        """See transport.Handler."""
        client = self._numbers.pop(connection)
        del self._connections[client]
        self._inbox.put(client, Change.LEFT)

    def _deliver(self, batch: list[Outgoing]) -> None:
        self._delivered += 1
        now = timestamp_of(time.time())
        for client, messages in groupby(batch, attrgetter("client")):
            connection = self._connections.get(client)
            if connection is None:
                continue
            with connection.joined():
                for outgoing in messages:
                    put = connection.stream if outgoing.telemetry else connection.send
                    try:
                        put(replace(outgoing.message, timestamp=now))
                    except MessageError:
                        traceback.print_exc(file=sys.stderr)

    # The control loop's thread.

    def _run_control(self) -> None:
        try:
            if self._virtual:
                self._turn_virtually()
            else:
                prefer_this_thread(PRIORITY)
                self._turn_on_time()
        finally:
            self._plant.hold()
            self._end.set()
            self._close_link()  # without the loop nobody answers

    def _close_link(self) -> None:
        with suppress(RuntimeError):  # it has ended already
            self._event_loop.call_soon_threadsafe(self._closing.set)

    def _turn_on_time(self) -> None:
        cycles, own = self.dialogue.cycles, LoopClock()
        read_s, asked_s, asked = 0.0, 0.0, self._rounds
        due = time.monotonic()
        while not self._end.is_set():
            due += CYCLE_S
            time.sleep(max(due - time.monotonic(), 0.0))
            late = time.monotonic() - due
            cycles.count += 1
            cycles.missed += late > LATE_S
            cycles.worst_s = max(cycles.worst_s, late)
            if self._rounds >= asked + 2:  # the second round has begun after the time noted
                read_s, asked_s, asked = asked_s, own.now_s, self._rounds
            messages = self._guarded(self._handle_requests, own.now_s if self._advance else due)
            # Skipped cycles are not made up for: requests may take long while the robot stands still.
            skipped = int((time.monotonic() - due) / CYCLE_S)
            cycles.count += skipped
            cycles.missed += skipped
            due += CYCLE_S * skipped
            passed = own.tick(due)
            self._turn(own.now_s if self._advance else due, passed, messages, own.now_s - read_s)
            self._cycled_s = time.monotonic()

    def _turn_virtually(self) -> None:
        now, idle = 0.0, 0
        while not self._end.is_set():
            if self._controller.checking_for is not None:
                time.sleep(CYCLE_S)  # the collision check on another thread takes real time
            idle = 0 if self._controller.busy or len(self._inbox) else idle + 1
            if idle > _AFTER_REQUEST:
                time.sleep(0.0005)  # time stands still
                continue
            now += CYCLE_S
            self._turn(now, CYCLE_S, self._guarded(self._handle_requests, now))

    def _turn(self, now_s: float, elapsed_s: float, messages: list[Outgoing], unread_s: float = 0.0) -> None:
        """Advance the plant's time, run one cycle of the controller, and hand the messages to the link."""
        if self._advance is not None:
            self._advance(elapsed_s)
        messages = messages + self._guarded(partial(self.dialogue.cycle, unread_s=unread_s), now_s)
        waiting = self._handed - self._delivered
        if messages and (waiting < WAITING_BATCHES or not all(outgoing.telemetry for outgoing in messages)):
            self._handed += 1
            with suppress(RuntimeError):  # the link has ended; the loop will end too
                self._event_loop.call_soon_threadsafe(self._deliver, messages)

    def _guarded(self, what: Callable[[float], list[Outgoing]], now_s: float) -> list[Outgoing]:
        try:
            return what(now_s)
        except Exception as error:
            traceback.print_exc(file=sys.stderr)
            self._controller.machine.fail(Code.HARDWARE, f"a bug in the controller: {type(error).__name__}", now_s)
            return []

    def _handle_requests(self, now_s: float) -> list[Outgoing]:
        """Handle the clients' messages, stops first, and return the answers."""
        if self._inbox.stop_waits:
            self._plant.hold()
        messages: list[Outgoing] = []
        for item in self._inbox.batch(REQUESTS_PER_CYCLE, lambda: self._controller.checking_for):
            messages += self._handle(item, now_s)
        return messages

    def _handle(self, item: InboxItem, now_s: float) -> list[Outgoing]:
        if item.what is Change.JOINED:
            self.dialogue.joined(item.client)
        elif item.what is Change.LEFT:
            self.dialogue.left(item.client, now_s)
        elif not isinstance(item.what, Change):
            return self.dialogue.receive(item.client, item.what, now_s, item.overtaken)
        return []


def _stops(event: Event) -> bool:
    return stop_of(event) is not None


def tune_process() -> None:
    """Tune a process that runs a control loop: short thread switch interval, no long garbage collections."""
    sys.setswitchinterval(SWITCH_S)
    gc.collect()
    gc.freeze()  # exclude the objects that exist now from later collections
    gc.set_threshold(10_000, 50, 1000)


def prefer_this_thread(priority: int) -> None:
    """Give the calling thread real-time priority, if the system allows it."""
    if hasattr(os, "sched_setscheduler"):
        with suppress(OSError):
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
