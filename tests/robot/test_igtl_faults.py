"""Malformed bytes: no crash, no wrong message accepted, and a reason given. The benchmark runs 500 of each."""

import numpy as np
import pytest
from fastcrc.crc64 import ecma_182
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from tests.robot.igtl_faults import FAULTS
from tests.robot.igtl_strategies import BODIES, messages

from sightline.errors import MessageError
from sightline.robot.igtl import Event, Fault, Header, Message, NDArray, Rejected, Stream, String, encode

SEEDS = 30


@pytest.mark.parametrize("name", FAULTS)
def test_faults_do_no_harm(name: str) -> None:
    for seed in range(SEEDS):
        assert FAULTS[name](np.random.default_rng(seed)), f"seed {seed}"


def wire(type_name: str, body: bytes, version: int = 1, name: str = "D") -> bytes:
    return Header(version, type_name, name, 0, len(body), ecma_182(body)).encode() + body


def told(data: bytes) -> Rejected:
    (event,) = Stream().feed(data)
    assert isinstance(event, Rejected)
    return event


@settings(max_examples=30, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(messages(st.one_of(*BODIES.values())), st.data())
def test_a_body_with_a_right_crc_but_wrong_bytes_never_crashes(message: Message, data: st.DataObject) -> None:
    """A peer whose program is wrong: the CRC is that of the bytes, and the bytes are nonsense."""
    body = bytearray(encode(message)[58:])
    for _ in range(data.draw(st.integers(1, 3))):
        if body:
            body[data.draw(st.integers(0, min(len(body), 200) - 1))] = data.draw(st.integers(0, 255))
    cut = data.draw(st.integers(0, len(body)))
    body = body if data.draw(st.booleans()) else body[:cut]
    (event,) = Stream().feed(wire(message.type_name, bytes(body), message.version))
    assert isinstance(event, Message) or event.fault is Fault.BAD_BODY
    if isinstance(event, Message):
        encode(event)  # what was taken can be written again


@pytest.mark.parametrize(
    ("type_name", "body", "words"),
    [
        ("TRANSFORM", bytes(47), "ends 1 bytes too early"),
        ("TRANSFORM", bytes(49), "1 bytes too long"),
        ("POSITION", bytes(24), "too early"),
        ("STATUS", bytes(29), "too early"),
        ("STATUS", bytes(30) + b"a\0b", "zero byte"),
        ("STRING", b"\0\3\0\5four", "too early"),
        ("STRING", b"\0\3\0\3four", "too long"),
        ("STRING", b"\0\4\0\4four", "encoding 4"),
        ("STRING", b"\0\3\0\1\xff", "not UTF-8"),
        ("COMMAND", b"", "too early"),
        ("SENSOR", b"\2" + bytes(17), "too early"),
        ("NDARRAY", b"\x09\1\0\0", "unknown type, 9"),
        ("NDARRAY", b"\x03\0", "0 dimensions"),
        ("NDARRAY", b"\x03\xff" + bytes(510), "255 dimensions"),
        ("NDARRAY", b"\x0b\4" + b"\xff" * 8, "too early"),
        ("IMAGE", bytes(72), "not all of these are known"),
        ("CAPABILITY", b"STATUS", "too early"),
        ("GET_TRANS", b"x", "too long"),
        ("STT_SENSOR", b"x", "too early"),
        ("RTS_IMAGE", b"", "too early"),
    ],
)  # fmt: skip
def test_the_reason_is_told(type_name: str, body: bytes, words: str) -> None:
    event = told(wire(type_name, body))
    assert event.fault is Fault.BAD_BODY
    assert words in event.reason
    assert not event.fatal
    assert event.header.device_name == "D"


@pytest.mark.parametrize(
    ("body", "words"),
    [
        (bytes(11), "too early"),
        (b"\0\x0b" + bytes(10), "extended header claims 11"),
        (b"\xff\xff" + bytes(10), "too early"),
        (b"\0\x0c\0\2\xff\xff\xff\xff" + bytes(6), "too early"),
        (b"\0\x0c\0\2\0\0\0\0\0\0\0\0" + b"\0\3\0\1a" + b"\0\1", "too early"),
        (b"\0\x0c\0\2\0\0\0\4\0\0\0\0" + b"\0\3\0\1a" + b"\0\0" + b"rest", "too long"),
        (b"\0\x0c\0\x12\0\0\0\4\0\0\0\0\0\3\0\1a\0\2" + b"\0\1\0\3\0\0\0\1" * 2 + b"abac", "'a' twice"),
        (b"\0\x0c\0\x0a\0\0\0\2\0\0\0\0\0\3\0\1a\0\1" + b"\0\1\0\7\0\0\0\1" + b"ab", "encoding 7"),
    ],
)
def test_metadata_that_do_not_agree_are_refused(body: bytes, words: str) -> None:
    event = told(wire("STRING", body, version=2))
    assert event.fault is Fault.BAD_BODY
    assert words in event.reason


def test_room_for_later_versions_in_the_extended_header_is_skipped() -> None:
    body = b"\0\x10\0\0\0\0\0\0\0\0\0\5later"[:14] + b"xx" + b"\0\3\0\1a"
    (event,) = Stream().feed(wire("STRING", body, version=2))
    assert (event.body, event.message_id, dict(event.metadata)) == (String("a"), 5, {})


def test_a_name_that_is_not_ascii_costs_one_message_and_not_the_stream() -> None:
    data = bytearray(encode(Message(String("a"), "Hxfte")))
    data[15] = 0xFC
    first, second = Stream().feed(bytes(data) + encode(Message(String("b"))))
    assert "not ASCII" in first.reason
    assert not first.fatal
    assert isinstance(second, Message)


@pytest.mark.parametrize(
    ("at", "value", "fault"),
    [(1, 3, Fault.NO_HEADER), (0, 1, Fault.NO_HEADER), (2, 0, Fault.NO_HEADER), (9, 65, Fault.NO_HEADER),
     (3, 10, Fault.NO_HEADER), (42, 1, Fault.TOO_LARGE)],
)  # fmt: skip
def test_after_a_header_that_is_none_nothing_is_read(at: int, value: int, fault: Fault) -> None:
    data = bytearray(encode(Message(String("stop"))))
    data[at] = value
    stream = Stream()
    events: list[Event] = stream.feed(bytes(data) + encode(Message(String("go on"))))
    assert [event.fault for event in events if isinstance(event, Rejected)] == [fault]
    assert len(events) == 1
    assert not stream.partial
    with pytest.raises(MessageError, match="close the connection"):
        stream.feed(encode(Message(String("go on"))))


def test_a_message_inside_another_is_not_obeyed_when_a_size_is_wrong() -> None:
    inner = encode(Message(String("MOVE_TO_TARGET"), "CMD_1"))
    outer = encode(Message(NDArray(np.frombuffer(inner, np.uint8))))
    (event,) = Stream().feed(outer)
    assert isinstance(event, Message)
    shorter = outer[:42] + (3).to_bytes(8, "big") + outer[50:]
    crc, header = Stream().feed(shorter)
    assert (crc.fault, header.fault) == (Fault.WRONG_CRC, Fault.NO_HEADER)


def test_a_signalling_nan_is_a_nan() -> None:
    (event,) = Stream().feed(wire("TRANSFORM", b"\x7f\xa0\0\1" * 12))
    assert event.body.fault == "it holds numbers that are not finite"
    assert Stream().feed(encode(event))


def test_the_limit_is_the_largest_body_that_is_read() -> None:
    message = Message(String("a" * 96))
    assert len(Stream(max_body_bytes=100).feed(encode(message))) == 1
    (event,) = Stream(max_body_bytes=99).feed(encode(message)[:58])
    assert event.fault is Fault.TOO_LARGE
    assert "100 bytes announced; at most 99" in event.reason
