"""The table of types: which class reads the content of which message."""

from collections.abc import Callable
from typing import Protocol

from sightline.robot.igtl.messages_arrays import Image, NDArray, Sensor
from sightline.robot.igtl.messages_mesh import PolyData
from sightline.robot.igtl.messages_plan import Points, Trajectories
from sightline.robot.igtl.messages_pose import Position, TrackingData, Transform
from sightline.robot.igtl.messages_query import ASKED_FOR, Missing, query_of
from sightline.robot.igtl.messages_text import Capability, Command, CommandReply, Status, String


class Body(Protocol):
    """What a message says: a frozen value with its type on the wire and its bytes."""

    @property
    def type_name(self) -> str:
        """At most twelve characters."""
        ...

    def content(self) -> bytes:
        """Without headers and metadata. Raises MessageError, ValueError or struct.error where it cannot be written."""
        ...


READERS: dict[str, Callable[[bytes], Body]] = {
    kind.type_name: kind.read
    for kind in (
        Transform, Position, TrackingData, Points, Trajectories, Status, String, Command, CommandReply, Capability,
        Sensor, NDArray, Image, PolyData,
    )
}  # fmt: skip
_LISTS = ("TDATA", "POINT", "TRAJ", "CAPABILITY")  # without content they are empty lists, and not missing


def is_plain(type_name: str) -> bool:
    """Whether a type is read here: all but BIND, which holds the others."""
    return type_name in READERS or query_of(type_name) is not None


def read_plain(type_name: str, content: bytes) -> Body:
    """The body of a message of any type but BIND. Raises MessageError where the content is malformed."""
    query = query_of(type_name)
    if query is not None:
        kind, of = query
        return kind.read(of, content)
    if not content and type_name in ASKED_FOR and type_name not in _LISTS:
        return Missing(type_name)
    return READERS[type_name](content)
