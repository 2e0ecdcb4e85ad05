"""The DICOM receiver beside a real sender (pynetdicom) and beside bytes that are none."""

import socket
import struct
import time
import tracemalloc
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path

import numpy as np
import pytest
from pydicom import Dataset, dcmread
from pydicom.uid import (
    JPEGExtended12Bit,
    JPEGLosslessSV1,
    SecondaryCaptureImageStorage,
    XRayAngiographicImageStorage,
)
from pynetdicom import AE
from pynetdicom.association import Association

from sightline.case.acquire import Acquirer, News
from sightline.case.acquire.dicom import DicomReceiver, Peer
from sightline.case.acquire.guard import PeerLimits
from sightline.case.journal import Actor, Case, Kind
from sightline.case.report.content import exposures_of_case
from sightline.errors import CaseError, LinkError, UnusableInputError
from sightline.imaging import Radiograph, read_image, write_dicom

XA, ECHO = "1.2.840.10008.5.1.4.1.1.12.1", "1.2.840.10008.1.1"
PEER = Peer.parse("CARM@127.0.0.1")
LIMITS = PeerLimits(pdu_bytes=1 << 20, message_bytes=1 << 18, pdu_s=1.0)


class Scene:
    """A receiver, its case, what it told."""

    def __init__(self, receiver: DicomReceiver, case: Case, news: list[News]) -> None:
        self.receiver, self.case, self.news = receiver, case, news

    @contextmanager
    def association(self, title: str = "CARM", called: str = "SIGHTLINE") -> Iterator[Association]:
        ae = AE(ae_title=title)
        ae.add_requested_context(XA)
        ae.add_requested_context(ECHO)
        ae.connection_timeout = ae.acse_timeout = ae.dimse_timeout = 5.0
        association = ae.associate("127.0.0.1", self.receiver.port, ae_title=called)
        held = association.dul.socket
        with held.socket if held and held.socket else nullcontext():  # pynetdicom leaves it open after a reset
            yield association
            if association.is_established:
                association.release()

    def store(self, dataset: Dataset) -> int:
        """The status of one image on an association of its own."""
        with self.association() as association:
            assert association.is_established
            return association.send_c_store(dataset).Status

    def raw(self, data: bytes) -> bytes:
        """What comes back for bytes, until the connection ends."""
        with socket.create_connection(("127.0.0.1", self.receiver.port), timeout=5.0) as peer:
            peer.sendall(data)
            got = b""
            try:
                while piece := peer.recv(1000):
                    got += piece
            except ConnectionError:
                pass
            return got

    def told(self, text: str) -> bool:
        """Whether something is told of within two seconds."""
        end = time.monotonic() + 2.0
        while time.monotonic() < end:
            if any(text in news.text for news in self.news):
                return True
            time.sleep(0.01)
        return False


@pytest.fixture
def scene(tmp_path: Path) -> Iterator[Scene]:
    news: list[News] = []
    with Case.create(tmp_path / "case") as case:
        acquirer = Acquirer(case)
        receiver = DicomReceiver([PEER], port=0, limits=LIMITS, idle_s=2.0)
        with receiver, receiver.receiving(acquirer, news.append):
            yield Scene(receiver, case, news)


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Callable[[int], Dataset]:
    folder = tmp_path_factory.mktemp("sent")

    def made(seed: int) -> Dataset:
        pixels = np.random.default_rng(seed).integers(0, 4096, (64, 64), dtype=np.uint16)
        out = dcmread(write_dicom(Radiograph(pixels, 4095.0), folder / f"{seed}.dcm"))
        out.PatientName = "Doe^Jane"
        return out

    return made


def test_an_image_is_in_the_case_when_it_is_answered(scene: Scene, dataset) -> None:
    with scene.association() as association:
        assert association.send_c_echo().Status == 0
        for seed in range(3):
            assert association.send_c_store(dataset(seed)).Status == 0
            entries = scene.case.entries()
            assert len(entries) == seed + 1
            kept = read_image(scene.case.original(entries[-1].content["original"]))
            np.testing.assert_array_equal(kept.pixels, dataset(seed).pixel_array)
        assert association.send_c_store(dataset(0)).Status == 0
    assert scene.store(dataset(1)) == 0
    assert len(scene.case.entries()) == 3
    assert [news.kind for news in scene.news] == ["kept"] * 3 + ["already"] * 2
    assert "Doe" not in repr([news.text for news in scene.news])


def test_an_archive_that_sends_again_under_another_header_loses_nothing_and_makes_no_new_exposure(
    scene: Scene, dataset
) -> None:
    """The same instance with a corrected name: both files are kept, and the second says whose pixels it has."""
    first, again, other = dataset(5), dataset(5), dataset(6)
    again.PatientName, other.SOPInstanceUID = "Roe^Richard", first.SOPInstanceUID  # the last is against the standard
    assert [scene.store(one) for one in (first, again, other)] == [0, 0, 0]
    entries = scene.case.entries()
    assert len({entry.content["original"] for entry in entries}) == 3
    said = [entry.settings["acquisition"].get("same_pixels_as") for entry in entries]
    assert said == [None, entries[0].number, None]
    assert "its pixels are those of entry 1, so it is not a new exposure" in scene.news[1].text
    plan = scene.case.record(Kind.PLANNED, {}, by=Actor.SURGEON)
    assert len(exposures_of_case(scene.case, plan)) == 2


def test_what_could_not_be_decoded_is_not_negotiated(scene: Scene) -> None:
    """JPEG Extended at 12 bits: accepted and then refused, the sender's image would be lost."""
    ae = AE(ae_title="CARM")
    ae.add_requested_context(XRayAngiographicImageStorage, JPEGExtended12Bit)
    ae.add_requested_context(SecondaryCaptureImageStorage, [JPEGExtended12Bit, JPEGLosslessSV1])
    association = ae.associate("127.0.0.1", scene.receiver.port, ae_title="SIGHTLINE")
    try:
        (accepted,), (rejected,) = association.accepted_contexts, association.rejected_contexts
        assert accepted.transfer_syntax == [JPEGLosslessSV1]
        assert rejected.abstract_syntax == XRayAngiographicImageStorage
    finally:
        association.release()


def test_who_is_not_known_is_rejected_and_told_of(scene: Scene) -> None:
    for title, called in (("STRANGER", "SIGHTLINE"), ("CARM", "OTHER")):
        with scene.association(title, called) as association:
            assert association.is_rejected
    assert scene.told("not that of a known peer")
    assert scene.told("another AE title than ours")
    assert "STRANGER" not in repr([news.text for news in scene.news])


def test_an_unknown_address_is_not_even_read(tmp_path: Path) -> None:
    news: list[News] = []
    with Case.create(tmp_path / "case") as case:
        elsewhere = Peer("CARM", frozenset({"192.0.2.7"}))
        with DicomReceiver([elsewhere], port=0) as receiver, receiver.receiving(Acquirer(case), news.append):
            scene = Scene(receiver, case, news)
            assert scene.raw(b"\x01") == b""
            assert scene.told("not the address of a known peer")


def test_a_full_disk_is_answered_so_and_loses_nothing(scene: Scene, dataset, monkeypatch) -> None:
    assert scene.store(dataset(0)) == 0

    def full(*_: object, **__: object) -> None:
        raise CaseError("the disk is full")

    for step in ("keep", "record"):
        with monkeypatch.context() as patch:
            patch.setattr(scene.case, step, full)
            assert scene.store(dataset(1)) == 0xA700
    assert len(scene.case.entries()) == 1
    assert scene.store(dataset(1)) == 0
    assert len(scene.case.entries()) == 2
    assert scene.case.check() and all(check.passed for check in scene.case.check())


def test_what_is_no_image_is_refused_and_nothing_of_it_is_kept(scene: Scene, dataset) -> None:
    for spoil in ({"Rows": 65535}, {"BitsStored": 3}, {"PixelData": b"\0\0"}, {"NumberOfFrames": "9"}):
        bad = dataset(5)
        for keyword, value in spoil.items():
            setattr(bad, keyword, value)
        assert scene.store(bad) == 0xC000, spoil
    assert scene.case.entries() == []
    assert list((scene.case.folder / "originals").iterdir()) == []
    assert scene.store(dataset(0)) == 0


def test_whatever_a_peer_sends_the_next_image_is_received(scene: Scene, dataset) -> None:
    rng = np.random.default_rng(3)
    hostile = [
        b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n",
        struct.pack(">BxI", 1, 0xFFFFFFFF) + b"x" * 100,
        struct.pack(">BxI", 4, 20) + b"\xff" * 20,
        struct.pack(">BxI", 1, 68) + b"\0" * 68,
        *(struct.pack(">BxI", int(kind), 60) + rng.bytes(60) for kind in rng.integers(0, 9, 8)),
        *(rng.bytes(200) for _ in range(4)),
    ]
    for k, data in enumerate(hostile):
        with socket.create_connection(("127.0.0.1", scene.receiver.port)) as peer:
            peer.sendall(data)
        if k % 8 == 0:
            assert scene.store(dataset(k)) == 0
    assert scene.told("too large")
    assert scene.store(dataset(100)) == 0


def test_a_sender_that_vanishes_in_the_middle_leaves_no_half_image(scene: Scene, dataset) -> None:
    with scene.association() as association:
        socket_ = association.dul.socket
        assert socket_ is not None and socket_.socket is not None
        send = socket_.socket.sendall
        command = struct.pack(">IBB", 100, 1, 0) + b"d" * 98
        send(struct.pack(">BxI", 4, len(command)) + command)
        association.abort()
    assert scene.store(dataset(0)) == 0
    assert len(scene.case.entries()) == 1
    assert len(list((scene.case.folder / "originals").iterdir())) == 1


def test_an_image_that_never_ends_fills_no_memory(scene: Scene, dataset) -> None:
    """40 MB of one image are sent where 256 KiB are allowed."""
    fragment = struct.pack(">IBB", 20002, 1, 0) + bytes(20000)  # of data, not the last
    piece = struct.pack(">BxI", 4, len(fragment)) + fragment
    tracemalloc.start()
    try:
        with scene.association() as association:
            held = association.dul.socket
            assert held is not None
            assert held.socket is not None
            with pytest.raises(OSError):
                for _ in range(2000):
                    held.socket.sendall(piece)
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak < 20 * LIMITS.message_bytes  # pieces on their way, and this side's
    assert scene.told("too large")
    assert scene.store(dataset(0)) == 0


@pytest.mark.slow
def test_a_peer_that_never_ends_its_association_is_let_go(scene: Scene, dataset) -> None:
    with scene.association() as idle:
        end = time.monotonic() + 20.0
        while idle.is_established and time.monotonic() < end:
            time.sleep(0.05)
        assert not idle.is_established
    assert scene.store(dataset(0)) == 0


def test_what_cannot_work_is_refused(scene: Scene) -> None:
    with pytest.raises(UnusableInputError, match="at least one peer"):
        DicomReceiver([])
    with pytest.raises(UnusableInputError, match="AE title"):
        DicomReceiver([PEER], aet="much too long for a title")
    for text in ("CARM", "@host", "a\\b@127.0.0.1", "CARM@", "CARM@no.such.host.invalid"):
        with pytest.raises(UnusableInputError):
            Peer.parse(text)
    receiver = DicomReceiver([PEER], port=scene.receiver.port)
    with pytest.raises(LinkError, match="cannot listen"), receiver:
        pass
