"""The robot's controller: timing of the loop, stopping time, and the effect of damaged bytes and lost peers.

Times are wall time. For the loop's timing the robot is a separate process; otherwise robot and client share one. What
does no harm is judged by the tests of the link, run many times.
"""

import json
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress

import numpy as np
from tests.robot.igtl_faults import FAULTS
from tests.robot.rig import ROBOT, T_MCS_CFCS, metadata, served, wire
from tests.robot.test_controller import test_only_the_holder_of_the_lease_commands as commanded_by_two
from tests.robot.test_robot_server import test_a_client_that_is_killed as client_killed
from tests.robot.test_robot_server import test_a_server_that_ends_and_starts_again as server_restarted

from benchmarks.harness import Rows
from sightline.errors import LinkError, RobotRefusedError, SightlineError
from sightline.robot.control.states import MOVING, State
from sightline.robot.igtl import Message, String, encode
from sightline.robot.kinematics.designs import FEED, JOINTS
from sightline.robot.link.client import RobotClient
from sightline.robot.link.server import LATE_S, PRIORITY, SWITCH_S, RobotServer, prefer_this_thread
from sightline.robot.plant import CYCLE_S
from sightline.robot.transport import BlockingClient
from sightline.twin.robot.mjcf import unit

LOOP_S, STOPS, DRILLING_STOPS, DAMAGED, LOST = 60.0, 30, 10, 500, 200
MIN_PUNCTUAL, MAX_STOP_S, MAX_TRAVEL_MM = 0.999, 0.05, 0.1
KINDS = ("byte flipped", "truncated", "split anywhere", "wrong CRC", "wrong size", "unknown type")
STATES = (State.TARGETING, *MOVING)
SERVE = ("-m", "sightline", "robot", "serve", "--attached", "--port", "0", "--frame-serial", "SN-7", "--quiet")


def run(share: int) -> Rows:
    """Return the rows; `share`: the part of the trials that is done is one over it."""
    sys.setswitchinterval(SWITCH_S)
    rows, seconds = Rows("robot loop"), LOOP_S / share
    count, missed, _ = _loop(seconds, _drilled)
    kept, empty = 1 - missed / count, _empty_loop(seconds / 3)
    name = f"cycles within 1 ms, {count:,.0f} at 200 Hz, a client streaming"
    rows.number(name, 100 * kept, ".3f", "%", least=100 * MIN_PUNCTUAL, peer=f"an empty loop here {empty:.3%}")
    count, missed, latest_s = _loop(seconds / 2, lambda robot: robot.aim(wire(), metadata(), 10.0))
    name = f"cycles within 1 ms, {count:,.0f} at 200 Hz, while targets are looked at for collisions"
    rows.number(name, 100 * (1 - missed / count), ".3f", "%", peer=f"the latest cycle {1e3 * latest_s:.1f} ms")
    rows.group, took = "robot stop", _stops(STOPS // share)
    name = f"last byte to 1 % speed, at full alignment speed, {len(took)} stops: median / worst"
    value, met = f"{1e3 * np.median(took):.0f} / {1e3 * max(took):.0f} ms", max(took) <= MAX_STOP_S
    rows.add(name, value, f"<= {1e3 * MAX_STOP_S:.0f} ms", met)
    travelled = _drilling_stops(max(DRILLING_STOPS // share, 2))
    name = f"tip travel after the last byte, while drilling, worst of {len(travelled)}"
    rows.number(name, max(travelled), unit="mm", most=MAX_TRAVEL_MM)
    rows.group, rng = "robot link faults", np.random.default_rng(2)
    _add_harmless(rows, {kind: lambda _, kind=kind: FAULTS[kind](rng) for kind in KINDS}, DAMAGED // share)
    trials = {
        "two clients commanding": lambda _: commanded_by_two(),
        "client killed in every state": lambda k: client_killed(STATES[k % len(STATES)]),
        "server killed and restarted": lambda _: server_restarted(),
    }
    _add_harmless(rows, trials, LOST // share)
    return rows


def _add_harmless(rows: Rows, trials: dict[str, Callable[[int], object]], times: int) -> None:
    """Add how many tries of each kind did no harm: a trial that does some fails or returns False."""
    good = dict.fromkeys(trials, 0)
    for name, trial in trials.items():
        for k in range(times):
            with suppress(AssertionError, SightlineError):
                good[name] += trial(k) is not False
    value = f"{' / '.join(map(str, good.values()))} of {times} each"
    rows.add(f"{', '.join(trials)}: harmless", value, f"{times}", set(good.values()) == {times})


def _ready(robot: RobotClient) -> None:
    robot.start_up()
    robot.calibrate(T_MCS_CFCS, 10.0)
    robot.aim(wire(), metadata(), 10.0)


def _loop(seconds: float, use: Callable[[RobotClient], object]) -> tuple[float, float, float]:
    """Return the numbers of cycles and of late ones, and the latest one, s, while a robot is used again and again."""
    with server(*SERVE) as port, RobotClient(port=port) as robot:
        _ready(robot)
        first, end = robot.stream("arm/cycles").body.values, time.monotonic() + seconds
        while time.monotonic() < end:
            use(robot)
        last = robot.stream("arm/cycles").body.values
    return *(last - first)[:2], last[2]


def _drilled(robot: RobotClient) -> None:
    """Move, drill or, when this is done, listen to the streams."""
    with suppress(RobotRefusedError):
        robot.align()
    with suppress(RobotRefusedError):
        robot.drill()
    robot.stream("arm/measured_js")


@contextmanager
def server(*arguments: str) -> Iterator[int]:
    """Yield the port that a program prints."""
    command = [sys.executable, *arguments]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            printed = json.loads(process.stdout.readline())
            yield printed["port"] if isinstance(printed, dict) else printed
        finally:
            process.kill()


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
