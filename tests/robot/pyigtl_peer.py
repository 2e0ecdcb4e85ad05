"""A program that serves OpenIGTLink through pyigtl: `pyigtl_peer.py server`.

It sends one message of every type that it knows, waits for a STRING of the device DONE, prints as JSON what it received
and ends at once: pyigtl leaves threads and sockets behind, so it lives in a process of its own. `echo` returns every
TRANSFORM instead, for the benchmark.
"""

import json
import os
import sys
import time
from typing import Any

import numpy as np
import pyigtl

MATRIX = [[0, -1, 0, 12.5], [1, 0, 0, -3.25], [0, 0, 1, 100], [0, 0, 0, 1]]
POINTS = [[1.0, 2.5, -3.0], [40.0, 50.0, 60.0]]
PIXELS = np.arange(24, dtype=np.uint16).reshape(2, 3, 4)
PATIENCE_S = 30.0


def messages() -> list[Any]:
    """One of each type, of both header versions where metadata can go along."""
    colours = PIXELS.astype(np.uint8)[..., None].repeat(3, axis=3)
    sent = [
        pyigtl.TransformMessage(MATRIX, device_name="t1"),
        pyigtl.TransformMessage(MATRIX, device_name="t2"),
        pyigtl.StringMessage("START_UP", device_name="s1"),
        pyigtl.StringMessage("START_UP", device_name="s2"),
        pyigtl.PointMessage(POINTS, names=["entry", "end"], diameters=[2.5, 0.0], device_name="p1"),
        pyigtl.ImageMessage(PIXELS, np.array(MATRIX), device_name="i1"),
        pyigtl.ImageMessage(colours.astype(np.uint8), device_name="i2"),
        pyigtl.PolyDataMessage(points=np.eye(3), polygons=np.array([3, 0, 1, 2]), device_name="m1"),
        pyigtl.PositionMessage([1.0, 2.0, 3.0], [0.0, 0.0, 0.0, 1.0], device_name="q1"),
    ]
    for message in sent:
        message.timestamp = 1_700_000_000.5
        if message.device_name.endswith("2"):
            message.header_version = 2
            message.message_id = 5
            message.metadata = {"side": "left", "frame": "gamma 3"}
    return [*sent, pyigtl.StringMessage("that was all", device_name="DONE")]


def said(message: Any) -> dict[str, Any]:
    """What a message holds, for JSON."""
    found: dict[str, Any] = {"type": message.message_type, "time": message.timestamp, "metadata": message.metadata}
    for name in ("matrix", "string", "positions", "names", "image", "ijk_to_world_matrix"):
        value = getattr(message, name, None)
        if value is not None:
            found[name] = value if isinstance(value, str | list) else np.asarray(value).tolist()
    return found


def wait_until(true: Any) -> None:
    end = time.monotonic() + PATIENCE_S
    while not true():
        if time.monotonic() > end:
            print("waited in vain", file=sys.stderr)
            os._exit(1)
        time.sleep(0.002)


def main() -> None:
    peer: Any = pyigtl.OpenIGTLinkServer(port=0, local_server=True)
    print(peer.server_address[1], flush=True)
    wait_until(peer.is_connected)
    while sys.argv[1] == "echo":
        message = peer.wait_for_message("TGT_1", timeout=PATIENCE_S)
        if message is None:
            os._exit(0)
        peer.send_message(message, wait=False)
    for message in messages():
        peer.send_message(message, wait=True)
    received: dict[str, Any] = {}

    def done() -> bool:
        received.update({message.device_name: said(message) for message in peer.get_latest_messages()})
        return "DONE" in received

    wait_until(done)
    print(json.dumps(received), flush=True)
    os._exit(0)


if __name__ == "__main__":
    main()
