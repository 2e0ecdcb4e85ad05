"""Limits on the size and duration of a DICOM peer's messages.

pynetdicom reads any length that a peer announces, keeps every message until it is answered, and waits for the rest of a
message without a time limit. GuardedSocket parses the same bytes and closes the connection first (PS3.8, 9.3; PS3.7,
6.3.1).
"""

import socket
import struct
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass

PDU_BYTES = 1 << 20  # [ours] four times what we announce to peers, for those that ignore it
MESSAGE_BYTES = 128 << 20  # [ours] 64 frames of 1024² at 16 bit; longer runs are exported as files
WAITING = 8  # requests that may wait for an answer; without a negotiated window it is one (PS3.7, D.3.3.3)
PDU_S = 30.0  # limit for receiving a whole PDU, and for the peer to accept an answer [default of pynetdicom]

_P_DATA = 4
_HEAD_BYTES = 6  # of a PDU, and of a fragment
_COMMAND, _LAST = 1, 2  # bits of a fragment's control header (PS3.8, E.2)


class PeerError(OSError):
    """A peer exceeded a limit; the connection is closed."""


@dataclass(frozen=True)
class PeerLimits:
    """Limits: bytes of one PDU, bytes of one request with its image, unanswered requests, seconds for one PDU."""

    pdu_bytes: int = PDU_BYTES
    message_bytes: int = MESSAGE_BYTES
    waiting: int = WAITING
    pdu_s: float = PDU_S


class GuardedSocket(socket.socket):
    """A connected socket that reports to `say`, shuts down and raises PeerError when its peer exceeds a limit."""

    def __init__(self, connected: socket.socket, limits: PeerLimits, say: Callable[[str], None]) -> None:
        super().__init__(connected.family, connected.type, connected.proto, fileno=connected.detach())
        self._limits, self._say = limits, say
        self._head = bytearray()  # incomplete header of a PDU or of a fragment in it
        self._skipped = 0  # bytes to come of a fragment, or of a PDU without fragments
        self._pdu_left = 0  # bytes of the PDU behind them
        self._in_command = False
        self._message_bytes = 0
        self._waiting = 0
        self._began_s: float | None = None

    def recv(self, bufsize: int, flags: int = 0) -> bytes:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Receive as a socket does. Raises PeerError, TimeoutError."""
        now = time.monotonic()
        if self._began_s is None:
            self._began_s = now
        left_s = self._began_s + self._limits.pdu_s - now
        if left_s <= 0:
            raise self._ended("a message was not complete in time")
        self.settimeout(left_s)
        data = super().recv(bufsize, flags)
        self._watch(data)
        if not (self._skipped or self._pdu_left or self._head):
            self._began_s = None
        return data

    def send(self, data: bytes, flags: int = 0) -> int:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Send as a socket does. Raises TimeoutError if the peer accepts nothing."""
        self.settimeout(self._limits.pdu_s)
        if data[:1] == bytes([_P_DATA]):
            self._waiting = max(0, self._waiting - 1)
        return super().send(data, flags)

    def shutdown(self, how: int) -> None:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Shut down as a socket does, but without an error if the peer is gone, after which pynetdicom would not close
        the socket."""
        with suppress(OSError):
            super().shutdown(how)

    def _watch(self, data: bytes) -> None:
        view = memoryview(data)
        while view:
            if self._skipped:
                taken = min(len(view), self._skipped)
                self._skipped -= taken
            else:
                taken = min(len(view), _HEAD_BYTES - len(self._head))
                self._head += view[:taken]
            view = view[taken:]
            if len(self._head) == _HEAD_BYTES:
                head, self._head = self._head, bytearray()
                begin = self._begin_fragment if self._pdu_left else self._begin_pdu
                begin(head)
                if 0 < self._pdu_left < _HEAD_BYTES:
                    raise self._ended("its message contradicts itself")

    def _begin_pdu(self, head: bytearray) -> None:
        kind, length = struct.unpack(">BxI", head)
        if length > self._limits.pdu_bytes:
            raise self._ended("it announces a message that is too large")
        self._skipped, self._pdu_left = (0, length) if kind == _P_DATA else (length, 0)

    def _begin_fragment(self, head: bytearray) -> None:
        stated, control = struct.unpack(">IxB", head)
        length = stated - 2  # without the two bytes of the header that it counts
        self._pdu_left -= _HEAD_BYTES + length
        if length < 0 or self._pdu_left < 0:
            raise self._ended("its message contradicts itself")
        self._skipped = length
        is_command = bool(control & _COMMAND)
        if is_command and not self._in_command:
            self._message_bytes = 0  # of the message that begins
        self._in_command = is_command
        self._message_bytes += length
        if self._message_bytes > self._limits.message_bytes:
            raise self._ended("it sends an image that is too large")
        if is_command and control & _LAST:
            self._waiting += 1
            if self._waiting > self._limits.waiting:
                raise self._ended("it sends without waiting for answers")

    def _ended(self, why: str) -> PeerError:
        self.shutdown(socket.SHUT_RDWR)
        self._say(why)
        return PeerError(why)
