"""A DICOM receiver: C-STORE of images from known peers into a case, and C-ECHO (pynetdicom behind our own limits)."""

import socket
from collections.abc import Generator, Iterable
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from socketserver import TCPServer
from threading import Thread
from types import TracebackType
from typing import Any, Self

from pydicom.uid import (
    UID,
    ComputedRadiographyImageStorage,
    DigitalXRayImageStorageForPresentation,
    DigitalXRayImageStorageForProcessing,
    EnhancedXAImageStorage,
    EnhancedXRFImageStorage,
    ExplicitVRBigEndian,
    ExplicitVRLittleEndian,
    ImplicitVRLittleEndian,
    JPEG2000TransferSyntaxes,
    JPEGExtended12Bit,
    JPEGLSTransferSyntaxes,
    JPEGTransferSyntaxes,
    MultiFrameGrayscaleByteSecondaryCaptureImageStorage,
    MultiFrameGrayscaleWordSecondaryCaptureImageStorage,
    RLELossless,
    SecondaryCaptureImageStorage,
    XRayAngiographicImageStorage,
    XRayRadiofluoroscopicImageStorage,
)
from pynetdicom import AE, evt
from pynetdicom.transport import ThreadedAssociationServer

from sightline.case.acquire.acquirer import Acquirer, News, Tell, news_of
from sightline.case.acquire.guard import PDU_BYTES, GuardedSocket, PeerLimits
from sightline.errors import CaseError, ImageError, LinkError, UnusableInputError
from sightline.imaging.quiet import Quiet
from sightline.robot.transport.connection import MESSAGE_S

AET = "SIGHTLINE"
PORT = 11112  # registered for DICOM; port 104 needs a privileged program
LOOPBACK = "127.0.0.1"
ASSOCIATIONS = 4  # [ours] a C-arm, an archive, a workstation, one that hangs
CONNECTIONS = 8 * ASSOCIATIONS  # including those without an association yet, which hold no image
IDLE_S = 60.0  # a silent peer is disconnected after this time [default of pynetdicom]
ASSOCIATE_S = MESSAGE_S  # from the connection to the request for an association, its first message

_ECHO = "1.2.840.10008.1.1"  # verification (PS3.4, A.4)
_IMAGES = (
    XRayAngiographicImageStorage,
    XRayRadiofluoroscopicImageStorage,
    EnhancedXAImageStorage,
    EnhancedXRFImageStorage,
    DigitalXRayImageStorageForPresentation,
    DigitalXRayImageStorageForProcessing,
    ComputedRadiographyImageStorage,
    SecondaryCaptureImageStorage,
    MultiFrameGrayscaleByteSecondaryCaptureImageStorage,
    MultiFrameGrayscaleWordSecondaryCaptureImageStorage,
)
# Transfer syntaxes that `read_image` reads. Left out: the deflated syntax, which could unpack to any size, and JPEG
# Extended, whose 12 bits are not decoded here. A sender then uses one of the syntaxes offered, so no image is lost.
_SYNTAXES: list[UID] = [
    ExplicitVRLittleEndian,
    ImplicitVRLittleEndian,
    ExplicitVRBigEndian,
    *(syntax for syntax in JPEGTransferSyntaxes if syntax != JPEGExtended12Bit),
    *JPEGLSTransferSyntaxes,
    *JPEG2000TransferSyntaxes,
    RLELossless,
]
_SUCCESS, _OUT_OF_RESOURCES, _CANNOT_UNDERSTAND, _PROCESSING_FAILURE = 0x0000, 0xA700, 0xC000, 0x0110  # PS3.4, B.2.3
_quiet = Quiet("ignore", "pydicom", "pynetdicom", all_threads=True)
# Result, source, reason (PS3.8, 9.3.4): permanent, calling AE title not recognised; transient, local limit exceeded.
_UNKNOWN, _BUSY = (0x01, 0x01, 0x03), (0x02, 0x03, 0x02)


@dataclass(frozen=True)
class Peer:
    """A peer that may send: its AE title and the addresses of its host."""

    aet: str
    addresses: frozenset[str]

    @staticmethod
    def parse(text: str) -> "Peer":
        """Return the peer AET@HOST. Raises UnusableInputError for other text or an unknown host."""
        aet, _, host = text.partition("@")
        if not _is_title(aet) or not host:
            raise UnusableInputError("a peer is AET@HOST: its AE title of 1 to 16 characters, and its name or address")
        try:
            resolved = socket.getaddrinfo(host, None, type=socket.SOCK_STREAM)
        except OSError:
            raise UnusableInputError("the host of a peer cannot be resolved; give its address") from None
        return Peer(aet.strip(), frozenset(str(address[4][0]) for address in resolved))


class DicomReceiver:
    """Opens its port when entered, and accepts images within `receiving`:
    `with DicomReceiver(...) as receiver, receiver.receiving(...)`. With `port` 0 the system chooses a free one.

    A C-STORE is answered with success only once the image is in the case and on the disk. Status A7xx means that the
    image could not be written, C000 that it cannot be read; then nothing of it is kept. A peer that is unknown, exceeds
    a limit or falls silent is disconnected and reported; the receiver goes on. Logs and warnings of pydicom and
    pynetdicom quote headers, so all are dropped while a receiver is open.
    Raises UnusableInputError without a peer or with an invalid AE title, LinkError if the port cannot be opened.
    """

    def __init__(
        self,
        peers: Iterable[Peer],
        *,
        aet: str = AET,
        host: str = LOOPBACK,
        port: int = PORT,
        limits: PeerLimits | None = None,
        idle_s: float = IDLE_S,
    ) -> None:
        self._peers = tuple(peers)
        if not self._peers:
            raise UnusableInputError("name at least one peer that may send, as AET@HOST")
        if not _is_title(aet):
            raise UnusableInputError("an AE title has 1 to 16 characters of ASCII, and no backslash")
        self._host, self._wanted_port, self._limits = host, port, limits or PeerLimits()
        self._ae = _application(aet, idle_s)
        self._server: _Server | None = None
        self._open = ExitStack()

    def __enter__(self) -> Self:
        handlers: list[evt.EventHandlerType] = [
            (evt.EVT_REQUESTED, self._admit),
            (evt.EVT_REJECTED, self._rejected),
            (evt.EVT_C_STORE, self._store),
        ]
        try:
            server = _Server(
                self._ae,
                (self._host, self._wanted_port),
                self._ae.ae_title,
                self._ae.supported_contexts,
                evt_handlers=handlers,
            )
        except OSError as error:
            raise LinkError(f"cannot listen at port {self._wanted_port}: {error.strerror}; choose another") from error
        server.limits = self._limits
        server.addresses = frozenset(address for peer in self._peers for address in peer.addresses)
        self._server = server
        self._open.enter_context(_quiet())
        self._open.callback(server.server_close)
        return self

    @contextmanager
    def receiving(self, acquirer: Acquirer, tell: Tell) -> Generator[None]:
        """Answer peers, including those that connected earlier: images go to `acquirer`, news to `tell`."""
        assert self._server is not None  # noqa: S101 - the receiver was entered
        self._acquirer, self._tell, self._server.tell = acquirer, tell, tell
        Thread(target=self._server.serve_forever, args=(0.1,), name="DICOM receiver", daemon=True).start()
        try:
            yield
        finally:
            TCPServer.shutdown(self._server)
            self._ae.shutdown()  # end open associations

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._open.close()

    @property
    def port(self) -> int:
        """The port it listens at."""
        return self._wanted_port if self._server is None else int(self._server.server_address[1])

    def _admit(self, event: evt.Event) -> None:
        """Reject a peer whose AE title and address do not belong together, and one too many."""
        requestor = event.assoc.requestor
        title = (requestor.primitive.calling_ae_title if requestor.primitive else "").strip()
        address = requestor.address
        if not any(peer.aet == title and address in peer.addresses for peer in self._peers):
            self._reject(event, _UNKNOWN, "its AE title is not that of a known peer")
        elif sum(association.is_established for association in self._ae.active_associations) >= ASSOCIATIONS:
            self._reject(event, _BUSY, f"{ASSOCIATIONS} are open already")

    def _reject(self, event: evt.Event, answer: tuple[int, int, int], why: str) -> None:
        event.assoc.acse.send_reject(*answer)
        event.assoc.kill()
        self._tell(News("refused", f"an association from {event.assoc.requestor.address}: {why}"))

    def _rejected(self, event: evt.Event) -> None:
        address = event.assoc.requestor.address
        self._tell(News("refused", f"an association from {address}: it calls another AE title than ours"))

    def _store(self, event: evt.Event) -> int:
        try:
            taken = self._acquirer.take(event.encoded_dataset(), ".dcm", how={"source": "dicom"})
        except ImageError as error:
            return self._refused(_CANNOT_UNDERSTAND, str(error))
        except (CaseError, MemoryError, OSError) as error:
            return self._refused(_OUT_OF_RESOURCES, str(error) or "out of memory")
        except Exception as error:  # a bad header may make pydicom raise anything; the receiver must go on
            return self._refused(_PROCESSING_FAILURE, f"it cannot be processed ({type(error).__name__})")
        self._tell(news_of(taken))
        return _SUCCESS

    def _refused(self, status: int, why: str) -> int:
        self._tell(News("refused", f"an image, answered with {status:04X}: {why}"))
        return status


class _Server(ThreadedAssociationServer):
    """Accepts a limited number of connections, from known addresses only, and guards each of them."""

    limits = PeerLimits()
    addresses: frozenset[str] = frozenset()
    tell: Tell

    def get_request(self) -> tuple[socket.socket, Any]:
        """Accept a connection and return it guarded, with its address."""
        connected, address = super().get_request()

        def ended(why: str) -> None:
            self.tell(News("refused", f"a connection from {address[0]}, which is closed: {why}"))

        return GuardedSocket(connected, self.limits, ended), address

    def verify_request(self, request: Any, client_address: Any) -> bool:
        """Whether the connection is served; bytes from an unknown address are never read."""
        if client_address[0] not in self.addresses:
            self.tell(
                News("refused", f"a connection from {client_address[0]}, which is not the address of a known peer")
            )
            return False
        if len(self.active_associations) >= CONNECTIONS:
            self.tell(News("refused", f"a connection from {client_address[0]}: too many are open"))
            return False
        return True

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Report the failure instead of printing it; the next connection is served."""
        self.tell(News("refused", f"a connection from {client_address[0]} that failed"))


def _application(aet: str, idle_s: float) -> AE:
    ae = AE(ae_title=aet)
    ae.require_called_aet = True
    ae.maximum_associations = CONNECTIONS
    ae.maximum_pdu_size = PDU_BYTES // 4
    ae.acse_timeout, ae.network_timeout, ae.dimse_timeout = ASSOCIATE_S, idle_s, idle_s
    ae.add_supported_context(_ECHO)
    for image in _IMAGES:
        ae.add_supported_context(image, _SYNTAXES)
    return ae


def _is_title(text: str) -> bool:
    """Whether the text is a valid AE title (PS3.5, 6.2: VR AE)."""
    return bool(text.strip()) and len(text) <= 16 and text.isascii() and text.isprintable() and "\\" not in text
