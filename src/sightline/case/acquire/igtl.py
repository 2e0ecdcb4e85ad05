"""Images over OpenIGTLink, from 3D Slicer, PLUS and others: called, or waited for."""

import socket
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from sightline.errors import ImageError, LinkError, SourceError
from sightline.imaging import Radiograph, SourceFrame
from sightline.imaging.files import grey
from sightline.imaging.limits import check_size
from sightline.robot.igtl import Image, Message, Rejected, Stream
from sightline.robot.transport import LOOPBACK
from sightline.robot.transport.sockets import prepare

PORT = 18944  # that of OpenIGTLink
SILENCE_S = 10.0  # [ours] without an image, or a peer to connect to, before it is given up
MESSAGE_S = 5.0  # for a message to be whole, as in the robot's link
_PIECE = 1 << 16
_CONNECT_S, _AGAIN_S = 2.0, 0.5


class ImageLink:
    """Frames of an OpenIGTLink peer: `host`:`port` is called, or with `listen` waited at; one peer at a time.

    A peer that is lost is called or waited for again, for `silence_s`. What is no image of one slice is told of and
    passed over.
    Raises SourceError where nothing comes for `silence_s`, LinkError where the port cannot be had.
    """

    def __init__(
        self,
        host: str = LOOPBACK,
        port: int = PORT,
        *,
        listen: bool = False,
        silence_s: float = SILENCE_S,
        tell: Callable[[str], None] = lambda _: None,
    ) -> None:
        self._stated: dict[str, Any] = {}
        self._address, self._silence_s, self._tell = (host, port), silence_s, tell
        self._closed = False
        self._peer: socket.socket | None = None
        self._server = _server(host, port) if listen else None

    @property
    def port(self) -> int:
        """Where it listens, or calls."""
        return self._address[1] if self._server is None else int(self._server.getsockname()[1])

    def stated(self) -> dict[str, Any]:
        """What the last image said of its own place in space: for the record, never used."""
        return self._stated

    def __iter__(self) -> Iterator[SourceFrame]:
        number = 0
        while not self._closed:
            for message in self._messages(self._connected()):
                try:
                    image = radiograph_of(message.body)
                except ImageError as error:
                    self._tell(f"an image was passed over: {error}")
                    continue
                number += 1
                matrix = message.body.matrix
                known = bool(np.isfinite(matrix).all())
                self._stated = {
                    "stated_matrix": matrix if known else None,
                    "stated_coordinates": message.body.coordinates,
                }
                yield SourceFrame(image, number, time.time(), "openigtlink", message.message.time_s)

    def close(self) -> None:
        """End the link."""
        self._closed = True
        for one in (self._peer, self._server):
            if one is not None:
                one.close()

    def _connected(self) -> socket.socket:
        """A peer. Raises SourceError after `silence_s` without one."""
        end = time.monotonic() + self._silence_s
        while not self._closed:
            try:
                if self._server is not None:
                    self._server.settimeout(_AGAIN_S)
                    self._peer = self._server.accept()[0]
                else:
                    self._peer = socket.create_connection(self._address, timeout=_CONNECT_S)
            except OSError:
                if time.monotonic() >= end:
                    why = f"no OpenIGTLink peer came within {self._silence_s:g} s; start it, and look at its port"
                    raise SourceError(why) from None
                time.sleep(0.0 if self._server is not None else min(_AGAIN_S, self._silence_s))
            else:
                prepare(self._peer)
                return self._peer
        raise SourceError("the link was closed")

    def _messages(self, peer: socket.socket) -> "Iterator[_Received]":
        """Images of one peer until it goes; others of its messages are none of our business."""
        stream, heard_s, began_s = Stream(), time.monotonic(), None
        peer.settimeout(_AGAIN_S)
        with peer:
            while not self._closed:
                now = time.monotonic()
                if now - heard_s > self._silence_s:
                    why = f"the OpenIGTLink peer sent no image for {self._silence_s:g} s; look at what it streams"
                    raise SourceError(why)
                if began_s is not None and now - began_s > MESSAGE_S:
                    return self._tell("the OpenIGTLink peer sent half a message; its connection is closed")
                try:
                    data = peer.recv(_PIECE)
                except TimeoutError:
                    continue
                except OSError:
                    data = b""
                if not data:
                    return self._tell("the OpenIGTLink peer is gone")
                events = stream.feed(data)
                began_s = None if not stream.partial else now if events or began_s is None else began_s
                for event in events:
                    if isinstance(event, Rejected):
                        self._tell(f"a message was passed over: {event.fault.value}")
                        if event.fatal:
                            return None
                    elif isinstance(event.body, Image):
                        heard_s = now
                        yield _Received(event, event.body)
        return None


class _Received:
    """A message and its body, which is an image."""

    def __init__(self, message: Message, body: Image) -> None:
        self.message, self.body = message, body


def radiograph_of(image: Image) -> Radiograph:
    """One slice as a radiograph: 8 and 16 bits as they are, the negative ones shifted up, others as floats.

    Raises ImageError on a part of an image, a volume, a true colour image and numbers that a float does not hold.
    """
    slices, height, width = image.pixels.shape[:3]
    if image.size != (width, height, slices) or any(image.offset):
        raise ImageError("it is a part of an image; let the peer send whole ones")
    if slices != 1:
        raise ImageError(f"it is a volume of {slices} slices; let the peer send single images")
    check_size(height, width, "the image")
    pixels = grey(image.pixels[0], "the image")
    if pixels.dtype in (np.int8, np.int16):
        low, kind = np.iinfo(pixels.dtype).min, np.uint8 if pixels.dtype == np.int8 else np.uint16
        pixels = (pixels.astype(np.int32) - (low if pixels.min() < 0 else 0)).astype(kind)
    if pixels.dtype in (np.uint8, np.uint16):
        return Radiograph(pixels, float(np.iinfo(pixels.dtype).max))
    floats = pixels.astype(np.float32)
    if not np.isfinite(floats).all() or (pixels.dtype.kind in "iu" and (floats.astype(np.float64) != pixels).any()):
        raise ImageError("its numbers do not fit into floats of 32 bits; let the peer send 16 bits")
    return Radiograph(floats, float(np.nextafter(floats.max(), np.float32(np.inf))))


def _server(host: str, port: int) -> socket.socket:
    try:
        return socket.create_server((host, port))
    except OSError as error:
        raise LinkError(f"cannot listen at port {port}: {error.strerror}; choose another") from error
