"""Byte for byte what the reference implementation writes: its own test messages, read where they lie."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sightline.robot.igtl import (
    Bind,
    Capability,
    Command,
    Image,
    Message,
    NDArray,
    Points,
    PolyData,
    Position,
    Sensor,
    Status,
    Stream,
    String,
    TrackingData,
    Trajectories,
    Transform,
    encode,
    unit,
)

FOLDER = Path(__file__).parents[3] / "shared" / "data" / "openigtlink"  # not part of the project
FILES = sorted(FOLDER.glob("*_v[12].json"))

pytestmark = pytest.mark.skipif(not FILES, reason="the golden OpenIGTLink messages lie beside the project, not in it")

MATRIX = [[-0.954892, -0.196632, 0.222525, 46.0531], [0.196632, 0.142857, 0.970014, 19.4709]]
MATRIX += [[-0.222525, 0.970014, -0.0977491, 46.0531], [0, 0, 0, 1]]
ROUNDED = {"rtol": 1e-6, "atol": 1e-7}  # 32 bits


def golden(name: str) -> dict:
    return json.loads((FOLDER / f"{name}.json").read_text())


def read(name: str) -> Message:
    (event,) = Stream().feed(bytes.fromhex(golden(name)["wire_hex"]))
    assert isinstance(event, Message)
    return event


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_bytes_are_the_same_both_ways(path: Path) -> None:
    entry = golden(path.stem)
    message, fields = read(path.stem), entry["fields"]
    assert encode(message) == bytes.fromhex(entry["wire_hex"])
    assert (message.version, message.type_name) == (entry["header"]["version"], entry["header"]["type"])
    assert message.device_name == fields["device_name"]
    assert message.timestamp == int(entry["header"]["timestamp_hex"], 16)
    assert message.message_id == fields.get("message_id", 0)
    assert dict(message.metadata) == {key: value for key, _, value in fields.get("metadata", [])}


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_a_flipped_bit_of_the_body_is_seen(path: Path) -> None:
    wire = bytearray.fromhex(golden(path.stem)["wire_hex"])
    wire[(58 + len(wire)) // 2] ^= 0x10
    (event,) = Stream().feed(bytes(wire))
    assert not isinstance(event, Message)
    assert event.fault.value == "wrong CRC"


def test_poses_are_read() -> None:
    body = read("TRANSFORM_v2").body
    assert isinstance(body, Transform)
    np.testing.assert_allclose(body.matrix, MATRIX, **ROUNDED)
    assert body.fault is None
    position, fields = read("POSITION_v1").body, golden("POSITION_v1")["fields"]
    assert isinstance(position, Position)
    np.testing.assert_allclose(position.position_mm, fields["position"], **ROUNDED)
    np.testing.assert_allclose(position.quaternion, fields["quaternion_xyzw"], **ROUNDED)
    tools = read("TDATA_v2").body
    assert isinstance(tools, TrackingData)
    assert [(tool.name, tool.kind) for tool in tools.tools] == [(f"Tracker{k}", 2) for k in range(3)]
    np.testing.assert_allclose([tool.matrix for tool in tools.tools], [MATRIX] * 3, **ROUNDED)


def test_points_and_paths_are_read() -> None:
    points, paths = read("POINT_v1").body, read("TRAJ_v2").body
    assert isinstance(points, Points)
    assert isinstance(paths, Trajectories)
    for point, said in zip(points.points, golden("POINT_v1")["fields"]["points"], strict=True):
        assert (point.name, point.group, list(point.rgba), point.diameter_mm, point.owner) == (
            said["name"], said["group"], said["rgba"], said["radius"], said["owner"],
        )  # fmt: skip
        np.testing.assert_array_equal(point.position_mm, said["position"])
    for path, said in zip(paths.paths, golden("TRAJ_v2")["fields"]["trajectories"], strict=True):
        assert (path.name, path.group, path.kind, list(path.rgba), path.diameter_mm, path.owner) == (
            said["name"], said["group"], said["type"], said["rgba"], said["radius"], said["owner"],
        )  # fmt: skip
        np.testing.assert_array_equal(path.entry_mm, said["entry"])
        np.testing.assert_array_equal(path.target_mm, said["target"])


def test_words_are_read() -> None:
    assert read("STATUS_v1").body == Status(15, "ACTUATOR_DISABLED", "Actuator A is disabled.", 10)
    assert read("STRING_v1").body == String("Welcome to OpenIGTLink")
    assert read("COMMAND_v2").body == Command(5, "This is a test command", "Start the tracking machine")
    assert read("CAPABILITY_v1").body == Capability(("IMAGE", "GET_IMAGE", "TRANSFORM", "GET_TRANS"))


def test_numbers_are_read() -> None:
    sensor, fields = read("SENSOR_v1").body, golden("SENSOR_v1")["fields"]
    assert isinstance(sensor, Sensor)
    np.testing.assert_array_equal(sensor.values, fields["data"])
    assert sensor.unit == fields["unit"] == unit(0, (0x01, 1), (0x03, -2))  # metre per second squared
    array = read("NDARRAY_v1").body
    assert isinstance(array, NDArray)
    np.testing.assert_array_equal(array.values, np.arange(60.0).reshape(5, 4, 3))
    image = read("IMAGE_v1").body
    assert isinstance(image, Image)
    assert (image.pixels.shape, image.pixels.dtype, image.coordinates) == ((1, 50, 50), np.uint8, "RAS")
    assert image.pixels[0, 0, 0] == 0xFD
    np.testing.assert_allclose(image.matrix, MATRIX, **ROUNDED)


def test_a_mesh_is_read() -> None:
    mesh, fields = read("POLYDATA_v1").body, golden("POLYDATA_v1")["fields"]
    assert isinstance(mesh, PolyData)
    assert sorted(map(tuple, mesh.points_mm)) == [(a, b, c) for a in (0, 1) for b in (0, 1) for c in (0, 1)]
    assert [list(cell) for cell in mesh.polygons] == fields["polygons"]
    (attribute,) = mesh.attributes
    assert (attribute.name, attribute.kind) == ("attr", 0)
    np.testing.assert_array_equal(attribute.values[:, 0], fields["attribute"]["data"])


def test_bound_messages_are_those_sent_alone() -> None:
    bind = read("BIND_v1").body
    assert isinstance(bind, Bind)
    assert [name for name, _ in bind.children] == ["ChildTrans", "ChildImage", "ChildSensor"]
    for _, body in bind.children:
        alone = read(f"{body.type_name}_v1")
        assert encode(replace(alone, body=body)) == encode(alone)
