"""The simulated robot: its loop, its stop, its link beside pyigtl, its kinematics, and break-throughs of its wire.

Servers run in separate processes. The peer of the link is pyigtl, its client with its own server. A round trip is one
TRANSFORM there and back. Times of the manipulator's arithmetic are processor times of one thread, the smallest of many
runs.
"""

import time
from typing import Any

import numpy as np
import pyigtl
from scipy.spatial.transform import RigidTransform

from benchmarks import robot_faults, supervision
from benchmarks.harness import Row, Rows, time_ms
from sightline.robot.igtl import Image, Message, Stream, Transform, encode
from sightline.robot.kinematics.designs import FEED, WRIST_MM, nominal_manipulator
from sightline.robot.kinematics.manipulator import Manipulator
from sightline.robot.kinematics.reach import check_reach, hip_surroundings
from sightline.robot.plant import CYCLE_S
from sightline.robot.transport import BlockingClient
from sightline.twin.anatomy.femur import Femur, to_cfcs, voxelise
from sightline.twin.robot.drilling import Bone
from sightline.twin.robot.plant import SimulatedPlant

MAX_TRIP_MS = 0.3
BURST = 1000
PATIENCE_S = 20.0
MIN_FACTOR = 50.0  # 300 insertions of two minutes in ten
GUIDE_GAP_MM, STANDOFF_MM = 10.0, 20.0
IMAGING = np.array([0.0, 0.0, np.pi / 4, 0.0, 0.0])
TILT_RAD = 1e-3  # of the displaced axes

_ECHO = """
import asyncio
from sightline.robot.transport import serve
class Echo:
    def opened(self, connection): pass
    def silent(self, connection): pass
    def lost(self, connection, reason): pass
    def received(self, connection, event): connection.send(event)
async def main():
    async with await serve(Echo(), port=0) as server:
        print(server.port, flush=True)
        await asyncio.Event().wait()
asyncio.run(main())
"""


def run(quick: bool) -> list[Row]:
    """Return the rows of this benchmark."""
    share = 10 if quick else 1
    return _link(3000 // share) + _manipulator(quick) + supervision.run(quick) + (robot_faults.run(share))


def _link(trips: int) -> Rows:
    rows = Rows("robot link")
    with robot_faults.server("-c", _ECHO) as port:
        own, arrived, in_order = _ours(port, trips)
    with robot_faults.server("-m", "tests.robot.pyigtl_peer", "echo") as port:
        peer, peer_arrived = _pyigtl(port, trips // 30)
    name = f"TRANSFORM there and back on loopback, median; 99 % {np.quantile(own, 0.99):.3f} ms"
    rows.number(name, np.median(own), unit="ms", most=MAX_TRIP_MS, peer=f"pyigtl {np.median(peer):.1f} ms")
    rows.add(f"burst of {BURST:,} messages of one device, back and in order", f"{arrived:,}", f"{BURST:,}",
             in_order and arrived == BURST, peer=f"pyigtl {peer_arrived}")  # fmt: skip
    image_ms, peer_ms = _image_ms(max(trips // 30, 30))
    name = "IMAGE of 2 MB, written and read, CRC verified"
    rows.number(name, image_ms, ".0f", "ms", peer=f"pyigtl {peer_ms:.0f} ms, not verified")
    return rows


def _ours(port: int, count: int) -> tuple[np.ndarray, int, bool]:
    """Return the times of round trips, ms, how many messages of a burst come back, and whether in order."""
    with BlockingClient(port=port) as client:

        def send(number: int) -> None:
            client.send(Message(Transform(np.eye(4)), "TGT_1", timestamp=number))

        def trip() -> None:
            send(0)
            assert client.receive(PATIENCE_S) is not None

        taken, times = time_ms(trip, count), []
        for number in range(BURST):
            send(number + 1)
        while len(times) < BURST and isinstance(event := client.receive(PATIENCE_S), Message):
            times.append(event.timestamp)
    return taken, len(times), times == list(range(1, BURST + 1))


def _pyigtl(port: int, count: int) -> tuple[np.ndarray, int]:
    """Return the times of round trips, ms, and how many different messages of a burst come back."""
    client: Any = pyigtl.OpenIGTLinkClient(host="127.0.0.1", port=port)
    while not client.is_connected():
        time.sleep(0.01)

    def trip() -> None:
        client.send_message(pyigtl.TransformMessage(np.eye(4), device_name="TGT_1"), wait=True)
        assert client.wait_for_message("TGT_1", timeout=PATIENCE_S) is not None

    taken, seen = time_ms(trip, count), set()
    for number in range(BURST):
        message = pyigtl.TransformMessage(np.eye(4), timestamp=number + 1, device_name="TGT_1")
        client.send_message(message, wait=number % 50 == 49)
    while (message := client.wait_for_message("TGT_1", timeout=0.5)) is not None:
        seen.add(round(message.timestamp))
    client.stop()
    return taken, len(seen)


def _image_ms(count: int) -> tuple[float, float]:
    pixels = np.random.default_rng(1).integers(0, 65535, (1, 1024, 1024), dtype=np.uint16)
    message = Message(Image(pixels, np.eye(4)), "PA")

    def ours() -> None:
        (event,) = Stream().feed(encode(message))
        assert isinstance(event, Message)

    def peers() -> None:
        data = pyigtl.ImageMessage(pixels, device_name="PA").pack()
        pyigtl.ImageMessage().unpack(pyigtl.ImageMessage.parse_header(data[:58]), data[58:])

    return float(np.median(time_ms(ours, count))), float(np.median(time_ms(peers, count)))


def _manipulator(quick: bool) -> Rows:
    rows, robot, runs = Rows("manipulator"), nominal_manipulator(), 20 if quick else 200
    entry, end = _wire(robot)
    waypoints = np.stack([IMAGING, *(robot.inverse(entry, end, depth) for depth in (-STANDOFF_MM, 80.0))])
    theatre = hip_surroundings(robot.T_mcs_cfcs(IMAGING))
    factor = _factor(robot, seconds=5.0 if quick else 100.0)
    nominal, displaced = (
        1e3 * time_ms(lambda arm=arm: arm.inverse(entry, end), runs, time.thread_time).min()
        for arm in (robot, _displaced(robot))
    )
    reach = time_ms(lambda: check_reach(robot, waypoints, theatre), max(runs // 20, 3), time.thread_time).min()
    name = (
        "simulated plant, times real time; inverse kinematics, nominal and displaced axes; path checked for collisions"
    )
    value = f"{factor:.0f}; {nominal:.0f} and {displaced:.0f} µs; {reach:.0f} ms"
    rows.add(name, value, f">= {MIN_FACTOR:.0f}", factor >= MIN_FACTOR)
    return rows


def _wire(robot: Manipulator) -> np.ndarray:
    """Return entry and end (2, 3), MCS, of a femur's ideal wire with its middle at the frame's origin."""
    wire = to_cfcs(np.stack(Femur().wire_mm()), "right", np.zeros(3))
    return robot.T_mcs_cfcs(IMAGING).apply(wire - wire.mean(axis=0))


def _displaced(robot: Manipulator) -> Manipulator:
    twists = np.zeros((6, 6))
    twists[:, :3] = TILT_RAD * np.random.default_rng(1).standard_normal((6, 3))
    twists[:, 3:] = np.cross(WRIST_MM, twists[:, :3])
    return robot.displaced(twists)


def _factor(robot: Manipulator, seconds: float) -> float:
    """Return simulated over processor time in the fastest tenth of a drilling from stand-off to the wire's end."""
    femur = Femur()
    middle = to_cfcs(np.mean(femur.wire_mm(), axis=0), "right", np.zeros(3))
    place = robot.T_mcs_cfcs(IMAGING) * RigidTransform.from_translation(-middle)
    bone = Bone((voxelise(femur, "right", np.zeros(3), np.random.default_rng(1)),), place)
    start = robot.inverse(*_wire(robot), -STANDOFF_MM)
    plant = SimulatedPlant(robot, bone, np.random.default_rng(2), start)
    plant.guide_mm = start[FEED] + STANDOFF_MM - GUIDE_GAP_MM
    velocity = np.array([0.0, 0.0, 0.0, 0.0, 1.0])

    def tenth() -> None:
        for _ in range(round(seconds / 10 / CYCLE_S)):
            plant.command(velocity, drill_on=True)
            plant.advance(CYCLE_S)

    return 1e3 * seconds / 10 / float(time_ms(tenth, 8, time.thread_time).min())
