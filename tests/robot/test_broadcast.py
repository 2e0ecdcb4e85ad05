"""One program, several readers: pyigtl beside one that never reads, what is sent again, what is refused."""

import socket
import struct
from collections.abc import Iterator
from contextlib import closing
from typing import Any

import numpy as np
import pyigtl
import pytest

from sightline.errors import LinkError, UnusableInputError
from sightline.robot.igtl import Event, Image, Message, Status, String, Transform
from sightline.robot.igtl.wire import HEADER_BYTES
from sightline.robot.transport import BlockingClient, broadcast
from sightline.robot.transport.broadcast import MAX_QUERY_BYTES, Broadcast, port_of
from sightline.robot.transport.connection import Outbox

PATIENCE_S = 20.0  # a test that waits longer has failed
MATRIX = np.array([[0.0, -0.4, 0.0, 12.5], [0.4, 0.0, 0.0, -3.25], [0.0, 0.0, 1.0, 100.0], [0.0, 0.0, 0.0, 1.0]])
SIDE = 1500  # an image of 4.5 MB: two are more than the kernel holds for a reader
UNCHANGED = Message(String("GO"), "verdict")


class Counting:
    """Snapshots that count: a new image and pose each time, and an unchanged text."""

    def __init__(self) -> None:
        self.made = 0

    def __call__(self) -> list[Message]:
        self.made += 1
        pixels = np.full((1, SIDE, SIDE), self.made % 60000, np.uint16)
        pose = np.array(MATRIX)
        pose[0, 3] = self.made
        unit = MATRIX.copy()
        unit[:3, 3] = 0.0
        return [
            Message(Image(pixels, unit), "pa", version=2, metadata={"units": "mm"}),
            Message(Transform(pose), "pa-to-cfcs", version=2, metadata={"units": "mm"}),
            Message(Status(13, "MOVED", "stop"), "status"),
            UNCHANGED,
        ]


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(broadcast, "PERIOD_S", 0.001)


@pytest.fixture
def server(quick) -> Iterator[Broadcast]:
    with Broadcast(Counting(), 0) as served:
        yield served


@pytest.fixture
def mute(server: Broadcast) -> Iterator[socket.socket]:
    """A reader that never reads."""
    with socket.create_connection(("127.0.0.1", server.port)) as silent:
        yield silent


def heard(client: BlockingClient) -> Event:
    event = client.receive(PATIENCE_S)
    assert event is not None
    return event


def test_a_reader_that_never_reads_delays_no_other(server: Broadcast, mute: socket.socket) -> None:
    """One that waits for it stands still; one that keeps all its images fills the memory."""
    with BlockingClient(port=server.port) as fast:
        heard(fast)
        (slow,) = [reader for reader in server._sent if reader.peer.endswith(f":{mute.getsockname()[1]}")]
        numbers: list[int] = []
        while len(numbers) < 10:
            event = heard(fast)
            assert isinstance(event, Message)
            if isinstance(event.body, Image):
                numbers.append(int(event.body.pixels[0, 0, 0]))
        assert numbers == sorted(set(numbers))
        assert slow.dropped > 10
        assert len(slow._outbox) <= 4  # one of each name


def test_pyigtl_reads_image_pose_and_text(server: Broadcast) -> None:
    client: Any = pyigtl.OpenIGTLinkClient(port=server.port)
    with closing(server):
        image, pose, text = (client.wait_for_message(n, PATIENCE_S) for n in ("pa", "pa-to-cfcs", "verdict"))
    client.stop()
    assert image.image.shape == (1, SIDE, SIDE)
    assert image.image.dtype == np.uint16
    assert np.ptp(image.image) == 0
    assert image.metadata == {"units": "mm"}
    # The wire has the centre, here the origin; pyigtl states the first pixel.
    first = -MATRIX[:3, :3] @ [(SIDE - 1) / 2, (SIDE - 1) / 2, 0.0]
    np.testing.assert_allclose(image.ijk_to_world_matrix[:3, 3], first, atol=1e-3)
    np.testing.assert_array_equal(pose.matrix[:, :3], MATRIX.astype(np.float32)[:, :3])
    assert pose.matrix[0, 3] >= 1
    assert text.string == "GO"


def test_a_message_is_sent_again_only_if_it_is_another(server: Broadcast) -> None:
    """And a reader that comes later is sent it too."""
    for _ in range(2):
        with BlockingClient(port=server.port) as reader:
            names = [heard(reader).device_name for _ in range(40)]
            assert names.count("verdict") == 1
            assert names.count("status") > 5


@pytest.mark.parametrize(
    "said",
    [b"GET / HTTP/1.1\r\n" * 4, struct.pack(">H12s20sQQQ", 1, b"STRING", b"", 0, MAX_QUERY_BYTES + 1, 0)],
    ids=["other bytes", "a large message"],
)
def test_a_reader_that_sends_rubbish_is_let_go_alone(server: Broadcast, said: bytes) -> None:
    assert len(said) >= HEADER_BYTES
    with BlockingClient(port=server.port) as good, BlockingClient(port=server.port) as bad:
        heard(bad)
        bad.send_bytes(said)
        with pytest.raises(LinkError):
            while True:
                heard(bad)
        good.send(Message(String("hello")))
        for _ in range(20):
            assert isinstance(heard(good), Message)


def test_without_readers_nothing_is_made(quick) -> None:
    counting = Counting()
    with Broadcast(counting, 0) as served:
        with BlockingClient(port=served.port) as reader:
            heard(reader)
        assert counting.made
    before = counting.made
    with Broadcast(counting, 0):
        pass
    assert counting.made == before


def test_a_port_in_use_is_refused(server: Broadcast) -> None:
    with pytest.raises(LinkError, match="choose another port"):
        Broadcast(list, server.port)


@pytest.mark.parametrize("address", ["", "igtl", "igtl:", "igtl:-1", "igtl:65536", "ros2:/sightline", "igtl:0.0.0.0:1"])
def test_other_addresses_are_refused(address: str) -> None:
    with pytest.raises(UnusableInputError, match="igtl:PORT"):
        port_of(address)


def test_the_address_gives_the_port() -> None:
    assert [port_of(address) for address in ("igtl:0", "igtl:18944", "igtl:65535")] == [0, 18944, 65535]


def test_only_the_newest_of_each_name_waits() -> None:
    box = Outbox()
    for k in range(3):
        box.put_newest("image", b"image %d" % k)
        box.put_newest("pose", b"pose %d" % k)
    box.put_answer(b"answer")
    assert [box.take() for _ in range(len(box))] == [b"answer", b"image 2", b"pose 2"]
    assert box.dropped == 4
    with pytest.raises(KeyError):
        box.take()
