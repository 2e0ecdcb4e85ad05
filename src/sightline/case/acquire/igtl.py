"""Images over OpenIGTLink from 3D Slicer, PLUS and others, as client or as server."""

import socket
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from sightline.errors import ImageError, LinkError, SourceError
from sightline.imaging import Radiograph, SourceFrame, as_radiograph
from sightline.imaging.formats import check_size, grey
from sightline.robot.igtl import Image, Message, Rejected, Stream
from sightline.robot.transport import LOOPBACK
from sightline.robot.transport.connection import CONNECT_S, MESSAGE_S, prepare

PORT = 18944  # OpenIGTLink's default
SILENCE_S = 10.0  # [ours] without an image or a peer, after which the source fails: longer than a restart of the sender
_CHUNK = 1 << 16  # bytes
_RETRY_S = 0.5


class ImageLink:
    """Frames of an OpenIGTLink peer: connects to `host`:`port`, or with `listen` waits there; one peer at a time.

    After a lost connection it connects or waits again, for `silence_s`. An image that is not a single slice is reported
    and skipped.
    Raises SourceError if nothing comes for `silence_s`, LinkError if the port cannot be opened.
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
        """The port it listens at or connects to."""
        return self._address[1] if self._server is None else int(self._server.getsockname()[1])

    def stated(self) -> dict[str, Any]:
        """Return the position that the last image stated for itself: for the record, never used."""
        return self._stated

    def __iter__(self) -> Iterator[SourceFrame]:
        number = 0
        while not self._closed:
            for message, body in self._messages(self._connected()):
                try:
                    image = radiograph_of(body)
                except ImageError as error:
                    self._tell(f"an image was skipped: {error}")
                    continue
                number += 1
                matrix = body.matrix
                known = bool(np.isfinite(matrix).all())
                self._stated = {
                    "stated_matrix": matrix if known else None,
                    "stated_coordinates": body.coordinates,
                }
                yield SourceFrame(image, number, time.time(), "openigtlink", message.time_s)

    def close(self) -> None:
        """Close the link."""
        self._closed = True
        for link in (self._peer, self._server):
            if link is not None:
                link.close()

    def _connected(self) -> socket.socket:
        """Return a connected peer. Raises SourceError after `silence_s` without one."""
        end = time.monotonic() + self._silence_s
        while not self._closed:
            try:
                if self._server is not None:
                    self._server.settimeout(_RETRY_S)
                    self._peer = self._server.accept()[0]
                else:
                    self._peer = socket.create_connection(self._address, timeout=CONNECT_S)
            except OSError:
                if time.monotonic() >= end:
                    why = f"no OpenIGTLink peer connected within {self._silence_s:g} s; start it, and check its port"
                    raise SourceError(why) from None
                time.sleep(0.0 if self._server is not None else min(_RETRY_S, self._silence_s))
            else:
                prepare(self._peer)
                return self._peer
        raise SourceError("the link was closed")

    def _messages(self, peer: socket.socket) -> Iterator[tuple[Message, Image]]:
        """Yield the images of one peer until it disconnects; its other messages are ignored."""
        stream, heard_s, began_s = Stream(), time.monotonic(), None
        peer.settimeout(_RETRY_S)
        with peer:
            while not self._closed:
                now = time.monotonic()
                if now - heard_s > self._silence_s:
                    why = f"the OpenIGTLink peer sent no image for {self._silence_s:g} s; check what it streams"
                    raise SourceError(why)
                if began_s is not None and now - began_s > MESSAGE_S:
                    return self._tell("the OpenIGTLink peer sent an incomplete message; its connection is closed")
                try:
                    data = peer.recv(_CHUNK)
                except TimeoutError:
                    continue
                except OSError:
                    data = b""
                if not data:
                    return self._tell("the OpenIGTLink peer disconnected")
                events = stream.feed(data)
                began_s = None if not stream.partial else now if events or began_s is None else began_s
                for event in events:
                    if isinstance(event, Rejected):
                        self._tell(f"a message was skipped: {event.fault.value}")
                        if event.fatal:
                            return None
                    elif isinstance(event.body, Image):
                        heard_s = now
                        yield event, event.body
        return None


def radiograph_of(image: Image) -> Radiograph:
    """Return one slice as a radiograph: 8 and 16 bits unchanged, others as floats.

    Raises ImageError for a part of an image, a volume, a colour image, negative values (but see
    `imaging.formats.non_negative`), and values that a 32-bit float cannot hold.
    """
    slices, height, width = image.pixels.shape[:3]
    if image.size != (width, height, slices) or any(image.offset):
        raise ImageError("it is a part of an image; let the peer send whole images")
    if slices != 1:
        raise ImageError(f"it is a volume of {slices} slices; let the peer send single images")
    check_size(height, width, "the image")
    pixels = grey(image.pixels[0], "the image")
    if pixels.dtype.kind in "iu" and pixels.dtype.itemsize <= 2:
        return as_radiograph(pixels)
    floats = pixels.astype(np.float32)
    if not np.isfinite(floats).all() or (pixels.dtype.kind in "iu" and (floats.astype(np.float64) != pixels).any()):
        raise ImageError("its values do not fit into 32-bit floats; let the peer send 16 bits")
    return Radiograph(floats, float(np.nextafter(floats.max(), np.float32(np.inf))))


def _server(host: str, port: int) -> socket.socket:
    try:
        return socket.create_server((host, port))
    except OSError as error:
        raise LinkError(f"cannot listen at port {port}: {error.strerror}; choose another") from error
