"""Faults of a link, one function each: they alter bytes that were good. Shared with the benchmark."""

import numpy as np

from sightline.robot.igtl import Event, Fault, Image, Message, Rejected, Status, Stream, String, Transform, encode
from sightline.robot.igtl.wire import HEADER_BYTES

SIZE_AT = slice(42, 50)
TYPE_AT = slice(2, 14)


def good(rng: np.random.Generator) -> list[Message]:
    """Three messages as a robot hears them, of either version."""
    side = {"version": 2, "message_id": 7, "metadata": {"side": "left", "frame": "gamma 3"}}
    bodies = [
        Transform(np.vstack([rng.normal(0, 100, (3, 4)), (0, 0, 0, 1)])),
        Status(int(rng.integers(1, 20)), "TARGETING", "not ready"),
        String("MOVE_TO_TARGET"),
        Image(rng.integers(0, 255, (1, 30, 40), dtype=np.uint8), np.eye(4)),
    ]
    chosen = [bodies[k] for k in rng.integers(0, len(bodies), 3)]
    return [Message(body, f"TGT_{k}", k + 1, **(side if rng.random() < 0.5 else {})) for k, body in enumerate(chosen)]


def in_pieces(data: bytes, rng: np.random.Generator) -> list[Event]:
    """What a stream makes of `data` cut anywhere. It is fed to its end, or until the stream is lost."""
    stream, events = Stream(), []
    cuts = np.sort(rng.integers(0, len(data) + 1, rng.integers(0, 8)))
    for piece in np.split(np.frombuffer(data, np.uint8), cuts):
        events += stream.feed(piece.tobytes())
        if events and isinstance(events[-1], Rejected) and events[-1].fatal:
            break
    return events


def unharmed(events: list[Event], sent: list[Message]) -> bool:
    """Whether each message that was taken is one that was sent, in its order: nothing wrong was taken for right."""
    left = iter(map(encode, sent))
    return all(encode(event) in left for event in events if isinstance(event, Message))


def flipped(rng: np.random.Generator) -> bool:
    """A byte of a body is another."""
    sent = good(rng)
    parts = [bytearray(encode(message)) for message in sent]
    hit = int(rng.integers(len(parts)))
    parts[hit][rng.integers(HEADER_BYTES, len(parts[hit]))] ^= int(rng.integers(1, 256))
    events = in_pieces(b"".join(parts), rng)
    told = [event for event in events if isinstance(event, Rejected)]
    return (
        unharmed(events, sent)
        and len(events) == len(sent)
        and [event.fault for event in told] == [Fault.WRONG_CRC]
        and events[hit] is told[0]
    )


def truncated(rng: np.random.Generator) -> bool:
    """The bytes end early."""
    sent = good(rng)
    data = b"".join(map(encode, sent))
    events = in_pieces(data[: rng.integers(len(data))], rng)
    return unharmed(events, sent) and len(events) < len(sent) and all(isinstance(event, Message) for event in events)


def split(rng: np.random.Generator) -> bool:
    """The bytes come in pieces."""
    sent = good(rng)
    return [encode(event) for event in in_pieces(b"".join(map(encode, sent)), rng)] == [*map(encode, sent)]


def wrong_crc(rng: np.random.Generator) -> bool:
    """The CRC is another."""
    sent = good(rng)
    data = bytearray(encode(sent[1]))
    data[50 + rng.integers(8)] ^= int(rng.integers(1, 256))
    first, second, third = in_pieces(encode(sent[0]) + data + encode(sent[2]), rng)
    return unharmed([first, third], [sent[0], sent[2]]) and second.fault is Fault.WRONG_CRC


def wrong_size(rng: np.random.Generator) -> bool:
    """The size is another: a little smaller or larger, or any number; two good messages follow, and then silence.

    Nothing wrong may be taken; the stream must say what was wrong, or show that it waits, so that the owner of the
    connection ends it.
    """
    sent = good(rng)
    data = bytearray(encode(sent[0]))
    size = int.from_bytes(data[SIZE_AT], "big")
    other = size + int(rng.integers(1, 200)) if rng.random() < 0.4 else int(rng.integers(size))
    if rng.random() < 0.2:
        other = int(rng.integers(2**63))
    data[SIZE_AT] = other.to_bytes(8, "big")
    stream, events = Stream(), []
    for piece in (bytes(data), encode(sent[1]), encode(sent[2])):
        events += stream.feed(piece)
        if events and isinstance(events[-1], Rejected) and events[-1].fatal:
            break
    told = [event for event in events if isinstance(event, Rejected)]
    return unharmed(events, sent[1:]) and bool(told or stream.partial)


def unknown_type(rng: np.random.Generator) -> bool:
    """A type that is not read here: skipped, and the next is read."""
    sent = good(rng)
    data = bytearray(encode(sent[1]))
    name = "".join(rng.choice(list("ABCDEFGHIJ_"), rng.integers(1, 13)))
    data[TYPE_AT] = name.encode().ljust(12, b"\0")
    first, second, third = in_pieces(encode(sent[0]) + data + encode(sent[2]), rng)
    return unharmed([first, third], [sent[0], sent[2]]) and second.fault is Fault.UNKNOWN_TYPE


def altered_header(rng: np.random.Generator) -> bool:
    """A byte of the header is another. No CRC covers it; but the body, where it is taken, is the one that was sent."""
    sent = good(rng)
    data = bytearray(encode(sent[0]))
    data[rng.integers(HEADER_BYTES)] ^= int(rng.integers(1, 256))
    events = in_pieces(bytes(data), rng)
    taken = [event.body.content() for event in events if isinstance(event, Message)]
    return taken in ([], [sent[0].body.content()])


def noise(rng: np.random.Generator) -> bool:
    """Bytes that mean nothing."""
    events = in_pieces(rng.bytes(rng.integers(58, 4000)), rng)
    return len(events) == 1 and isinstance(events[0], Rejected) and events[0].fatal


FAULTS = {
    "byte flipped": flipped,
    "truncated": truncated,
    "split anywhere": split,
    "wrong CRC": wrong_crc,
    "wrong size": wrong_size,
    "unknown type": unknown_type,
    "header altered": altered_header,
    "noise": noise,
}
