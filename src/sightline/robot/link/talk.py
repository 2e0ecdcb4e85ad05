"""One connection to a robot for several threads: each hears what came since it asked, whichever thread reads it."""

import time
from collections import deque
from collections.abc import Callable, Generator, Mapping
from contextlib import contextmanager
from threading import Lock

from sightline.errors import LinkError
from sightline.robot.contract import ALIVE_S, HEARTBEAT, HEARTBEAT_S, IDLE_S, STATUS_S
from sightline.robot.control.own_time import OwnTime
from sightline.robot.igtl import Capability, Get, Message, Rejected, String, timestamp_of
from sightline.robot.igtl.kinds import Body
from sightline.robot.transport import BlockingClient
from sightline.robot.transport.heartbeat import Heartbeat, Pace

DRAIN_S = 30.0  # a client that was idle for an hour reads what has queued up in 5 s [measured]
Wanted = Callable[[Message], bool]


class LateError(LinkError):
    """An answer did not come in time."""


class Mail:
    """What has come since it was opened. `own`: time that its reader has waited; a pause of this program is not the
    robot's lateness."""

    def __init__(self, talk: "Talk") -> None:
        self._talk = talk
        self.came: deque[Message] = deque()
        self.own = OwnTime(HEARTBEAT_S)
        self.own.turn(time.monotonic())

    def until(self, wanted: Wanted, timeout_s: float) -> Message | None:
        """The next message that is wanted; None where none came in time. Those before it are dropped.

        What came in time and was not read, because this program paused, counts."""
        self.own.turn(time.monotonic())
        end_s = self.own.now_s + timeout_s
        while True:
            while self.came:
                message = self.came.popleft()
                if wanted(message):
                    return message
            left = end_s - self.own.now_s
            self._talk.hear(self, min(max(left, 0.0), HEARTBEAT_S))
            self.own.turn(time.monotonic())
            if (left <= 0 and not self.came) or left < -DRAIN_S:
                return None

    def holds(self, wanted: Wanted) -> bool:
        """Whether such a message has come and was not taken; nothing is read."""
        return any(wanted(message) for message in tuple(self.came))

    def need(self, wanted: Wanted, timeout_s: float, what: str) -> Message:
        """The same; raises LateError where it did not come in time."""
        message = self.until(wanted, timeout_s)
        if message is None:
            raise LateError(
                f"the robot sent no {what} within {timeout_s:g} s; check its state, and that it is a robot at all"
            )
        return message


class Talk:
    """A connection to `host`:`port`. Raises LinkError where it cannot be made, and in every call once it is lost.

    `latest` holds the newest message of each device name, `listeners` are told of every message, in order, by the
    thread that reads it; `unreadable` what came and was no message.
    """

    def __init__(self, host: str, port: int) -> None:
        self.latest: dict[str, Message] = {}
        self.listeners: list[Callable[[Message], None]] = []
        self.unreadable: list[Rejected] = []
        self._link = BlockingClient(host, port)
        self._reading, self._asking = Lock(), Lock()
        self._mails: list[Mail] = []
        self._marks_sent = self._marks_heard = 0
        self._heartbeat: Heartbeat | None = None

    def close(self) -> None:
        """End it, whatever other threads do with it."""
        self._link.close()
        self.fall_silent()

    @property
    def closed(self) -> bool:
        """Whether it was ended here, or is lost."""
        return self._link.closed

    def keep_alive(self) -> None:
        """Send heartbeats from now on, from a process of their own, while a call is seen to wait. Between two calls a
        robot moves for nobody, and one heartbeat a second shows that the connection stands."""
        self._heartbeat = self._link.heartbeat(Message(String(""), HEARTBEAT), Pace(HEARTBEAT_S, ALIVE_S, IDLE_S))

    def fall_silent(self) -> None:
        """Send no more heartbeats, as a program that hangs: a test whether the robot notices."""
        heartbeat, self._heartbeat = self._heartbeat, None
        if heartbeat is not None:
            heartbeat.close()

    def send_bytes(self, *pieces: bytes) -> None:
        """Send what may not be a message, to test the robot. A heartbeat may come between two pieces."""
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
    def mail(self) -> Generator[Mail]:
        """Open it before a question is sent: what answers cannot then be read by another thread alone."""
        mail = Mail(self)
        self._mails.append(mail)
        self._turns()
        try:
            yield mail
        finally:
            self._mails.remove(mail)
            if not self._mails and self._heartbeat is not None:
                self._heartbeat.idles()

    def hear(self, mail: Mail, timeout_s: float) -> None:
        """Wait until something may have come for `mail`, at most so long."""
        self._turns()
        if self._reading.acquire(timeout=timeout_s):
            try:
                if not mail.came:
                    self._read(timeout_s)
            finally:
                self._reading.release()

    def ask(self, body: Body, name: str, answers: Wanted, what: str, *, marked: bool) -> Message:
        """The answer to a question, not an earlier message that looks like it. `marked`: the robot answers
        GET_CAPABIL, in its turn, so that what came before that answer is the answer to the question or newer.

        Raises LateError."""
        with self._asking:
            if not marked:
                self._drain()
            with self.mail() as mail:
                with self._reading:
                    due = self._marks_sent - self._marks_heard
                    mail.came.clear()
                self.send(body, name)
                if not marked:
                    return mail.need(answers, STATUS_S, what)
                self._mark()
                return self._before_mark(mail, due + 1, answers, what)

    def fresh(self, name: str) -> Message:
        """The next message of a stream that has not come yet. Raises LateError."""
        with self._asking:
            self._drain()
            with self.mail() as mail:
                with self._reading:
                    mail.came.clear()
                return mail.need(lambda m: m.device_name == name, STATUS_S, name)

    def _before_mark(self, mail: Mail, due: int, answers: Wanted, what: str) -> Message:
        """The last answer before the mark; `due`: marks still to come, those of earlier questions first."""
        newest: Message | None = None

        def ends(message: Message) -> bool:
            nonlocal newest, due
            newest = message if answers(message) else newest
            due -= isinstance(message.body, Capability)
            return due <= 0 and newest is not None

        mail.need(ends, STATUS_S, what)
        assert newest is not None  # noqa: S101
        return newest

    def _turns(self) -> None:
        heartbeat = self._heartbeat
        if heartbeat is not None:
            heartbeat.waits()

    def _mark(self) -> None:
        self._marks_sent += 1
        self.send(Get("CAPABILITY"), "")

    def _drain(self) -> None:
        """Read all that has come: a stream goes on where nobody asks."""
        end = time.monotonic() + DRAIN_S
        with self._reading:
            while self._read(0.0):
                if time.monotonic() > end:
                    raise LinkError(f"the robot sends more than can be read: {DRAIN_S:g} s were not enough")

    def _read(self, timeout_s: float) -> bool:
        """Whether something came, which is now in all mails. The thread that reads calls it."""
        event = self._link.receive(timeout_s)
        if event is None:
            return False
        if isinstance(event, Rejected):
            self.unreadable.append(event)
            if event.fatal:
                raise LinkError(f"the robot sends what is not OpenIGTLink: {event.reason}")
            return True
        if isinstance(event.body, Capability) and self._marks_heard < self._marks_sent:
            self._marks_heard += 1
        self.latest[event.device_name] = event
        for mail in tuple(self._mails):
            mail.came.append(event)
        for listener in tuple(self.listeners):
            listener(event)
        return True
