"""Beside pyigtl, another implementation: every type that it knows, both ways.

Its POSITION has the layout of a POINT, which must be refused with a reason. Its POLYDATA is not read here and skipped.
"""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.robot.pyigtl_peer import MATRIX, PATIENCE_S, PIXELS, POINTS

from sightline.robot.igtl import (
    Event,
    Fault,
    Image,
    Message,
    Point,
    Points,
    Position,
    Rejected,
    Status,
    String,
    Transform,
    timestamp_of,
)
from sightline.robot.transport import BlockingClient

SIDE = {"version": 2, "message_id": 5, "metadata": {"side": "left", "frame": "gamma 3"}}
NOW = timestamp_of(1_700_000_000.5)
OURS = [
    Message(Transform(np.array(MATRIX)), "t1", NOW),
    Message(Transform(np.array(MATRIX)), "t2", NOW, **SIDE),
    Message(Status(13, "NOT_READY", "pyigtl does not know this type"), "unknown", NOW),
    Message(String("START_UP"), "s1", NOW),
    Message(String("START_UP"), "s2", NOW, **SIDE),
    Message(Points((Point("entry", np.array(POINTS[0])), Point("end", np.array(POINTS[1])))), "p1", NOW),
    Message(Image(PIXELS, np.array(MATRIX), "LPS"), "i1", NOW),
    Message(Image(PIXELS, np.array(MATRIX), "LPS"), "i2", NOW, **SIDE),
    Message(Position(np.zeros(3), np.array([0.0, 0, 0, 1])), "q1", NOW),
    Message(String("that was all"), "DONE", NOW),
]


def test_it_serves_us_and_hears_what_we_say() -> None:
    program, root = [sys.executable, "-m", "tests.robot.pyigtl_peer", "server"], Path(__file__).parents[2]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    events: list[Event] = []
    with subprocess.Popen(program, cwd=root, **pipes) as process:  # noqa: S603 - our own program
        try:
            with BlockingClient(port=int(process.stdout.readline())) as client:
                while not (events and isinstance(events[-1], Message) and events[-1].device_name == "DONE"):
                    event = client.receive(PATIENCE_S)
                    assert event is not None
                    events.append(event)
                for message in OURS:
                    client.send(message)
                out, err = process.communicate(timeout=PATIENCE_S)
        finally:
            process.kill()
    assert process.returncode == 0, err
    check_what_it_heard(json.loads(out))
    check_what_came(events)


def check_what_came(events: list[Event]) -> None:
    read = [event.device_name for event in events if isinstance(event, Message)]
    assert read == ["t1", "t2", "s1", "s2", "p1", "i1", "i2", "DONE"]
    assert [(e.header.device_name, e.fault) for e in events if isinstance(e, Rejected) and e.header] == [
        ("m1", Fault.UNKNOWN_TYPE), ("q1", Fault.BAD_BODY),
    ]  # fmt: skip
    came = {event.device_name: event for event in events if isinstance(event, Message)}
    for name in ("t2", "s2", "i2"):
        assert (came[name].version, came[name].message_id) == (2, 5)
        assert dict(came[name].metadata) == SIDE["metadata"]
    bodies = {name: message.body for name, message in came.items()}
    for name in ("t1", "t2"):
        assert came[name].time_s == pytest.approx(1_700_000_000.5, abs=1e-6)
        np.testing.assert_array_equal(bodies[name].matrix, MATRIX)
    assert bodies["s1"] == bodies["s2"] == String("START_UP")
    assert [(p.name, p.diameter_mm, *p.position_mm) for p in bodies["p1"].points] == [
        ("entry", 2.5, *POINTS[0]), ("end", 0.0, *POINTS[1]),
    ]  # fmt: skip
    np.testing.assert_array_equal(bodies["i1"].pixels, PIXELS)
    np.testing.assert_array_equal(bodies["i1"].matrix[:3, :3], np.array(MATRIX)[:3, :3])
    # The wire gives an image's centre: half of 4 x 3 x 2 pixels, less half of one, from the first.
    np.testing.assert_allclose(bodies["i1"].matrix[:3, 3], (np.array(MATRIX) @ (1.5, 1, 0.5, 1))[:3])
    assert bodies["i2"].pixels.shape == (2, 3, 4, 3)


def check_what_it_heard(found: dict[str, Any]) -> None:
    assert found.keys() == {"t1", "t2", "s1", "s2", "p1", "i1", "i2", "q1", "DONE"}
    assert {found[name]["time"] for name in found} == {1_700_000_000.5}
    for name in ("t2", "s2", "i2"):
        assert found[name]["metadata"] == SIDE["metadata"]
    assert found["t1"]["matrix"] == found["t2"]["matrix"] == MATRIX
    assert found["s1"]["string"] == found["s2"]["string"] == "START_UP"
    assert found["p1"]["positions"] == POINTS
    assert found["p1"]["names"] == ["entry", "end"]
    for name in ("i1", "i2"):
        assert found[name]["image"] == PIXELS.tolist()
        directions = np.array(found[name]["ijk_to_world_matrix"])[:3, :3]
        np.testing.assert_array_equal(directions, np.array(MATRIX)[:3, :3])
