"""The robot's controller: timing of the loop, stopping time, and the effect of damaged bytes and lost peers.

Times are wall time. For the loop's timing the robot is a separate process; otherwise robot and client share one.
"""

import socket
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import numpy as np
from tests.robot.rig import ROBOT, T_MCS_CFCS, metadata, served, wire

from benchmarks.harness import Rows
from sightline.errors import LinkError, RobotRefusedError
from sightline.robot.control.states import MOVING, State
from sightline.robot.igtl import Message, Status, String, Transform, encode
from sightline.robot.kinematics.manipulator import FEED, JOINTS
from sightline.robot.link.client import RobotClient
from sightline.robot.link.server import LATE_S, PRIORITY, SWITCH_S, RobotServer, prefer_this_thread
from sightline.robot.plant import CYCLE_S
from sightline.robot.transport import BlockingClient
from sightline.twin.robot.mjcf import unit

LOOP_S, STOPS, DRILLING_STOPS, FAULTS = 60.0, 30, 10, 500
MIN_PUNCTUAL, MAX_STOP_S, MAX_TRAVEL_MM = 0.999, 0.05, 0.1
KINDS = ("byte flipped", "truncated", "split anywhere", "wrong CRC", "wrong size field", "unknown type")


def run(share: int) -> Rows:
    """Return the rows; `share`: the part of the trials that is done is one over it."""
    sys.setswitchinterval(SWITCH_S)
    rows, seconds = Rows("robot loop"), LOOP_S / share
    count, missed, _, _ = _loop(seconds, _drilled)
    kept, empty = 1 - missed / count, _empty_loop(seconds / 3)
    name = f"cycles within 1 ms, {count:,} at 200 Hz, a client streaming"
    rows.number(name, 100 * kept, ".3f", "%", least=100 * MIN_PUNCTUAL, peer=f"an empty loop here {empty:.3%}")
    count, missed, latest_s, targets = _loop(seconds / 2, _retargeted)
    name = f"cycles within 1 ms, {count:,} at 200 Hz, while {targets} targets are looked at for collisions"
    rows.number(name, 100 * (1 - missed / count), ".3f", "%", peer=f"the latest cycle {1e3 * latest_s:.1f} ms")
    rows.group = "robot stop"
    took, times = _stops(STOPS // share), STOPS // share
    value = f"{1e3 * np.median(took):.0f} / {1e3 * max(took):.0f} ms"
    name, met = (
        f"last byte to 1 % speed, at full alignment speed, {times} stops: median / worst",
        max(took) <= MAX_STOP_S,
    )
    rows.add(name, value, f"<= {1e3 * MAX_STOP_S:.0f} ms", met)
    travelled = _drilling_stops(max(DRILLING_STOPS // share, 2))
    name = f"tip travel after the last byte, while drilling, worst of {len(travelled)}"
    rows.number(name, max(travelled), unit="mm", most=MAX_TRAVEL_MM)
    rows.group, times = "robot link faults", FAULTS // share
    killed, worst_s = _killed_clients(times)
    for names, harmful, peer in (
        (KINDS, _bad_bytes(times), ""),
        (("two clients commanding", "client killed in every state", "server killed and restarted"),
         [_two_clients(times), killed, _restarts(times)], f"killed: noticed in {1e3 * worst_s:.0f} ms"),
    ):  # fmt: skip
        value = " / ".join(str(times - wrong) for wrong in harmful)
        rows.add(f"{', '.join(names)}: harmless", f"{value} of {times} each", f"{times}", not any(harmful), peer=peer)
    return rows


def _ready(robot: RobotClient) -> None:
    robot.start_up()
    robot.calibrate(T_MCS_CFCS, 10.0)
    robot.aim(wire(), metadata(), 10.0)


Use = Callable[[RobotClient, Callable[[], bool]], int]  # of a robot, as long as there is time; how often


def _loop(seconds: float, use: Use) -> tuple[int, int, float, int]:
    """Return the number of cycles, of late ones, the latest one, s, and how often the robot was used."""
    with _process() as port, RobotClient(port=port) as robot:
        _ready(robot)
        first, end = robot.stream("arm/cycles").body.values, time.monotonic() + seconds
        times = use(robot, lambda: time.monotonic() < end)
        last = robot.stream("arm/cycles").body.values
    count, missed = (last - first)[:2].astype(int)
    return count, missed, last[2], times


def _drilled(robot: RobotClient, is_time: Callable[[], bool]) -> int:
    """Move and drill while a client streams."""
    with suppress(RobotRefusedError):
        robot.align()
        while robot.drill() == "PAUSED" and is_time():
            pass
    while is_time():
        robot.stream("arm/measured_js")
    return 1


def _retargeted(robot: RobotClient, is_time: Callable[[], bool]) -> int:
    """Let one target after the other be looked at for collisions."""
    targets = 0
    while is_time():
        robot.aim(wire(), metadata(), 10.0)
        targets += 1
    return targets


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
    return 1 - sum(each > LATE_S for each in late) / len(late)


@contextmanager
def _process() -> Iterator[int]:
    """Yield the port of `sightline robot serve` in a separate process."""
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]

    def answers() -> bool:
        with suppress(LinkError):
            BlockingClient(port=port).close()
            return True
        return False

    command = [str(Path(sys.executable).with_name("sightline")), "robot", "serve", "--port", str(port)]
    with subprocess.Popen([*command, "--frame-serial", "SN-7", "--quiet"]) as process:
        try:
            assert _within(answers, 120.0)
            yield port
        finally:
            process.terminate()


class _Watched:
    """A served robot whose simulator's true joint speeds are read, which the loop cannot see."""

    def __init__(self, server: RobotServer) -> None:
        self.server, self.body = server, server._plant._body
        self.dof = np.array([self.body._model.joint(name).dofadr[0] for name in JOINTS])
        self.full = ROBOT.manipulator.speed * np.array([unit(joint) for joint in range(len(JOINTS))])

    @property
    def speed(self) -> np.ndarray:
        """Speed of each joint, of its full one."""
        return np.abs(self.body._data.qvel[self.dof]) / self.full

    def stop(self, joints: slice) -> tuple[float, float]:
        """Return the wall time, s, from a stop's last byte to below 1 % of full speed, and the tip's travel, mm."""
        with BlockingClient(port=self.server.port) as own:
            data, before = encode(Message(String("STOP"), "CMD_STOP")), self.body.encoders()
            own._socket.sendall(data)
            began = time.monotonic()
            while (self.speed > 0.01)[joints].any():
                assert time.monotonic() - began < 1.0
                time.sleep(0.0002)
            took = time.monotonic() - began
            tip = ROBOT.manipulator.T_mcs_tool(np.stack([before, self.body.encoders()])).translation
        return took, float(np.linalg.norm(tip[1] - tip[0]))


@contextmanager
def _moving(action: Callable[[], object]) -> Iterator[None]:
    """Let a client move the robot in another thread."""

    def quietly() -> None:
        with suppress(RobotRefusedError, LinkError):
            action()

    motion = threading.Thread(target=quietly)
    motion.start()
    yield
    motion.join()


def _stops(times: int) -> list[float]:
    """Return the times, s, of stops at full alignment speed."""
    took, rng = [], np.random.default_rng(1)
    for _ in range(times):
        with served() as server, RobotClient(port=server.port) as robot:
            watched = _Watched(server)
            _ready(robot)
            with _moving(robot.align):
                while watched.speed.max() < 0.98:
                    time.sleep(0.001)
                time.sleep(rng.uniform(0.0, 0.05))
                took.append(watched.stop(slice(None))[0])
    return took


def _drilling_stops(times: int) -> list[float]:
    """Return the travels of the tip, mm, after stops while drilling."""
    travelled = []
    with served() as server, RobotClient(port=server.port) as robot:
        watched = _Watched(server)
        for _ in range(times):
            _ready(robot)
            robot.align()
            with _moving(robot.drill):
                while (server.dialogue.controller.machine.snapshot().depth_mm or -20.0) < 0.5:
                    time.sleep(0.01)
                travelled.append(watched.stop(slice(FEED, FEED + 1))[1])
    return travelled


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


def _bad_bytes(times: int) -> list[int]:
    """Send damaged RETRACT commands: the robot must move only for complete messages, even in two pieces."""
    harmful, rng = [0] * len(KINDS), np.random.default_rng(2)
    with served(virtual=True) as server:
        controller, moved = server.dialogue.controller, server._plant
        for k in range(len(KINDS) * times):
            kind = KINDS[k // times]
            moved.q[FEED] = 30.0
            with BlockingClient(port=server.port) as raw:
                _lead(raw, ["START_UP"])
                before = moved.q.copy()
                for piece in _bad(kind, rng):
                    raw._socket.sendall(piece)
                    time.sleep(0.0005)
                if kind == "split anywhere":
                    wrong = not _within(lambda: bool((moved.q != before).any()), 2.0)  # noqa: B023
                else:
                    time.sleep(0.002)
                    wrong = controller.machine.state in MOVING or bool((moved.q != before).any())
            harmful[k // times] += wrong or not _within(lambda: _rests(server), 2.0)
    return harmful


def _rests(server: RobotServer) -> bool:
    controller = server.dialogue.controller
    return controller.machine.state is State.UNDEFINED and not controller.busy


def _lead(raw: BlockingClient, commands: list[str]) -> None:
    """Send commands, with a registration or a target after those that need one; wait for the last one's answer."""
    bodies = {"CALIBRATION": (Transform.of(T_MCS_CFCS.inv()), "CLB_1"), "TARGETING": (Transform.of(wire()), "TGT_1")}
    for number, command in enumerate(commands, 1):
        raw.send(Message(String(command), f"CMD_{number}"))
        if command in bodies:
            told = metadata() if command == "TARGETING" else {}
            raw.send(Message(*bodies[command], version=2, metadata=told))
    last = "TARGET" if commands[-1] == "TARGETING" else commands[-1]
    while (event := raw.receive(5.0)) is not None:
        if isinstance(event, Message) and event.device_name == last and isinstance(event.body, Status):
            assert event.body.code == 1
            return
    raise AssertionError(f"no {last}")


def _two_clients(times: int) -> int:
    wrong = 0
    with served(virtual=True) as server:
        controller = server.dialogue.controller
        for _ in range(times):
            with BlockingClient(port=server.port) as first, BlockingClient(port=server.port) as second:
                _lead(first, ["START_UP"])
                second.send(Message(String("RETRACT"), "CMD_9"))
                code = None
                while code is None and (event := second.receive(2.0)) is not None:
                    answer = isinstance(event, Message) and isinstance(event.body, Status)
                    if answer and event.device_name != "CURRENT_STATUS":
                        code = event.body.code
                wrong += code != 5 or controller.machine.state is not State.START_UP
            wrong += not _within(lambda: controller.lease is None, 2.0)
    return wrong


def _killed_clients(times: int) -> tuple[int, float]:
    """Kill clients in turn while the robot rests, aligns, drills and retracts; return also the latest notice, s."""
    wrong, worst_s, states = 0, 0.0, (State.TARGETING, *MOVING)
    with served(virtual=True) as server:
        machine = server.dialogue.controller.machine
        for k in range(times):
            state, raw = states[k % len(states)], BlockingClient(port=server.port)
            _lead(raw, ["START_UP", "CALIBRATION", "TARGETING"])
            if state is not State.TARGETING:
                raw.send(Message(String("MOVE_TO_TARGET"), "CMD_4"))
            if state in (State.DRILL, State.RETRACT):
                assert _within(lambda: machine.state is State.ALIGNED, 20.0)
                raw.send(Message(String(state.value), "CMD_5"))
            _within(lambda state=state: machine.state is state, 2.0)
            raw._socket.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
            began = time.monotonic()
            raw.close()
            wrong += not _within(lambda: _rests(server), 2.0) or bool(np.abs(server._plant.goal).max() != 0)
            worst_s = max(worst_s, time.monotonic() - began)
    return wrong, worst_s


def _restarts(times: int) -> int:
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
    return wrong


def _within(condition: Callable[[], bool], seconds: float) -> bool:
    end = time.monotonic() + seconds
    while not condition():
        if time.monotonic() > end:
            return False
        time.sleep(0.0005)
    return True
