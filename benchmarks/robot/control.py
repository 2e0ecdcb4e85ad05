"""The robot's controller: timing of the loop, stopping time, and the effect of damaged bytes and lost peers.

Times are wall time. For the loop's timing the robot is a separate process; otherwise robot and client share one.
"""

import socket
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import numpy as np
from tests.robot.rig import ROBOT, T_MCS_CFCS, metadata, served, wire

from benchmarks.rows import Row
from sightline.errors import LinkError, RobotRefusedError
from sightline.robot.control.states import MOVING, State
from sightline.robot.igtl import Message, Status, String, Transform, encode
from sightline.robot.kinematics.manipulator import FEED
from sightline.robot.link.client import RobotClient
from sightline.robot.link.server import LATE_S, PRIORITY, SWITCH_S, RobotServer, prefer_this_thread
from sightline.robot.plant import CYCLE_S
from sightline.robot.transport import BlockingClient

LOOP_S, STOPS, DRILLING_STOPS, FAULTS = 60.0, 30, 10, 500
KINDS = ("byte flipped", "truncated", "split anywhere", "wrong CRC", "wrong size field", "unknown type")


def run(*, quick: bool) -> list[Row]:
    share = 10 if quick else 1
    sys.setswitchinterval(SWITCH_S)
    return [
        *_punctuality(LOOP_S / share),
        _punctuality_while_looking(LOOP_S / share / 2),
        *_stops(STOPS // share),
        *_drilling_stops(max(DRILLING_STOPS // share, 2)),
        *_bad_bytes(FAULTS // share),
        _two_clients(FAULTS // share),
        _killed_clients(FAULTS // share),
        _restarts(FAULTS // share),
    ]


def _ready(robot: RobotClient) -> None:
    robot.start_up()
    robot.calibrate(T_MCS_CFCS, 10.0)
    robot.aim(wire(), metadata(), 10.0)


def _punctuality(seconds: float) -> list[Row]:
    """Measure the loop while the robot moves and drills and a client streams."""
    with _process() as port, RobotClient(port=port) as robot:
        _ready(robot)
        first, began = robot.stream("arm/cycles").body.values, time.monotonic()
        with suppress(RobotRefusedError):
            robot.align()
            while robot.drill() == "PAUSED" and time.monotonic() - began < seconds:
                pass
        while time.monotonic() - began < seconds:
            robot.stream("arm/measured_js")
        last = robot.stream("arm/cycles").body.values
    count, missed = (last - first)[:2].astype(int)
    kept = 1 - missed / count
    return [
        Row(
            "robot loop",
            f"cycles within 1 ms, {count} at 200 Hz, a client streaming",
            f"{kept:.3%}",
            "99.9 %",
            f"an empty loop here {_empty_loop(seconds / 3):.3%}",
            kept >= 0.999,
        )
    ]


def _punctuality_while_looking(seconds: float) -> Row:
    """While one target after the other is looked at for collisions."""
    with _process() as port, RobotClient(port=port) as robot:
        robot.start_up()
        robot.calibrate(T_MCS_CFCS, 10.0)
        first, began = robot.stream("arm/cycles").body.values, time.monotonic()
        targets = 0
        while time.monotonic() - began < seconds:
            robot.aim(wire(), metadata(), 10.0)
            targets += 1
        last = robot.stream("arm/cycles").body.values
    count, missed = (last - first)[:2].astype(int)
    kept = 1 - missed / count
    what = f"cycles within 1 ms, {count} at 200 Hz, while {targets} targets are looked at"
    return Row("robot loop", what, f"{kept:.3%}", "", f"the latest cycle {1e3 * last[2]:.1f} ms")


def _empty_loop(seconds: float) -> float:
    """Return the share of punctual cycles of an empty loop at the same priority, the machine's limit."""
    late: list[float] = []

    def turn() -> None:
        prefer_this_thread(PRIORITY)
        due = time.monotonic()
        for _ in range(round(seconds / CYCLE_S)):
            due += CYCLE_S
            time.sleep(max(due - time.monotonic(), 0.0))
            late.append(time.monotonic() - due)
            due += CYCLE_S * int(late[-1] / CYCLE_S)

    thread = threading.Thread(target=turn)
    thread.start()
    thread.join()
    return 1 - sum(one > LATE_S for one in late) / len(late)


@contextmanager
def _process() -> Iterator[int]:
    """Yield the port of `sightline robot serve` in a separate process."""
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    sightline = str(Path(sys.executable).with_name("sightline"))
    command = [sightline, "robot", "serve", "--port", str(port), "--frame-serial", "SN-7"]
    with subprocess.Popen([*command, "--quiet"]) as process:
        assert _within(lambda: _answers(port), 30.0)
        try:
            yield port
        finally:
            process.terminate()


def _answers(port: int) -> bool:
    try:
        BlockingClient(port=port).close()
    except LinkError:
        return False
    return True


def _stop_time(server: RobotServer, robot: RobotClient, joints: slice) -> tuple[float, float]:
    """Return the wall time, s, from the last byte to below 1 % of full speed, and the tip's travel meanwhile, mm."""
    moved = server._plant
    with BlockingClient(port=server.port) as own:
        data = encode(Message(String("STOP"), "CMD_STOP"))
        before = moved._body.encoders()
        own._socket.sendall(data)
        began = time.monotonic()
        while (np.abs(moved._body._data.qvel[moved._dof]) / moved._full > 0.01)[joints].any():
            assert time.monotonic() - began < 1.0
            time.sleep(0.0002)
        took = time.monotonic() - began
        tip = ROBOT.manipulator.T_mcs_tool(np.stack([before, moved._body.encoders()])).translation
    return took, float(np.linalg.norm(tip[1] - tip[0]))


def _observed(server: RobotServer) -> None:
    """Give access to the simulator's true joint speeds, which the loop cannot see."""
    from sightline.robot.kinematics.manipulator import JOINTS
    from sightline.twin.robot.mjcf import unit

    body = server._plant._body
    server._plant._dof = np.array([body._model.joint(name).dofadr[0] for name in JOINTS])
    server._plant._full = ROBOT.manipulator.speed * np.array([unit(joint) for joint in range(len(JOINTS))])


def _stops(times: int) -> list[Row]:
    """Measure stops at full alignment speed."""
    took = []
    rng = np.random.default_rng(1)
    for _ in range(times):
        with served() as server, RobotClient(port=server.port) as robot:
            _observed(server)
            _ready(robot)
            motion = threading.Thread(target=lambda robot=robot: _quietly(robot.align))
            motion.start()
            full = server._plant._full
            while (np.abs(server._plant._body._data.qvel[server._plant._dof]) / full).max() < 0.98:
                time.sleep(0.001)
            time.sleep(rng.uniform(0.0, 0.05))
            took.append(_stop_time(server, robot, slice(None))[0])
            motion.join()
    worst, median = max(took), float(np.median(took))
    value = f"{1e3 * median:.0f} ms median, {1e3 * worst:.0f} ms worst of {times}"
    return [Row("robot stop", "last byte to 1 % speed, at full alignment speed", value, "50 ms", "", worst <= 0.05)]


def _drilling_stops(times: int) -> list[Row]:
    took, travelled = [], []
    with served() as server, RobotClient(port=server.port) as robot:
        _observed(server)
        for _ in range(times):
            _ready(robot)
            robot.align()
            motion = threading.Thread(target=lambda: _quietly(robot.drill))
            motion.start()
            while (server.dialogue.controller.machine.snapshot().depth_mm or -20.0) < 0.5:
                time.sleep(0.01)
            seconds, travel = _stop_time(server, robot, slice(FEED, FEED + 1))
            took.append(seconds)
            travelled.append(travel)
            motion.join()
    value = f"{max(travelled):.3f} mm worst of {times}, {1e3 * max(took):.0f} ms"
    return [
        Row("robot stop", "tip travel after the last byte, while drilling", value, "0.1 mm", "", max(travelled) <= 0.1)
    ]


def _quietly(action) -> None:
    with suppress(RobotRefusedError, LinkError):
        action()


def _bad(kind: str, rng: np.random.Generator) -> list[bytes]:
    """Return a damaged command that would move the robot."""
    data = bytearray(encode(Message(String("RETRACT"), "CMD_1")))
    if kind == "byte flipped":
        data[rng.integers(58, len(data))] ^= int(rng.integers(1, 256))
    elif kind == "truncated":
        data = data[: rng.integers(1, len(data))]
    elif kind == "split anywhere":
        cut = int(rng.integers(1, len(data)))
        return [bytes(data[:cut]), bytes(data[cut:])]
    elif kind == "wrong CRC":
        data[50:58] = rng.bytes(8)
    elif kind == "wrong size field":
        true = len(data) - 58
        size = int(rng.integers(0, 1 << 62)) if rng.random() < 0.5 else int(rng.integers(0, 400))
        data[42:50] = struct.pack(">Q", size + (size == true))
    else:
        data[2:14] = b"NOVELTY".ljust(12, b"\0")
    return [bytes(data)]


def _bad_bytes(times: int) -> list[Row]:
    """Send damaged RETRACT commands: the robot must move only for complete messages, even in two pieces."""
    rows, rng = [], np.random.default_rng(2)
    with served(virtual=True) as server:
        controller, moved = server.dialogue.controller, server._plant
        for kind in KINDS:
            wrong = 0
            for _ in range(times):
                moved.q[FEED] = 30.0
                with BlockingClient(port=server.port) as raw:
                    _start_up(raw)
                    before = moved.q.copy()

                    def has_moved(before=before) -> bool:
                        return bool((moved.q != before).any())

                    for piece in _bad(kind, rng):
                        raw._socket.sendall(piece)
                        time.sleep(0.0005)
                    if kind == "split anywhere":
                        wrong += not _within(has_moved, 2.0)
                    else:
                        time.sleep(0.002)
                        wrong += controller.machine.state in MOVING or has_moved()
                wrong += not _within(lambda: controller.machine.state is State.UNDEFINED and not controller.busy, 2.0)
            rows.append(_count("robot link faults", kind, wrong, times))
    return rows


def _start_up(raw: BlockingClient) -> None:
    raw.send(Message(String("START_UP"), "CMD_1"))
    while (event := raw.receive(5.0)) is not None:
        if isinstance(event, Message) and event.device_name == "START_UP":
            return
    raise AssertionError("no START_UP")


def _lead_to_target(raw: BlockingClient) -> None:
    for body, name in (
        (String("START_UP"), "CMD_1"), (String("CALIBRATION"), "CMD_2"), (Transform.of(T_MCS_CFCS.inv()), "CLB_1"),
        (String("TARGETING"), "CMD_3"), (Transform.of(wire()), "TGT_1"),
    ):  # fmt: skip
        said = metadata() if name.startswith("TGT") else {}
        raw.send(Message(body, name, version=2, metadata=said))
    while True:
        event = raw.receive(5.0)
        assert isinstance(event, Message)
        if event.device_name == "TARGET" and isinstance(event.body, Status):
            assert event.body.code == 1
            return


def _two_clients(times: int) -> Row:
    wrong = 0
    with served(virtual=True) as server:
        for _ in range(times):
            with BlockingClient(port=server.port) as first, BlockingClient(port=server.port) as second:
                _start_up(first)
                second.send(Message(String("RETRACT"), "CMD_9"))
                codes = []
                while not codes and (event := second.receive(2.0)) is not None:
                    if (
                        isinstance(event, Message)
                        and isinstance(event.body, Status)
                        and event.device_name != "CURRENT_STATUS"
                    ):
                        codes.append(event.body.code)
                wrong += codes != [5] or server.dialogue.controller.machine.state is not State.START_UP
            wrong += not _within(lambda: server.dialogue.controller.lease is None, 2.0)
    return _count("robot link faults", "two clients commanding", wrong, times)


def _killed_clients(times: int) -> Row:
    """Kill clients in turn while the robot rests, aligns, drills and retracts."""
    wrong, worst = 0, 0.0
    states = (State.TARGETING, *MOVING)
    with served(virtual=True) as server:
        controller = server.dialogue.controller
        for k in range(times):
            state = states[k % len(states)]
            raw = BlockingClient(port=server.port)
            _lead_to_target(raw)
            if state is not State.TARGETING:
                raw.send(Message(String("MOVE_TO_TARGET"), "CMD_4"))
            if state in (State.DRILL, State.RETRACT):
                assert _within(lambda: controller.machine.state is State.ALIGNED, 20.0)
                raw.send(Message(String(state.value), "CMD_5"))
            _within(lambda state=state: controller.machine.state is state, 2.0)
            raw._socket.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
            began = time.monotonic()
            raw.close()
            wrong += not _within(lambda: controller.machine.state is State.UNDEFINED and not controller.busy, 2.0)
            worst = max(worst, time.monotonic() - began)
            wrong += bool(np.abs(server._plant.goal).max() != 0)
    row = _count("robot link faults", "client killed in every state", wrong, times)
    return Row(row.group, row.name, row.value, row.required, f"noticed in {1e3 * worst:.0f} ms at worst", row.met)


def _restarts(times: int) -> Row:
    wrong, port = 0, 0
    for _ in range(times):
        with served(virtual=True, port=port) as server:
            port = server.port
            robot = RobotClient(port=port, heartbeat=False, streams=False)
            wrong += robot.status().error_name != "UNDEFINED"
            robot.start_up()
        try:
            robot.status()
            wrong += 1
        except LinkError:
            robot.close()
    return _count("robot link faults", "server killed and restarted", wrong, times)


def _within(condition, seconds: float) -> bool:
    end = time.monotonic() + seconds
    while not condition():
        if time.monotonic() > end:
            return False
        time.sleep(0.0005)
    return True


def _count(group: str, name: str, wrong: int, times: int) -> Row:
    return Row(group, name, f"{times - wrong} of {times} harmless", f"{times}", "", wrong == 0)
