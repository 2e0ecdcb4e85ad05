"""A robot for tests: simulated, with a client beside it, and a target that it can reach."""

import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from copy import deepcopy
from dataclasses import replace
from functools import cache
from typing import Any
from unittest.mock import patch

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from sightline.rehearsal.operation import calibrated_robot
from sightline.robot import contract
from sightline.robot.control.controller import Controller
from sightline.robot.control.insertion import Setup
from sightline.robot.control.requests import Panel
from sightline.robot.control.states import State
from sightline.robot.igtl import Capability, Message, Status, String, Transform
from sightline.robot.kinematics.calibrated import CalibratedRobot
from sightline.robot.kinematics.manipulator import Manipulator
from sightline.robot.link import client, exchange
from sightline.robot.link.dialogue import Dialogue
from sightline.robot.link.outgoing import SIGHTLINE, Dialect
from sightline.robot.link.server import RobotServer, Simulation
from sightline.robot.plant import CYCLE_S, PlantFlag, Reading
from sightline.twin.robot.plant import SimulatedPlant

IMAGED = np.array([3.0, -5.0, np.pi / 4, 0.0, 0.5])  # joints at the images
# CFCS; shorter than a wire in a hip, since drilling takes a second for each millimetre
ENTRY_MM, END_MM = np.array([35.0, 31.0, -4.0]), np.array([7.7, 2.3, 1.1])
SETUP = Setup("right", "SN-7", into_bone=False, frame="gamma/SN-7#1")  # its wire is in air
ROBOT = calibrated_robot()
T_MCS_CFCS = ROBOT.manipulator.T_mcs_cfcs(IMAGED)
CLIENT, BEAT = 1, String("")
BUSY_S = 60.0  # other programs keep a process from the processor for no longer


def wire(entry_mm: np.ndarray = ENTRY_MM, end_mm: np.ndarray = END_MM) -> RigidTransform:
    """Pose at the end point: +z along the wire."""
    z = (end_mm - entry_mm) / np.linalg.norm(end_mm - entry_mm)
    x = np.cross([0.0, 0.0, 1.0], z)
    x /= np.linalg.norm(x)
    return RigidTransform.from_components(end_mm, Rotation.from_matrix(np.stack([x, np.cross(z, x), z], axis=1)))


def metadata(**changed: str) -> dict[str, str]:
    """Of a plan that is in order."""
    length = float(np.linalg.norm(END_MM - ENTRY_MM))
    plan = {"plan": "plan-1", "side": "right", "frame_serial": "SN-7", "go": "yes", "units": "mm"}
    plan |= {"coordinates": "CFCS", "length_mm": repr(length), "depth_limit_mm": repr(length + 1.0), "valid_s": "500"}
    return plan | changed


class IdealPlant:
    """A `Plant` in air whose joints do at once what their acceleration allows: quick, where physics does not matter."""

    def __init__(self, robot: Manipulator = ROBOT.manipulator, q: np.ndarray = IMAGED) -> None:
        self.robot = robot
        self.stop_pressed, self.run_held = False, True
        self.time_s, self.q = 0.0, q.copy()
        self.velocity, self.goal = np.zeros_like(q), np.zeros_like(q)

    def read(self) -> Reading:
        resolution = self.robot.resolution
        flags = PlantFlag.RUN_HELD if self.run_held else PlantFlag.NONE
        flags |= PlantFlag.STOP_PRESSED if self.stop_pressed else PlantFlag.NONE
        return Reading(self.time_s, np.round(self.q / resolution) * resolution, 0.0, flags)

    def command(self, joint_velocity: np.ndarray, drill_on: bool) -> None:
        assert np.isfinite(joint_velocity).all()
        speed = self.robot.speed
        self.goal = np.minimum(np.maximum(joint_velocity, -speed), speed)

    def hold(self) -> None:
        self.goal = np.zeros_like(self.q)

    def advance(self, dt_s: float) -> None:
        step = self.robot.acceleration * dt_s
        goal = self.goal if self.run_held and not self.stop_pressed else np.zeros_like(self.q)
        before = self.velocity
        self.velocity = before + np.minimum(np.maximum(goal - before, -step), step)
        self.q = self.q + dt_s * (before + self.velocity) / 2
        self.time_s += dt_s


def plant(seed: int = 0) -> SimulatedPlant:
    """The simulated robot, in air."""
    return SimulatedPlant(ROBOT.manipulator, None, np.random.default_rng(seed), start=IMAGED)


class Rig:
    """Controller, plant and dialogue without a link; time passes in `run`. Silence counts from the first `beat`."""

    def __init__(
        self,
        key_switch: bool = False,
        moved: SimulatedPlant | IdealPlant | None = None,
        setup: Setup = SETUP,
        dialect: Dialect = SIGHTLINE,
        robot: CalibratedRobot = ROBOT,
    ) -> None:
        self.plant, self.panel = moved or IdealPlant(), Panel(key_switch=key_switch)
        self.controller = Controller(robot, self.plant, setup, self.panel)
        self.controller.machine.lease.watches = False
        # `run` leaves telemetry aside, whose poses take half of all time.
        self.dialogue = Dialogue(self.controller, telemetry_s=1.0, dialect=dialect)
        self.now_s, self.number = 0.0, 0  # of the newest command
        self.dialogue.joined(CLIENT)
        self.said: list[Message] = []
        self.run(0.1)

    @property
    def state(self) -> State:
        return self.controller.machine.state

    def send(self, name: str, body, client: int = CLIENT, **header) -> list[Message]:
        """What comes back at once."""
        out = self.dialogue.receive(client, Message(body, name, **header), self.now_s)
        return [o.message for o in out if o.client == client]

    def command(self, text: str, client: int = CLIENT) -> list[Message]:
        self.number += 1
        return self.send(f"CMD_{self.number}", String(text), client)

    def beat(self, promise: String | Capability | None = BEAT) -> None:
        """Silence counts from now on, for the client only if it sends a heartbeat or promises them."""
        self.controller.machine.lease.watches = True
        if promise is not None:
            self.send(contract.HEARTBEAT, promise)

    def run(self, seconds: float) -> list[Message]:
        """Return the messages sent meanwhile, without telemetry."""
        said = []
        for _ in range(round(seconds / CYCLE_S)):
            self.now_s += CYCLE_S
            self.plant.advance(CYCLE_S)
            said += [o.message for o in self.dialogue.cycle(self.now_s) if not o.telemetry]
        return said

    def run_until(self, state: State, at_most_s: float = 120.0) -> list[Message]:
        said, end = [], self.now_s + at_most_s
        while self.state is not state:
            assert self.now_s < end, f"still {self.state}, not {state}"
            said += self.run(CYCLE_S)
        return said

    def run_until_depth(self, depth_mm: float) -> None:
        while self.controller.machine.snapshot().depth_mm < depth_mm:
            self.run(CYCLE_S)

    @staticmethod
    def at(state: State) -> "Rig":
        """One that was brought to a state by commands."""
        return deepcopy(_brought(state))

    def reach(self, state: State) -> None:
        """By commands, from UNDEFINED."""
        self.go(_WAY[state])
        assert self.state is state

    def go(self, way: tuple) -> None:
        """The steps of a way."""
        for step in way:
            if isinstance(step, State):
                self.run_until(step)
            elif step == "CLB":
                assert code(self.send("CLB_1", Transform.of(T_MCS_CFCS.inv()))) == 1
            elif step == "TGT":
                said = self.send("TGT_1", Transform.of(wire()), version=2, metadata=metadata())
                assert code(said, "TARGET") == 1, said
            else:
                self.command(step)
                self.run(0.2 if step in ("STOP", "EMERGENCY") else 0.0)

    def reads(self, **changed) -> None:
        """From now on samples have these values, or what a function makes of the plant's own reading."""
        real = type(self.plant).read

        def read() -> Reading:
            reading = real(self.plant)
            return replace(reading, **{k: value(reading) if callable(value) else value for k, value in changed.items()})

        self.plant.read = read

    def speed(self) -> float:
        """Largest joint speed as a share of the joint's full speed, over the last cycles."""
        return float(np.max(np.abs(self.controller.machine.snapshot().velocity) / ROBOT.manipulator.speed))


_READY = ("START_UP", "CALIBRATION", "CLB", "TARGETING", "TGT")
_ALIGNED = (*_READY, "MOVE_TO_TARGET", State.ALIGNED)
_PAUSED = (*_ALIGNED, "DRILL", State.PAUSED)
_DONE = (*_PAUSED, "DRILL", State.DONE)
_WAY: dict[State, tuple] = {
    State.UNDEFINED: (),
    State.START_UP: ("START_UP",),
    State.PLANNING: ("START_UP", "PLANNING"),
    State.CALIBRATION: ("START_UP", "CALIBRATION"),
    State.TARGETING: _READY,
    State.MANUAL: ("START_UP", "MANUAL"),
    State.STOP: (*_READY, "STOP"),
    State.EMERGENCY: ("START_UP", "EMERGENCY"),
    State.ALIGN: (*_READY, "MOVE_TO_TARGET"),
    State.ALIGNED: _ALIGNED,
    State.DRILL: (*_ALIGNED, "DRILL"),
    State.PAUSED: _PAUSED,
    State.DONE: _DONE,
    State.GUIDE: (*_ALIGNED, "GUIDE"),
    State.RETRACT: (*_ALIGNED, "RETRACT"),
}


@cache
def _brought(state: State) -> Rig:
    """From the state that lies last on its way, which was reached already."""
    way = _WAY[state]
    earlier = [one for one in _WAY if one is not state and way[: len(_WAY[one])] == _WAY[one]]
    last = max(earlier, key=lambda one: len(_WAY[one]), default=None)
    rig = Rig() if last is None else Rig.at(last)
    rig.go(way[0 if last is None else len(_WAY[last]) :])
    assert rig.state is state
    return rig


def code(said: list[Message], name: str | None = None) -> int | None:
    """Code of the last STATUS, of a name if one is given."""
    found = [m.body.code for m in said if isinstance(m.body, Status) and name in (None, m.device_name)]
    return found[-1] if found else None


@contextmanager
def served(
    *,
    virtual: bool = False,
    ideal: bool = False,
    port: int = 0,
    key_switch: bool = False,
    halted: State | None = None,
    arm: tuple[CalibratedRobot, Any, Setup] | None = None,
) -> Iterator[RobotServer]:
    """The robot behind a port. On a busy machine an answer may take longer than a client waits; here it may. `ideal`:
    an IdealPlant, in real time. `arm`: another robot, its plant and set-up.

    `halted`: virtual time stands still in this state, in mid-motion, until a client says something; `mid_motion` waits
    for that."""
    robot, moved, setup = arm or (ROBOT, IdealPlant() if virtual or ideal else plant(), SETUP)
    controller = Controller(robot, moved, setup, Panel(key_switch=key_switch))
    cycles = 0

    def advance(dt_s: float) -> None:
        nonlocal cycles
        cycles = cycles + 1 if controller.machine.state is halted else 0
        if cycles == _INTO_MOTION:
            _halted.add(server)
            while not (len(server._inbox) or server._end.is_set()):
                time.sleep(0.001)
            _halted.discard(server)
        moved.advance(dt_s)

    with ExitStack() as stack:
        for module in (client, exchange):
            stack.enter_context(patch.object(module, "ACK_S", BUSY_S))
            stack.enter_context(patch.object(module, "STATUS_S", BUSY_S))
        server = stack.enter_context(RobotServer(controller, moved, Simulation(advance, virtual), port=port))
        yield server


_INTO_MOTION = 20  # cycles: the joints move by then
_halted: set[RobotServer] = set()


def mid_motion(server: RobotServer) -> None:
    """Wait, if asked, until the server's virtual time stands still."""
    wait_for(lambda: server in _halted)


def wait_for(condition: Callable[[], bool]) -> None:
    """Until it holds. The limit is there to end a test that would never end."""
    end = time.monotonic() + BUSY_S
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.002)
