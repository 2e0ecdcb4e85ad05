"""Byte for byte what the protocol's documents say: messages laid out by hand, without Sightline's own codec.

Layouts of `openigtlink.json`: OpenIGTLink protocol versions 2 and 3. CRC: ECMA-182, 64 bits, not reflected, from 0.
"""

import json
from pathlib import Path

import numpy as np
import pytest

from sightline.robot.igtl import Capability, Command, Message, Status, Stream, String, Trajectories, encode, unit

GOLDEN = json.loads((Path(__file__).parents[1] / "golden" / "openigtlink.json").read_text("utf-8"))
ROUNDED = {"rtol": 1e-6, "atol": 1e-7}  # 32 bits


def fields(name: str) -> dict:
    return GOLDEN[name]["fields"]


def read(name: str) -> Message:
    (event,) = Stream().feed(bytes.fromhex(GOLDEN[name]["wire_hex"]))
    assert isinstance(event, Message)
    return event


@pytest.mark.parametrize("name", GOLDEN)
def test_bytes_are_the_same_both_ways(name: str) -> None:
    message, golden = read(name), GOLDEN[name]
    stated = golden["fields"]
    assert encode(message) == bytes.fromhex(golden["wire_hex"])
    assert (message.version, message.type_name) == (golden["version"], golden["type"])
    assert message.device_name == stated["device_name"]
    assert message.timestamp == stated["timestamp_seconds"] << 32 | stated["timestamp_fraction"]
    assert message.message_id == stated.get("message_id", 0)
    assert dict(message.metadata) == {key: value for key, _, value in stated.get("metadata", [])}


def test_poses_are_read() -> None:
    body = read("TRANSFORM_v1").body
    np.testing.assert_allclose(body.matrix, fields("TRANSFORM_v1")["matrix_rows"], **ROUNDED)
    assert body.fault is None
    position, stated = read("POSITION_v1").body, fields("POSITION_v1")
    np.testing.assert_array_equal(position.position_mm, stated["position"])
    np.testing.assert_array_equal(position.quaternion, stated["quaternion_xyzw"])


def test_points_and_paths_are_read() -> None:
    points, paths = read("POINT_v1").body, read("TRAJ_v2").body
    assert isinstance(paths, Trajectories)
    for point, stated in zip(points.points, fields("POINT_v1")["points"], strict=True):
        read_fields = (point.name, point.group, list(point.rgba), point.diameter_mm, point.owner)
        assert read_fields == tuple(stated[key] for key in ("name", "group", "rgba", "radius", "owner"))
        np.testing.assert_array_equal(point.position_mm, stated["position"])
    for path, stated in zip(paths.paths, fields("TRAJ_v2")["trajectories"], strict=True):
        read_fields = (path.name, path.group, path.given, list(path.rgba), path.diameter_mm, path.owner)
        assert read_fields == tuple(stated[key] for key in ("name", "group", "type", "rgba", "radius", "owner"))
        np.testing.assert_array_equal(path.entry_mm, stated["entry"])
        np.testing.assert_array_equal(path.target_mm, stated["target"])


def test_words_are_read() -> None:
    assert read("STATUS_v1").body == Status(13, "MOVE_TO_TARGET", "no target is set", -4)
    assert read("STRING_v1").body == String("MOVE_TO_TARGET")
    asked = fields("COMMAND_v1")
    assert read("COMMAND_v1").body == Command(asked["command_id"], asked["command_name"], asked["command"])
    assert read("CAPABILITY_v1").body == Capability(tuple(fields("CAPABILITY_v1")["types"]))


def test_numbers_are_read() -> None:
    sensor, stated = read("SENSOR_v1").body, fields("SENSOR_v1")
    np.testing.assert_array_equal(sensor.values, stated["data"])
    assert sensor.unit == stated["unit"] == unit(0, (0x01, 1), (0x03, -2))  # metre per second squared
    array = read("NDARRAY_v1").body
    np.testing.assert_array_equal(array.values, np.arange(12.0).reshape(2, 3, 2) / 8)
    image, stated = read("IMAGE_v1").body, fields("IMAGE_v1")
    assert (image.pixels.shape, image.pixels.dtype, image.coordinates) == ((1, 3, 5), np.uint16, "RAS")
    np.testing.assert_array_equal(image.pixels.ravel(), stated["pixels"])
    np.testing.assert_allclose(image.matrix, stated["matrix_rows"], **ROUNDED)
