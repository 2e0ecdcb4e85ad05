"""The table of message types and the classes that read their content."""

from collections.abc import Callable
from typing import Protocol

from sightline.robot.igtl.messages_arrays import Image, NDArray, Sensor
from sightline.robot.igtl.messages_mesh import PolyData
from sightline.robot.igtl.messages_plan import Points, Trajectories
from sightline.robot.igtl.messages_pose import Position, TrackingData, Transform
from sightline.robot.igtl.messages_query import ASKED_FOR, Missing, query_of
from sightline.robot.igtl.messages_text import Capability, Command, CommandReply, Status, String


class Body(Protocol):
    """The body of a message: a frozen value with its type name and its encoding."""

    @property
    def type_name(self) -> str:
        """Its type on the wire, at most twelve characters."""
        ...

    def content(self) -> bytes:
        """Return its bytes without headers and metadata. Raises MessageError, ValueError or struct.error if it cannot
        be encoded."""
        ...


READERS: dict[str, Callable[[bytes], Body]] = {
    kind.type_name: kind.read
    for kind in (
        Transform, Position, TrackingData, Points, Trajectories, Status, String, Command, CommandReply, Capability,
        Sensor, NDArray, Image, PolyData,
    )
}  # fmt: skip
_LISTS = ("TDATA", "POINT", "TRAJ", "CAPABILITY")  # without content these are empty lists, not missing data


def is_plain(type_name: str) -> bool:
    """Return whether a type is read here: all but BIND, which contains the others."""
    return type_name in READERS or query_of(type_name) is not None


def read_plain(type_name: str, content: bytes) -> Body:
    """Return the body of a message of any type but BIND. Raises MessageError if the content is malformed."""
    query = query_of(type_name)
    if query is not None:
        kind, of = query
        return kind.read(of, content)
    if not content and type_name in ASKED_FOR and type_name not in _LISTS:
        return Missing(type_name)
    return READERS[type_name](content)
