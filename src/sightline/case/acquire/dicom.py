"""A DICOM receiver: C-STORE of images from known peers into a case, and C-ECHO (pynetdicom behind our own guard)."""

import logging
import socket
import warnings
from collections.abc import Generator, Iterable
from contextlib import contextmanager
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
from sightline.case.acquire.guard import PDU_BYTES, GuardedSocket, Limits
from sightline.errors import CaseError, ImageError, LinkError, UnusableInputError

AET = "SIGHTLINE"
PORT = 11112  # registered for DICOM; 104 needs a privileged program
LOOPBACK = "127.0.0.1"
ASSOCIATIONS = 4  # [ours] a C-arm, an archive, a workstation, one that hangs
CONNECTIONS = 32  # [ours] with those that have not asked for an association yet; they hold no image
IDLE_S = 60.0  # [ours] a peer that says nothing for so long is let go; between two images there may be a minute
ASSOCIATE_S = 5.0  # [ours] from the connection to the request for an association

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
# What `read_image` reads. Not the deflated syntax, which could unpack to any size; nor JPEG Extended, whose 12 bits are
# not decoded here: a sender that is not offered it sends another one, and no image is lost.
_SYNTAXES: list[UID] = [
    ExplicitVRLittleEndian,
    ImplicitVRLittleEndian,
    ExplicitVRBigEndian,
    *(syntax for syntax in JPEGTransferSyntaxes if syntax != JPEGExtended12Bit),
    *JPEGLSTransferSyntaxes,
    *JPEG2000TransferSyntaxes,
    RLELossless,
]
_SUCCESS, _NO_ROOM, _NO_IMAGE, _FAILED = 0x0000, 0xA700, 0xC000, 0x0110  # PS3.4, B.2.3; PS3.7, C
# Result, source, reason (PS3.8, 9.3.4): for good, the calling AE title is not recognised; for now, too many are open.
_UNKNOWN, _BUSY = (0x01, 0x01, 0x03), (0x02, 0x03, 0x02)


@dataclass(frozen=True)
class Peer:
    """Who may send: an AE title and the addresses of its host."""

    aet: str
    addresses: frozenset[str]

    @staticmethod
    def parse(text: str) -> "Peer":
        """From AET@HOST. Raises UnusableInputError where that is none, or no such host is known."""
        aet, _, host = text.partition("@")
        if not _is_title(aet) or not host:
            raise UnusableInputError("a peer is AET@HOST: its AE title of 1 to 16 characters, and its name or address")
        try:
            found = socket.getaddrinfo(host, None, type=socket.SOCK_STREAM)
        except OSError:
            raise UnusableInputError("the host of a peer is not known here; give its address") from None
        return Peer(aet.strip(), frozenset(str(address[4][0]) for address in found))


class DicomReceiver:
    """Has its port while it is entered, and answers there while it is told where images go:
    `with DicomReceiver(...) as receiver, receiver.receiving(...)`. `port`: where; 0 asks for a free one.

    Before a C-STORE is answered with success the image is in the case and on the disk. A7xx says that the disk took
    nothing, C000 that it is no image that can be read: nothing of it is kept, and the sender knows. A peer that is not
    known, breaks a limit or goes silent is let go and told of; the receiver stays. What pydicom and pynetdicom log and
    warn of quotes headers, so it is switched off for the whole process.
    Raises UnusableInputError without a peer or with a bad title, LinkError where the port cannot be had.
    """

    def __init__(
        self,
        peers: Iterable[Peer],
        *,
        aet: str = AET,
        host: str = LOOPBACK,
        port: int = PORT,
        limits: Limits | None = None,
        idle_s: float = IDLE_S,
    ) -> None:
        self._peers = tuple(peers)
        if not self._peers:
            raise UnusableInputError("name at least one peer that may send, as AET@HOST")
        if not _is_title(aet):
            raise UnusableInputError("an AE title has 1 to 16 characters of ASCII, and no backslash")
        self._host, self._wanted_port, self._limits = host, port, limits or Limits()
        self._ae = _application(aet, idle_s)
        self._server: _Server | None = None

    def __enter__(self) -> Self:
        logging.getLogger("pynetdicom").propagate = False
        logging.getLogger("pydicom").propagate = False
        warnings.filterwarnings("ignore", module=r"(pydicom|pynetdicom)(\.|$)")
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
        return self

    @contextmanager
    def receiving(self, acquirer: Acquirer, tell: Tell) -> Generator[None]:
        """Answer whoever has called since the port was had: images go to `acquirer`, news to `tell`."""
        assert self._server is not None  # noqa: S101 - it is entered
        self._acquirer, self._tell, self._server.tell = acquirer, tell, tell
        Thread(target=self._server.serve_forever, args=(0.1,), name="DICOM receiver", daemon=True).start()
        try:
            yield
        finally:
            TCPServer.shutdown(self._server)
            self._ae.shutdown()  # what is still associated

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._server is not None:
            self._server.server_close()

    @property
    def port(self) -> int:
        """Where it listens."""
        return self._wanted_port if self._server is None else int(self._server.server_address[1])

    def _admit(self, event: evt.Event) -> None:
        """Turn away whoever is not the peer that its address belongs to."""
        requestor = event.assoc.requestor
        title = (requestor.primitive.calling_ae_title if requestor.primitive else "").strip()
        address = requestor.address
        if not any(peer.aet == title and address in peer.addresses for peer in self._peers):
            self._turn_away(event, _UNKNOWN, "its AE title is not that of a known peer")
        elif sum(one.is_established for one in self._ae.active_associations) >= ASSOCIATIONS:
            self._turn_away(event, _BUSY, f"{ASSOCIATIONS} are open already")

    def _turn_away(self, event: evt.Event, answer: tuple[int, int, int], why: str) -> None:
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
            return self._refused(_NO_IMAGE, str(error))
        except (CaseError, MemoryError, OSError) as error:
            return self._refused(_NO_ROOM, str(error) or "out of memory")
        except Exception as error:  # whatever a header makes pydicom raise, the receiver goes on
            return self._refused(_FAILED, f"it cannot be taken in ({type(error).__name__})")
        self._tell(news_of(taken))
        return _SUCCESS

    def _refused(self, status: int, why: str) -> int:
        self._tell(News("refused", f"an image, answered with {status:04X}: {why}"))
        return status


class _Server(ThreadedAssociationServer):
    """Guards every connection, and accepts only so many, from known addresses."""

    limits = Limits()
    addresses: frozenset[str] = frozenset()
    tell: Tell

    def get_request(self) -> tuple[socket.socket, Any]:
        """A guarded connection."""
        connected, address = super().get_request()

        def ended(why: str) -> None:
            self.tell(News("refused", f"a connection from {address[0]}, which is closed: {why}"))

        return GuardedSocket(connected, self.limits, ended), address

    def verify_request(self, request: Any, client_address: Any) -> bool:
        """Whether it is served; a stranger's bytes are not even read."""
        if client_address[0] not in self.addresses:
            self.tell(News("refused", f"a connection from {client_address[0]}, which is no known peer's address"))
            return False
        if len(self.active_associations) >= CONNECTIONS:
            self.tell(News("refused", f"a connection from {client_address[0]}: too many are open"))
            return False
        return True

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Nothing is printed; the next connection is served."""
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
    """PS3.5, 6.2: VR AE."""
    return bool(text.strip()) and len(text) <= 16 and text.isascii() and text.isprintable() and "\\" not in text
