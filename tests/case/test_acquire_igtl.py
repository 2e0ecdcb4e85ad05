"""Images over OpenIGTLink: peers that call and are called, and what of their messages is no image."""

import socket
import time
from collections.abc import Iterator
from threading import Thread

import numpy as np
import pytest

from sightline.case.acquire import Acquirer
from sightline.case.acquire.acquirer import take_frames
from sightline.case.acquire.igtl import ImageLink, radiograph_of
from sightline.case.acquire.robot import PoseNow, RobotWatch
from sightline.case.journal import Case
from sightline.case.stages import image_of
from sightline.errors import ImageError, LinkError, SourceError
from sightline.imaging import Radiograph, SourceFrame
from sightline.robot.igtl import Image, Message, NDArray, String, encode, timestamp_of
from sightline.robot.kinematics.target import FRESH_S

SENT_S = 1_700_000_000.25


def pixels(kind: type = np.uint16, seed: int = 1) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 100, (40, 50)).astype(kind)


def sent(values: np.ndarray, **options: object) -> bytes:
    body = Image(values[None], np.diag([0.2, 0.2, 1.0, 1.0]), **options)  # pyright: ignore[reportArgumentType]
    return encode(Message(body, "Doe^Jane", timestamp_of(SENT_S)))


def served(data: list[bytes]) -> int:
    """A peer that sends to whoever calls, one piece to each, and hangs up; its port."""
    server = socket.create_server(("127.0.0.1", 0))

    def run() -> None:
        with server:
            for piece in data:
                peer, _ = server.accept()
                with peer:
                    peer.sendall(piece)

    Thread(target=run, daemon=True).start()
    return server.getsockname()[1]


@pytest.mark.parametrize("kind", [np.uint8, np.uint16, np.int8, np.int16, np.int32, np.uint32, np.float32, np.float64])
def test_every_scalar_type_becomes_an_image(kind: type) -> None:
    values = pixels(kind)
    image = radiograph_of(Image(values[None], np.eye(4)))
    np.testing.assert_array_equal(image.pixels, values)
    assert image.white >= values.max()
    if np.issubdtype(kind, np.signedinteger) and kind is not np.int32:
        lowest = np.iinfo(kind).min
        below = radiograph_of(Image(values[None] + kind(lowest), np.eye(4)))
        np.testing.assert_array_equal(below.pixels, values)
        with pytest.raises(ImageError, match="negative"):
            radiograph_of(Image(values[None] - kind(50), np.eye(4)))


def test_what_is_no_single_image_is_refused() -> None:
    part = Image(pixels()[None], np.eye(4), size=(100, 100, 1), offset=(3, 0, 0))
    colour = np.stack([pixels(), pixels(seed=2), pixels(seed=3)], axis=-1)
    for image, why in (
        (part, "part of an image"),
        (Image(np.stack([pixels()] * 2), np.eye(4)), "volume of 2"),
        (Image(colour[None], np.eye(4)), "colour"),
        (Image(np.full((1, 40, 50), 2**24 + 1, np.int32), np.eye(4)), "do not fit"),
        (Image(np.full((1, 40, 50), np.nan, np.float32), np.eye(4)), "do not fit"),
        (Image(np.zeros((1, 4, 50), np.uint8), np.eye(4)), "at least 16"),
    ):
        with pytest.raises(ImageError, match=why):
            radiograph_of(image)
    same = np.repeat(pixels()[..., None], 3, axis=-1)
    np.testing.assert_array_equal(radiograph_of(Image(same[None], np.eye(4))).pixels, pixels())


def test_a_peer_is_called_and_called_again_and_the_rest_is_passed_over() -> None:
    said: list[str] = []
    other = encode(Message(String("hello"), "x"))
    broken = bytearray(sent(pixels()))
    broken[-1] ^= 1
    part = sent(pixels(), size=(100, 100, 1))
    link = ImageLink(
        "127.0.0.1", served([other + bytes(broken) + part + sent(pixels()), sent(pixels(seed=2))]), tell=said.append
    )
    frames = iter(link)
    first, second = next(frames), next(frames)
    np.testing.assert_array_equal(first.image.pixels, pixels())
    np.testing.assert_array_equal(second.image.pixels, pixels(seed=2))
    assert (first.number, second.number) == (1, 2)
    assert first.sender_s == pytest.approx(SENT_S, abs=1e-6)
    assert first.stamped_s == pytest.approx(time.time(), abs=60)
    np.testing.assert_allclose(link.stated()["stated_matrix"], np.diag([0.2, 0.2, 1.0, 1.0]))
    assert any("wrong CRC" in text for text in said)
    assert any("part of an image" in text for text in said)
    assert any("disconnected" in text for text in said)
    assert "Doe" not in " ".join(said)
    link.close()


def test_a_peer_is_waited_for_and_rubbish_only_ends_its_own_connection() -> None:
    said: list[str] = []
    link = ImageLink("127.0.0.1", 0, listen=True, tell=said.append)

    def call() -> None:
        for data in (b"GET / HTTP/1.1\r\n" * 9, sent(pixels())[:200], sent(pixels())):
            with socket.create_connection(("127.0.0.1", link.port)) as peer:
                peer.sendall(data)

    Thread(target=call, daemon=True).start()
    np.testing.assert_array_equal(next(iter(link)).image.pixels, pixels())
    assert any("no header" in text for text in said)
    with pytest.raises(LinkError, match="cannot listen"):
        ImageLink("127.0.0.1", link.port, listen=True)
    link.close()


def test_silence_is_given_up() -> None:
    with socket.create_server(("127.0.0.1", 0)) as mute:
        silent = ImageLink("127.0.0.1", mute.getsockname()[1], silence_s=0.3)
        with pytest.raises(SourceError, match="sent no image"):
            next(iter(silent))
        port = mute.getsockname()[1]
    with pytest.raises(SourceError, match="no OpenIGTLink peer"):
        next(iter(ImageLink("127.0.0.1", port, silence_s=0.2)))


class Robot:
    """What RobotWatch uses of a RobotClient: its joints, until it is lost."""

    def __init__(self, *_: object, **__: object) -> None:
        self.left = 3

    def stream(self, name: str, timeout_s: float) -> Message:
        time.sleep(0.01)
        if self.left == 0:
            raise LinkError("lost")
        self.left -= 1
        return Message(NDArray(np.arange(30.0).reshape(6, 5)), name)

    def close(self) -> None:
        pass


@pytest.fixture
def case(tmp_path) -> Iterator[Case]:
    with Case.create(tmp_path / "case") as case:
        yield case


def test_the_robots_pose_comes_with_the_image_and_a_stale_one_does_not(case: Case, monkeypatch) -> None:
    monkeypatch.setattr("sightline.case.acquire.robot.RobotClient", Robot)
    monkeypatch.setattr("sightline.case.acquire.robot._RETRY_S", 60.0)
    with RobotWatch("127.0.0.1", 1) as watch:
        while (fresh := watch.now()).joints is None:
            time.sleep(0.005)
        assert fresh.check.passed and fresh.joints == (0.0, 1.0, 2.0, 3.0, 4.0)
        while (stale := watch.now()).check.passed:
            time.sleep(0.02)
    assert stale.age_s is not None and stale.age_s > FRESH_S
    for pose in (stale, PoseNow(None, None)):
        assert not pose.check.passed and "pose stale" in pose.check.sentence
        assert pose.document()["joints"] is None
    acquirer = Acquirer(case)
    for seed, pose, joints in ((1, fresh, [0.0, 1.0, 2.0, 3.0, 4.0]), (2, stale, None)):
        frame = SourceFrame(Radiograph(pixels(seed=seed), 65535.0), 1, SENT_S, "openigtlink", SENT_S - 1)
        entry = take_frames(acquirer, [frame], pose=pose, how={"stated_matrix": np.eye(4)}).entry
        acquisition = entry.settings["acquisition"]
        assert acquisition["robot"]["joints"] == joints
        assert acquisition["sender_s"] == SENT_S - 1
        assert acquisition["stated_matrix"][0] == [1.0, 0.0, 0.0, 0.0]
        np.testing.assert_array_equal(image_of(case, entry).pixels, pixels(seed=seed))


def test_floats_are_kept_as_they_are(case: Case) -> None:
    values = pixels(np.float32) + np.float32(0.25)
    frame = SourceFrame(radiograph_of(Image(values[None], np.eye(4))), 1, SENT_S, "openigtlink")
    entry = take_frames(Acquirer(case), [frame]).entry
    assert entry.content["original"].endswith(".npy")
    np.testing.assert_array_equal(image_of(case, entry).pixels, values)
