"""The guard before the DICOM library: what passes, and each limit that ends a connection."""

import socket
import struct
import time
from collections.abc import Iterator
from contextlib import suppress

import pytest

from sightline.case.acquire.guard import GuardedSocket, PeerError, PeerLimits

LIMITS = PeerLimits(pdu_bytes=100, message_bytes=150, waiting=2, pdu_s=0.2)
COMMAND, DATA, LAST = 1, 0, 2


@pytest.fixture
def ends() -> Iterator[tuple[socket.socket, GuardedSocket, list[str]]]:
    said: list[str] = []
    peer, ours = socket.socketpair()
    guarded = GuardedSocket(ours, LIMITS, said.append)
    yield peer, guarded, said
    peer.close()
    guarded.close()


def pdu(kind: int, body: bytes) -> bytes:
    return struct.pack(">BxI", kind, len(body)) + body


def fragment(control: int, data: bytes) -> bytes:
    return struct.pack(">IBB", len(data) + 2, 1, control) + data


def request(data: bytes = b"") -> bytes:
    command = pdu(4, fragment(COMMAND | LAST, b"c" * 20))
    return command + (pdu(4, fragment(DATA | LAST, data)) if data else b"")


def read(guarded: GuardedSocket, size: int, piece: int) -> bytes:
    got = b""
    while len(got) < size:
        got += guarded.recv(min(piece, size - len(got)))
    return got


@pytest.mark.parametrize("piece", [1, 3, 7, 4096])
def test_what_keeps_the_limits_passes_unchanged_in_pieces_of_any_size(ends, piece: int) -> None:
    peer, guarded, said = ends
    sent = pdu(1, b"a" * 90)
    for _ in range(5):
        sent += request(b"d" * 80)
    sent += pdu(4, fragment(COMMAND | LAST, b"x" * 10) + fragment(DATA, b"") + fragment(DATA | LAST, b"y" * 9))
    for start in range(0, len(sent), 300):
        part = sent[start : start + 300]
        peer.sendall(part)
        assert read(guarded, len(part), piece) == part
        guarded.send(pdu(4, b"")[:6])
        guarded.send(pdu(4, b"")[:6])
    assert said == []


@pytest.mark.parametrize(
    ("sent", "why"),
    [
        (struct.pack(">BxI", 1, 101), "announces a message that is too large"),
        (struct.pack(">BxI", 4, 0xFFFFFFFF), "announces a message that is too large"),
        (2 * pdu(4, fragment(DATA, b"d" * 80)), "an image that is too large"),
        (20 * pdu(4, fragment(COMMAND, b"c" * 10)), "an image that is too large"),
        (3 * request(), "without waiting for answers"),
        (pdu(4, struct.pack(">IBB", 60, 1, 0) + b"d" * 10), "contradicts itself"),
        (pdu(4, struct.pack(">IBB", 1, 1, 0)), "contradicts itself"),
        (pdu(4, b"abc"), "contradicts itself"),
    ],
)
def test_each_limit_ends_the_connection_and_is_told(ends, sent: bytes, why: str) -> None:
    peer, guarded, said = ends
    peer.sendall(sent)
    with pytest.raises(PeerError, match=why):
        read(guarded, len(sent), 64)
    assert len(said) == 1
    peer.settimeout(1.0)
    with suppress(ConnectionError):  # where the guard had not read all that was sent
        assert peer.recv(1) == b""


def test_a_message_that_drips_in_is_not_waited_for(ends) -> None:
    peer, guarded, _ = ends
    peer.sendall(struct.pack(">BxI", 1, 50))
    assert len(guarded.recv(6)) == 6
    with pytest.raises(OSError):
        while True:
            peer.sendall(b"x")
            guarded.recv(1)
            time.sleep(0.05)
