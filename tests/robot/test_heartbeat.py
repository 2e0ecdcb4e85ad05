"""Heartbeats on a simulated clock: as long as the client shows that it goes on, and no longer."""

import itertools
from types import SimpleNamespace

import pytest

from sightline.robot.contract import ALIVE_S, HEARTBEAT_S, IDLE_S
from sightline.robot.transport import heartbeat
from sightline.robot.transport.heartbeat import IDLE, WAITING, Pace, beat

PACE = Pace(HEARTBEAT_S, ALIVE_S, IDLE_S)


class Client:
    """Says at these times what it does, and ends at the last. `pauses`: the machine stands still from this time on for
    so long, and nothing is said meanwhile."""

    def __init__(self, said: dict[float, bytes], end_s: float, pauses: dict[float, float]) -> None:
        self.now_s, self.sent_s = 0.0, []
        self._said, self._end_s, self._pauses = sorted(said.items()), end_s, sorted(pauses.items())

    def monotonic(self) -> float:
        return self.now_s

    def select(self, readable, writable, _, timeout):
        if writable:
            return [], writable, []
        until = self.now_s + timeout
        heard = bool(self._said) and self._said[0][0] <= until
        self.now_s = max(self.now_s, self._said[0][0]) if heard else until
        if self._pauses and self._pauses[0][0] <= self.now_s:
            self.now_s += self._pauses.pop(0)[1]
        return (readable if heard or self.now_s >= self._end_s else []), [], []

    def recv(self, _) -> bytes:
        return b"" if self.now_s >= self._end_s else self._said.pop(0)[1]

    def send(self, message: bytes) -> int:
        self.sent_s.append(self.now_s)
        return len(message)


def heartbeats(monkeypatch, said: dict[float, bytes], end_s: float, pauses: dict[float, float] | None = None) -> list:
    client = Client(said, end_s, pauses or {})
    monkeypatch.setattr(heartbeat, "time", SimpleNamespace(monotonic=client.monotonic))
    monkeypatch.setattr(heartbeat, "select", SimpleNamespace(select=client.select))
    beat(client, client, b"beat", PACE)
    return client.sent_s


def test_one_every_fifty_milliseconds_until_a_call_hangs(monkeypatch):
    sent = heartbeats(monkeypatch, {0.3: WAITING, 0.7: WAITING}, end_s=4.0)
    waiting = [at for at in sent if at > 0.3]
    assert all(later - at == pytest.approx(HEARTBEAT_S, abs=0.0011) for at, later in itertools.pairwise(waiting))
    assert waiting[-1] == pytest.approx(0.7 + ALIVE_S, abs=HEARTBEAT_S + 1e-6)


def test_one_a_second_where_no_call_waits(monkeypatch):
    sent = heartbeats(monkeypatch, {0.0: WAITING, 0.5: IDLE}, end_s=5.0)
    idle = [at for at in sent if at > 0.55]
    assert len(idle) == 4
    assert all(later - at == pytest.approx(IDLE_S, abs=HEARTBEAT_S + 1e-6) for at, later in itertools.pairwise(idle))


def test_a_pause_of_the_machine_is_no_hang_of_the_client(monkeypatch):
    """Each longer than a call may hang: the client had as little time as its heartbeats, and is seen afterwards."""
    pauses = {0.2: 1.5, 1.9: 0.9, 3.0: 30.0}
    said = {0.1: WAITING, 1.8: WAITING, 2.95: WAITING, 33.2: WAITING}
    sent = heartbeats(monkeypatch, said, end_s=33.3, pauses=pauses)
    gaps = [later - at for at, later in itertools.pairwise(sent)]
    assert sorted(gap for gap in gaps if gap > 2 * HEARTBEAT_S) == pytest.approx([0.9, 1.5, 30.0], abs=2 * HEARTBEAT_S)
