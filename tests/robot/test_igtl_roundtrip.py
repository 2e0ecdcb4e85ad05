"""What was sent is what arrives, for any message, in pieces of any size; what cannot be sent is refused."""

from dataclasses import fields, is_dataclass, replace

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import RigidTransform, Rotation
from tests.robot.igtl_strategies import BODIES, messages

from sightline.errors import MessageError
from sightline.robot.igtl import (
    LONG_NAME,
    MILLIMETRE,
    NEWTON,
    Capability,
    Get,
    Image,
    Message,
    NDArray,
    Point,
    Points,
    Sensor,
    Start,
    Status,
    Stream,
    String,
    Transform,
    encode,
    timestamp_of,
)
from sightline.robot.igtl.wire import Reader

quick = settings(max_examples=20, deadline=None, suppress_health_check=[HealthCheck.too_slow])


def same(one: object, other: object) -> bool:
    """Equal in every field, NaN equal to itself, arrays of one type."""
    if isinstance(one, np.ndarray) and isinstance(other, np.ndarray):
        same_type = one.dtype.newbyteorder("=") == other.dtype.newbyteorder("=")
        return same_type and one.shape == other.shape and np.array_equal(one, other, equal_nan=True)
    if isinstance(one, float) and isinstance(other, float):
        return one == other or (np.isnan(one) and np.isnan(other))
    if isinstance(one, tuple) and isinstance(other, tuple):
        return len(one) == len(other) and all(map(same, one, other))
    if is_dataclass(one):
        return type(one) is type(other) and all(same(getattr(one, f.name), getattr(other, f.name)) for f in fields(one))
    return bool(one == other)


def through(message: Message) -> Message:
    (event,) = Stream().feed(encode(message))
    assert isinstance(event, Message), event
    return event


@pytest.mark.parametrize("kind", BODIES, ids=lambda kind: kind.__name__)
def test_every_type_comes_back(kind: type) -> None:
    @quick
    @given(messages(BODIES[kind]))
    def check(message: Message) -> None:
        back = through(message)
        assert type(back.body) is kind
        assert same(back, message)
        assert encode(back) == encode(message)

    check()


@quick
@given(st.lists(messages(st.one_of(*BODIES.values())), max_size=5), st.randoms(use_true_random=False))
def test_pieces_of_any_size_make_the_same_messages(sent: list[Message], random: object) -> None:
    data, stream, came = b"".join(map(encode, sent)), Stream(), []
    while data:
        cut = random.choice([1, 2, 57, 58, 59, random.randrange(1, len(data) + 1)])
        came += stream.feed(data[:cut])
        data = data[cut:]
    assert not stream.partial
    assert same(tuple(came), tuple(sent))


def test_arrays_that_came_cannot_be_written() -> None:
    sent = np.zeros((2, 3))
    message = NDArray(sent)
    sent[0, 0] = 1
    assert message.values[0, 0] == 0
    for array in (message.values, through(Message(message)).body.values, Transform(np.eye(4)).matrix):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 1


def test_a_pose_goes_through_within_the_wire_s_bits() -> None:
    pose = RigidTransform.from_components(np.array([412.3456, -71.25, 155.0]), Rotation.from_rotvec([0.3, -1.2, 0.7]))
    back = through(Message(Transform.of(pose))).body
    assert back.fault is None
    off = back.rigid().inv() * pose
    assert np.linalg.norm(off.translation) < 5e-5
    assert off.rotation.magnitude() < 1e-6


def altered(row: int, column: int, value: float) -> np.ndarray:
    matrix = np.eye(4)
    matrix[row, column] = value
    return matrix


@pytest.mark.parametrize(
    ("matrix", "word"),
    [
        (altered(0, 3, np.nan), "finite"),
        (altered(1, 1, np.inf), "finite"),
        (np.diag([1.001, 1.001, 1.001, 1]), "not orthonormal"),
        (np.diag([0.0, 0, 0, 1]), "not orthonormal"),
        (altered(0, 1, 0.001), "not orthonormal"),
        (altered(0, 0, -1), "left-handed"),
    ],
)
def test_what_is_no_rigid_motion_is_kept_and_told(matrix: np.ndarray, word: str) -> None:
    body = through(Message(Transform(matrix))).body
    np.testing.assert_allclose(body.matrix, matrix, rtol=1e-6)
    assert body.fault is not None
    assert word in body.fault
    with pytest.raises(MessageError, match=word):
        body.rigid()


def test_a_name_that_plus_cut_is_read_in_full() -> None:
    full = "CalibrationFrameToManipulator"
    message = Message(Transform(np.eye(4)), full[:20], version=2, metadata={LONG_NAME: full})
    assert through(message).name == full
    assert replace(message, metadata={LONG_NAME: "OtherToOther"}).name == full[:20]
    assert replace(message, metadata={}).name == full[:20]


def test_times_are_seconds() -> None:
    message = through(Message(String("now"), timestamp=timestamp_of(1_700_000_000.123456)))
    assert message.time_s == pytest.approx(1_700_000_000.123456, abs=1e-6)
    assert Message(String("never")).time_s is None
    for wrong in (-1.0, 2.0**32, float("nan")):
        with pytest.raises(MessageError, match="1970"):
            timestamp_of(wrong)


def test_units_are_those_of_the_protocol() -> None:
    # 4 bits of prefix, then 6 of unit and 4 of exponent: milli is 0xB, metre 1, newton 0x0B.
    assert int("1011" + "000001" + "0001" + "0" * 50, 2) == MILLIMETRE
    assert int("0000" + "001011" + "0001" + "0" * 50, 2) == NEWTON


def test_an_image_may_be_a_part_and_of_either_byte_order() -> None:
    pixels = np.arange(24, dtype=">u2").reshape(2, 3, 4)
    image = Image(pixels, np.eye(4), "LPS", (10, 10, 10), (6, 7, 8))
    wire = bytearray(image.content())
    wire[4] = 1  # highest byte first
    wire[72:] = pixels.tobytes()
    for read in (Image.read(Reader(bytes(wire))), Image.read(Reader(image.content()))):
        np.testing.assert_array_equal(read.pixels, pixels)
        assert (read.size, read.offset, read.coordinates) == ((10, 10, 10), (6, 7, 8), "LPS")


BAD = {
    "name too long": lambda: encode(Message(String("a"), "a" * 21)),
    "name not ASCII": lambda: encode(Message(String("a"), "Hüfte")),
    "name with a zero": lambda: encode(Message(String("a"), "a\0b")),
    "time": lambda: encode(Message(String("a"), timestamp=2**64)),
    "version 3": lambda: encode(Message(String("a"), version=3)),
    "metadata in version 1": lambda: encode(Message(String("a"), metadata={"side": "left"})),
    "message id in version 1": lambda: encode(Message(String("a"), message_id=1)),
    "message id": lambda: encode(Message(String("a"), version=2, message_id=2**32)),
    "string too long": lambda: encode(Message(String("a" * 65536))),
    "lone surrogate": lambda: encode(Message(String("\ud800"))),
    "status with a zero": lambda: encode(Message(Status(1, "", "a\0b"))),
    "status code": lambda: encode(Message(Status(65536))),
    "too large for 32 bits": lambda: encode(Message(Transform(np.diag([1, 1, 1e39, 1])))),
    "shape": lambda: Transform(np.eye(3)),
    "last row": lambda: Transform(np.ones((4, 4))),
    "colour": lambda: encode(Message(Points((Point("p", np.zeros(3), rgba=(256, 0, 0, 0)),)))),
    "sensor too long": lambda: encode(Message(Sensor(np.zeros(256)))),
    "type too long": lambda: encode(Message(Capability(("GET_TRANSFORM",)))),
    "type of numbers": lambda: NDArray(np.array(["a"])),
    "64-bit integers": lambda: NDArray(np.arange(3)),
    "array too long": lambda: encode(Message(NDArray(np.zeros(65536, dtype=np.uint8)))),
    "complex image": lambda: Image(np.zeros((1, 2, 2), complex), np.eye(4)),
    "flat image": lambda: Image(np.zeros((2, 2)), np.eye(4)),
    "part beyond": lambda: Image(np.zeros((1, 2, 2)), np.eye(4), size=(2, 2, 1), offset=(1, 0, 0)),
    "coordinates": lambda: Image(np.zeros((1, 2, 2)), np.eye(4), "CFCS"),
    "query of a command": lambda: encode(Message(Get("COMMAND"))),
    "interval of transforms": lambda: encode(Message(Start("TRANSFORM", 5))),
}  # fmt: skip


@pytest.mark.parametrize("name", BAD)
def test_what_cannot_be_written_is_refused(name: str) -> None:
    with pytest.raises(MessageError):
        BAD[name]()
