"""OpenIGTLink, header versions 1 and 2: messages as values, encoded and decoded without input or output."""

from sightline.common.geometry.rigid import why_not_rigid
from sightline.robot.igtl.messages import (
    LONG_NAME,
    MAX_BODY_BYTES,
    Body,
    Event,
    Fault,
    Message,
    Rejected,
    Stream,
    encode,
)
from sightline.robot.igtl.messages_arrays import MILLIMETRE, NEWTON, Image, NDArray, Sensor, unit
from sightline.robot.igtl.messages_geometry import Path, Point, Points, Position, Trajectories, Transform
from sightline.robot.igtl.messages_query import Get, Missing, Start, Started, Stop
from sightline.robot.igtl.messages_text import Capability, Command, CommandReply, Status, String
from sightline.robot.igtl.wire import Header, timestamp_of

__all__ = [
    "LONG_NAME",
    "MAX_BODY_BYTES",
    "MILLIMETRE",
    "NEWTON",
    "Body",
    "Capability",
    "Command",
    "CommandReply",
    "Event",
    "Fault",
    "Get",
    "Header",
    "Image",
    "Message",
    "Missing",
    "NDArray",
    "Path",
    "Point",
    "Points",
    "Position",
    "Rejected",
    "Sensor",
    "Start",
    "Started",
    "Status",
    "Stop",
    "Stream",
    "String",
    "Trajectories",
    "Transform",
    "encode",
    "timestamp_of",
    "unit",
    "why_not_rigid",
]
