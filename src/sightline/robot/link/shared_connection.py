"""A connection to a robot that is read all the time, and shared by several threads: each gets all messages since its
request."""

import time
from collections import deque
from collections.abc import Callable, Generator, Mapping
from contextlib import contextmanager
from threading import Condition, Lock, Thread

from sightline.errors import LinkError
from sightline.robot.contract import ALIVE_S, HEARTBEAT, HEARTBEAT_S, IDLE_S, STATUS_S
from sightline.robot.control.timing import LoopClock
from sightline.robot.igtl import Body, Capability, Get, Message, Rejected, String, timestamp_of
from sightline.robot.transport import BlockingClient
from sightline.robot.transport.heartbeat import Heartbeat, Pace

DRAIN_S = 30.0  # time limit for reading a backlog: that of an hour takes 5 s [measured]
Wanted = Callable[[Message], bool]


class LateError(LinkError):
    """An answer did not come in time."""


class Mailbox:
    """The messages since it was opened. `clock`: time that its reader has waited, so that a pause of this program does
    not count as the robot's delay."""

    def __init__(self, connection: "SharedConnection") -> None:
        self._connection = connection
        self.came: deque[Message] = deque()
        self.clock = LoopClock(HEARTBEAT_S)
        self.clock.tick(time.monotonic())

    def until(self, wanted: Wanted, timeout_s: float) -> Message | None:
        """Return the next wanted message, or None if none came in time; earlier messages are dropped.

        A message that came in time but was not read, because this program paused, counts."""
        self.clock.tick(time.monotonic())
        end_s = self.clock.now_s + timeout_s
        while True:
            while self.came:
                message = self.came.popleft()
                if wanted(message):
                    return message
            left = end_s - self.clock.now_s
            self._connection.wait(self, min(max(left, 0.0), HEARTBEAT_S))
            self.clock.tick(time.monotonic())
            if (left <= 0 and not self.came) or left < -DRAIN_S:
                return None

    def holds(self, wanted: Wanted) -> bool:
        """Return whether a wanted message is waiting; nothing is read."""
        return any(wanted(message) for message in tuple(self.came))

    def need(self, wanted: Wanted, timeout_s: float, what: str) -> Message:
        """Return the next wanted message. Raises LateError if none came in time."""
        message = self.until(wanted, timeout_s)
        if message is None:
            raise LateError(f"the robot sent no {what} within {timeout_s:g} s; check its state, and the address")
        return message


class SharedConnection:
    """A connection to `host`:`port`. Raises LinkError if it cannot be opened, and in every call once it is lost.

    A thread reads it, also while a person thinks between calls: a robot whose streams nobody reads gives its client up.
    `latest` holds the newest message of each device name. `listeners` are called with every message, in order, by that
    thread, before a call returns with a later one. `unreadable` holds what could not be decoded.
    """

    def __init__(self, host: str, port: int) -> None:
        self.latest: dict[str, Message] = {}
        self.listeners: list[Callable[[Message], None]] = []
        self.unreadable: list[Rejected] = []
        self._link = BlockingClient(host, port)
        self._asking, self._turn = Lock(), Condition()  # notified whenever the reader has read something, or nothing
        self._mailboxes: list[Mailbox] = []
        self._marks_sent = self._marks_heard = 0
        self._turns = self._emptied = 0  # of the reader; of these, the last that found nothing waiting
        self._shown = 0  # turns that a call has shown as progress
        self._failure: Exception | None = None
        self._heartbeat: Heartbeat | None = None
        Thread(target=self._read_all, name="robot link", daemon=True).start()

    def close(self) -> None:
        """Close the connection, even while other threads use it."""
        self._link.close()
        self.fall_silent()

    @property
    def closed(self) -> bool:
        """Whether it was closed or lost."""
        return self._link.closed

    def keep_alive(self) -> None:
        """Start heartbeats, from a separate process, for as long as calls show progress. Between calls the robot does
        not move for this client, and one heartbeat a second keeps the connection."""
        self._heartbeat = self._link.heartbeat(Message(String(""), HEARTBEAT), Pace(HEARTBEAT_S, ALIVE_S, IDLE_S))

    def fall_silent(self) -> None:
        """Stop the heartbeats, like a program that hangs, to test whether the robot notices."""
        heartbeat, self._heartbeat = self._heartbeat, None
        if heartbeat is not None:
            heartbeat.close()

    def send_bytes(self, *pieces: bytes) -> None:
        """Send raw bytes, to test the robot. A heartbeat may come between two pieces."""
        self._link.send_bytes(*pieces)

    def send(
        self,
        body: Body,
        name: str,
        *,
        version: int = 1,
        metadata: Mapping[str, str] | None = None,
        imaged_s: float | None = None,
    ) -> None:
        """Send a message."""
        timestamp = 0 if imaged_s is None else timestamp_of(imaged_s)
        version = 2 if metadata else version
        self._link.send(Message(body, name, timestamp, version, metadata=metadata or {}))

    @contextmanager
    def mailbox(self) -> Generator[Mailbox]:
        """Open a mailbox. Open it before sending a query, or its answer may come first."""
        mail = Mailbox(self)
        with self._turn:
            self._refuse_lost()
            self._mailboxes.append(mail)
        self._show_progress()
        try:
            yield mail
        finally:
            with self._turn:
                self._mailboxes.remove(mail)
            if not self._mailboxes and self._heartbeat is not None:
                self._heartbeat.idles()

    def wait(self, mail: Mailbox, timeout_s: float) -> None:
        """Wait until a message may have come for `mail`, at most `timeout_s`."""
        with self._turn:
            if not mail.came:
                self._refuse_lost()
                self._turn.wait(timeout_s)
            # A call makes progress while the reader does: it may hang in a listener.
            progress, self._shown = self._turns > self._shown, self._turns
        if progress:
            self._show_progress()

    def ask(self, body: Body, name: str, answers: Wanted, what: str, *, marked: bool) -> Message:
        """Send a query and return its answer, not an earlier message that looks like it. `marked`: the robot answers
        GET_CAPABIL, in order, so the last match before that answer is the answer to the query or newer.

        Raises LateError."""
        with self._asking:
            if not marked:
                self._catch_up()
            with self.mailbox() as mail:
                with self._turn:
                    due = self._marks_sent - self._marks_heard
                    mail.came.clear()
                self.send(body, name)
                if not marked:
                    return mail.need(answers, STATUS_S, what)
                self._marks_sent += 1
                self.send(Get("CAPABILITY"), "")
                return self._before_mark(mail, due + 1, answers, what)

    def fresh(self, name: str) -> Message:
        """Return the next message of a stream that has not come yet. Raises LateError."""
        with self._asking:
            self._catch_up()
            with self.mailbox() as mail:
                return mail.need(lambda m: m.device_name == name, STATUS_S, name)

    def _before_mark(self, mail: Mailbox, due: int, answers: Wanted, what: str) -> Message:
        """Return the last answer before the mark; `due`: marks still to come, including those of earlier queries."""
        newest: Message | None = None

        def ends(message: Message) -> bool:
            nonlocal newest, due
            newest = message if answers(message) else newest
            due -= isinstance(message.body, Capability)
            return due <= 0 and newest is not None

        mail.need(ends, STATUS_S, what)
        assert newest is not None  # noqa: S101
        return newest

    def _show_progress(self) -> None:
        heartbeat = self._heartbeat
        if heartbeat is not None:
            heartbeat.waits()

    def _refuse_lost(self) -> None:
        if self._failure is not None:
            raise self._failure

    def _catch_up(self) -> None:
        """Wait until all that has come was read."""
        with self._turn:
            self._refuse_lost()
            now = self._turns
            if not self._turn.wait_for(lambda: self._emptied > now or self._failure is not None, DRAIN_S):
                raise LinkError(f"the robot sends more than can be read: {DRAIN_S:g} s were not enough")
            self._refuse_lost()

    def _read_all(self) -> None:
        """Read until the connection is lost or a listener fails, which every later call raises."""
        try:
            while True:
                event = self._link.receive(0.0)
                self._end_turn(event)
                if event is None:
                    self._end_turn(self._link.receive(HEARTBEAT_S))
        except Exception as error:
            with self._turn:
                self._failure = error
                self._turn.notify_all()

    def _end_turn(self, event: Message | Rejected | None) -> None:
        """Hand an event to listeners, then to all mailboxes."""
        if isinstance(event, Rejected):
            self.unreadable.append(event)
            if event.fatal:
                raise LinkError(f"the robot sends what is not OpenIGTLink: {event.reason}")
        elif event is not None:
            self.latest[event.device_name] = event
            for listener in tuple(self.listeners):
                listener(event)
        with self._turn:
            self._turns += 1
            if event is None:
                self._emptied = self._turns
            elif isinstance(event, Message):
                self._marks_heard += isinstance(event.body, Capability) and self._marks_heard < self._marks_sent
                for mail in self._mailboxes:
                    mail.came.append(event)
            self._turn.notify_all()
