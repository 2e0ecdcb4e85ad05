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

PDU_BYTES = 1 << 20  # [ours] four times what we announce to peers
MESSAGE_BYTES = 128 << 20  # [ours] 64 frames of 1024² at 16 bit; longer runs are exported as files
WAITING = 8  # requests that may wait for an answer; without a negotiated window it is one (PS3.7, D.3.3.3)
PDU_S = 30.0  # limit for receiving a whole PDU, and for the peer to accept an answer [default of pynetdicom]

_P_DATA = 4
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
        self._pdu_left = 0
        self._fragment_left = 0
        self._is_data = False
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
        if not self._pdu_left and not self._head:
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
            if not self._pdu_left:
                view = self._take_head(view, 6)
                if len(self._head) == 6:
                    kind, self._pdu_left = struct.unpack(">BxI", self._head)
                    self._head.clear()
                    self._is_data = kind == _P_DATA
                    if self._pdu_left > self._limits.pdu_bytes:
                        raise self._ended("it announces a message that is too large")
            elif not self._is_data:
                view = self._skip(view)
            elif not self._fragment_left:
                before = len(self._head)
                view = self._take_head(view, min(6, before + self._pdu_left))
                self._pdu_left -= len(self._head) - before
                if len(self._head) == 6:
                    length, control = struct.unpack(">IxB", self._head)
                    self._head.clear()
                    self._begin_fragment(length - 2, control)
                elif not self._pdu_left:
                    raise self._ended("its message contradicts itself")
            else:
                taken = min(len(view), self._fragment_left)
                self._fragment_left -= taken
                self._pdu_left -= taken
                view = view[taken:]

    def _take_head(self, view: memoryview, size: int) -> memoryview:
        missing = size - len(self._head)
        self._head += view[:missing]
        return view[missing:]

    def _skip(self, view: memoryview) -> memoryview:
        taken = min(len(view), self._pdu_left)
        self._pdu_left -= taken
        return view[taken:]

    def _begin_fragment(self, length: int, control: int) -> None:
        if not 0 <= length <= self._pdu_left:
            raise self._ended("its message contradicts itself")
        self._fragment_left = length
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
