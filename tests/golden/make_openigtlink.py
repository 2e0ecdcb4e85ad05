"""Writes `openigtlink.json`: messages laid out by hand after the protocol's documents, without Sightline's own codec.

    python -m tests.golden.make_openigtlink

Layouts: OpenIGTLink protocol version 2 and 3 (header, extended header, metadata, and the page of each message type).
CRC: ECMA-182, 64 bits, not reflected, starting from 0. The field values are our own. Everything is big-endian but the
pixels of an image that says otherwise.
"""

import json
import struct
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

FILE = Path(__file__).with_name("openigtlink.json")
POLYNOMIAL = 0x42F0E1EBA9EA3693  # ECMA-182

Fields = Mapping[str, Any]


def crc64(data: bytes) -> int:
    """Bit by bit, as the standard states it."""
    value = 0
    for byte in data:
        value ^= byte << 56
        for _ in range(8):
            value = (value << 1 ^ POLYNOMIAL if value >> 63 else value << 1) & 0xFFFFFFFFFFFFFFFF
    return value


def message(kind: str, version: int, fields: Fields) -> bytes:
    """All bytes of a message."""
    body = BODIES[kind](fields)
    if version == 2:
        body = extended(body, fields)
    seconds, fraction = fields["timestamp_seconds"], fields["timestamp_fraction"]
    head = struct.pack(
        ">H12s20sIIQ", version, kind.encode(), fields["device_name"].encode(), seconds, fraction, len(body)
    )
    return head + struct.pack(">Q", crc64(body)) + body


def extended(body: bytes, fields: Fields) -> bytes:
    """Extended header of 12 bytes, the body, the index of the metadata, keys and values one after the other."""
    metadata = [(key.encode(), encoding, value.encode()) for key, encoding, value in fields["metadata"]]
    index = struct.pack(">H", len(metadata))
    for key, encoding, value in metadata:
        index += struct.pack(">HHI", len(key), encoding, len(value))
    texts = b"".join(key + value for key, _, value in metadata)
    return struct.pack(">HHII", 12, len(index), len(texts), fields["message_id"]) + body + index + texts


def columns(rows: list[list[float]]) -> bytes:
    """The upper three rows of a 4 x 4 matrix, column by column, 32 bits."""
    return struct.pack(">12f", *(rows[row][column] for column in range(4) for row in range(3)))


def transform(fields: Fields) -> bytes:
    return columns(fields["matrix_rows"])


def position(fields: Fields) -> bytes:
    return struct.pack(">7f", *fields["position"], *fields["quaternion_xyzw"])


def status(fields: Fields) -> bytes:
    head = struct.pack(">Hq20s", fields["code"], fields["subcode"], fields["error_name"].encode())
    return head + fields["status_message"].encode() + b"\0"


def string(fields: Fields) -> bytes:
    text = fields["value"].encode()
    return struct.pack(">HH", fields["encoding"], len(text)) + text


def command(fields: Fields) -> bytes:
    text = fields["command"].encode()
    head = struct.pack(">I128sHI", fields["command_id"], fields["command_name"].encode(), fields["encoding"], len(text))
    return head + text


def capability(fields: Fields) -> bytes:
    return b"".join(struct.pack(">12s", name.encode()) for name in fields["types"])


def points(fields: Fields) -> bytes:
    return b"".join(
        struct.pack(
            ">64s32s4B4f20s",
            item["name"].encode(),
            item["group"].encode(),
            *item["rgba"],
            *item["position"],
            item["radius"],
            item["owner"].encode(),
        )
        for item in fields["points"]
    )


def trajectories(fields: Fields) -> bytes:
    return b"".join(
        struct.pack(
            ">64s32sBB4B7f20s",
            item["name"].encode(),
            item["group"].encode(),
            item["type"],
            0,
            *item["rgba"],
            *item["entry"],
            *item["target"],
            item["radius"],
            item["owner"].encode(),
        )
        for item in fields["trajectories"]
    )


def sensor(fields: Fields) -> bytes:
    data = fields["data"]
    return struct.pack(f">BBQ{len(data)}d", len(data), fields["status"], fields["unit"], *data)


def array(fields: Fields) -> bytes:
    """Doubles (type 11), the last index fastest."""
    size, data = fields["size"], fields["data"]
    return struct.pack(f">BB{len(size)}H{len(data)}d", 11, len(size), *size, *data)


def image(fields: Fields) -> bytes:
    """One component, of unsigned numbers of 8 bits (type 3) or 16 (type 5); lowest byte first (2); in RAS (1)."""
    size, kind = fields["size"], fields["scalar_type"]
    head = struct.pack(">HBBBB3H", 1, 1, kind, 2, 1, *size)
    pixels = struct.pack(f"<{len(fields['pixels'])}{'BH'[kind == 5]}", *fields["pixels"])
    return head + columns(fields["matrix_rows"]) + struct.pack(">6H", 0, 0, 0, *size) + pixels


BODIES = {
    "TRANSFORM": transform,
    "POSITION": position,
    "STATUS": status,
    "STRING": string,
    "COMMAND": command,
    "CAPABILITY": capability,
    "POINT": points,
    "TRAJ": trajectories,
    "SENSOR": sensor,
    "NDARRAY": array,
    "IMAGE": image,
}

# A wire's pose in the frame's coordinates: 135 degrees about x, 30 about z, off the grid.
POSE = [
    [0.8660254, 0.35355339, 0.35355339, 12.375],
    [0.5, -0.61237244, -0.61237244, -41.0625],
    [0.0, 0.70710678, -0.70710678, 318.15625],
    [0.0, 0.0, 0.0, 1.0],
]
PLAIN = {"device_name": "WireGuide", "timestamp_seconds": 1700000000, "timestamp_fraction": 0x80000000}
NAMED = {**PLAIN, "message_id": 77, "metadata": [["side", 3, "left"], ["Rahmen", 106, "Γ-07"]]}
ACCELERATION = (0x01 << 4 | 1) << 50 | (0x03 << 4 | 0xE) << 40  # metre to the power 1, second to the power -2 (4 bits)


def _words() -> Iterable[tuple[str, int, Fields]]:
    yield "STATUS", 1, {"code": 13, "subcode": -4, "error_name": "MOVE_TO_TARGET", "status_message": "no target is set"}
    yield "STRING", 1, {"encoding": 3, "value": "MOVE_TO_TARGET"}
    asked = {"command_id": 4000000001, "command_name": "RetractWire", "encoding": 3, "command": "<retract mm='12.5'/>"}
    yield "COMMAND", 1, asked
    yield "COMMAND", 2, asked
    yield "CAPABILITY", 1, {"types": ["TRANSFORM", "GET_TRANS", "STATUS", "STRING", "NDARRAY"]}


def _poses() -> Iterable[tuple[str, int, Fields]]:
    at = {"position": [12.375, -41.0625, 318.15625], "quaternion_xyzw": [0.5, -0.5, 0.5, 0.5]}
    for version in (1, 2):
        yield "TRANSFORM", version, {"matrix_rows": POSE}
        yield "POSITION", version, at


def _plans() -> Iterable[tuple[str, int, Fields]]:
    known = {"group": "Landmark", "owner": "pa-image"}
    yield (
        "POINT",
        1,
        {
            "points": [
                {
                    **known,
                    "name": "head centre",
                    "rgba": [255, 128, 0, 255],
                    "position": [1.5, -2.25, 3.125],
                    "radius": 46.0,
                },
                {
                    **known,
                    "name": "trochanter",
                    "rgba": [0, 64, 255, 128],
                    "position": [-60.75, 8.0, 0.5],
                    "radius": 0.0,
                },
            ]
        },
    )
    wires = [
        {
            "name": f"wire {k}",
            "group": "Plan",
            "type": 3,
            "rgba": [10 * k, 200, 30, 255],
            "entry": [5.5 * k, -20.25, 7.0],
            "target": [1.0, 2.0 * k, 95.5],
            "radius": 2.5,
            "owner": "lateral-image",
        }
        for k in (1, 2)
    ]
    for version in (1, 2):
        yield "TRAJ", version, {"trajectories": wires}


def _numbers() -> Iterable[tuple[str, int, Fields]]:
    gauge = {"status": 0, "unit": ACCELERATION, "data": [9.80665, -0.5, 1e-9]}
    shown = {
        "scalar_type": 5,
        "size": [5, 3, 1],
        "matrix_rows": POSE,
        "pixels": [4097 * k % 65536 for k in range(15)],
    }
    yield "SENSOR", 1, gauge
    yield "NDARRAY", 1, {"size": [2, 3, 2], "data": [k / 8 for k in range(12)]}
    yield "IMAGE", 1, shown


def make() -> dict[str, dict[str, Any]]:
    """Every message by its type and version: fields and bytes."""
    messages = {}
    for kind, version, fields in (*_words(), *_poses(), *_plans(), *_numbers()):
        whole = {**(NAMED if version == 2 else PLAIN), **fields}
        wire = message(kind, version, whole)
        messages[f"{kind}_v{version}"] = {"type": kind, "version": version, "fields": whole, "wire_hex": wire.hex()}
    return messages


if __name__ == "__main__":
    FILE.write_text(json.dumps(make(), indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
