"""Any message that can be sent, drawn by hypothesis."""

import numpy as np
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from sightline.robot.igtl import (
    Capability,
    Command,
    CommandReply,
    Get,
    Image,
    Message,
    Missing,
    NDArray,
    Path,
    Point,
    Points,
    Position,
    Sensor,
    Start,
    Started,
    Status,
    Stop,
    String,
    Trajectories,
    Transform,
)
from sightline.robot.igtl.messages_text import QUERIED, STREAMED

WORDS = st.text(st.characters(codec="utf-8", exclude_characters="\0"), max_size=30)
FLOATS = st.floats(width=32, allow_nan=True, allow_infinity=True)
BYTE = st.integers(0, 255)


def fitting(size: int) -> st.SearchStrategy[str]:
    """Text of at most `size` bytes."""
    return WORDS.filter(lambda text: len(text.encode()) <= size)


def numbers(*shape: int) -> st.SearchStrategy[np.ndarray]:
    return hnp.arrays(np.float64, shape, elements=FLOATS)


MATRICES = numbers(3, 4).map(lambda rows: np.vstack([rows, (0, 0, 0, 1)]))
COLOURS = st.tuples(BYTE, BYTE, BYTE, BYTE)
TYPES = st.text(st.characters(min_codepoint=33, max_codepoint=126), min_size=1, max_size=12)
SCALARS = st.sampled_from(["i1", "u1", "i2", "u2", "i4", "u4", "f4", "f8"])


def arrays(types: st.SearchStrategy[str], dimensions: int, least: int = 1) -> st.SearchStrategy[np.ndarray]:
    shapes = hnp.array_shapes(min_dims=least, max_dims=dimensions, min_side=0, max_side=5)
    return types.flatmap(lambda name: hnp.arrays(np.dtype(name), shapes))


@st.composite
def images(draw: st.DrawFn) -> Image:
    pixels = draw(arrays(SCALARS, 4, least=3).filter(lambda a: a.ndim == 3 or a.shape[3] > 1))
    offset = draw(st.tuples(*[st.integers(0, 9)] * 3))
    size = tuple(start + count for start, count in zip(offset, pixels.shape[2::-1], strict=True))
    return Image(pixels, draw(MATRICES), draw(st.sampled_from(["RAS", "LPS"])), size, offset)


POINT = st.builds(Point, fitting(64), numbers(3), fitting(32), COLOURS, FLOATS, fitting(20))
PATH = st.builds(Path, fitting(64), numbers(3), numbers(3), fitting(32), BYTE, COLOURS, FLOATS, fitting(20))
BODIES = {
    Transform: st.builds(Transform, MATRICES),
    Position: st.builds(Position, numbers(3), numbers(4)),
    Points: st.builds(Points, st.lists(POINT, max_size=3).map(tuple)),
    Trajectories: st.builds(Trajectories, st.lists(PATH, max_size=3).map(tuple)),
    Status: st.builds(Status, st.integers(0, 65535), fitting(20), WORDS, st.integers(-(2**63), 2**63 - 1)),
    String: st.builds(String, st.text(st.characters(codec="utf-8"))),
    Command: st.builds(Command, st.integers(0, 2**32 - 1), fitting(128), st.text(st.characters(codec="utf-8"))),
    CommandReply: st.builds(CommandReply, st.integers(0, 2**32 - 1), fitting(128), WORDS),
    Capability: st.builds(Capability, st.lists(TYPES, max_size=4).map(tuple)),
    Sensor: st.builds(Sensor, hnp.arrays(np.float64, st.integers(0, 255)), st.integers(0, 2**64 - 1), BYTE),
    NDArray: st.builds(NDArray, arrays(SCALARS | st.just("c16"), 5)),
    Image: images(),
    Get: st.builds(Get, st.sampled_from(QUERIED)),
    Start: st.builds(Start, st.sampled_from(STREAMED)) | st.builds(Start, st.just("SENSOR"), st.integers(0, 2**64 - 1)),
    Stop: st.builds(Stop, st.sampled_from(STREAMED)),
    Started: st.builds(Started, st.sampled_from(STREAMED), BYTE),
    Missing: st.builds(Missing, st.sampled_from(["TRANSFORM", "STATUS", "IMAGE", "NDARRAY"])),
}
NAMES = st.text(st.characters(codec="ascii", exclude_characters="\0"), max_size=20)


def messages(bodies: st.SearchStrategy) -> st.SearchStrategy[Message]:
    """Of both header versions."""
    times = st.integers(0, 2**64 - 1)
    metadata = st.dictionaries(WORDS, st.text(st.characters(codec="utf-8"), max_size=30), max_size=3)
    first = st.builds(Message, bodies, NAMES, times)
    return first | st.builds(Message, bodies, NAMES, times, st.just(2), st.integers(0, 2**32 - 1), metadata)
