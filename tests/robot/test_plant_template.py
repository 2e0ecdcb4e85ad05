"""A wire drilled through the plant of examples/plant_template.py, on a simulated clock."""

import importlib.util
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from tests.robot.rig import END_MM, IMAGED, ROBOT, T_MCS_CFCS, Rig, code, metadata, wire

from sightline.robot.control.states import State
from sightline.robot.igtl import Transform
from sightline.robot.plant import CYCLE_S, WATCHDOG_S, PlantFlag, Reading

EXAMPLE = Path(__file__).parents[2] / "examples" / "plant_template.py"
LENGTH_MM = 12.0  # its end is 10 mm beyond the pause: a short wire shows both


class Driven:
    """The example's plant, its loop turned by the test instead of by its thread."""

    def __init__(self, example) -> None:
        self.clock_s = 0.0
        example.time = SimpleNamespace(monotonic=lambda: self.clock_s)
        self.motors = example.Motors(IMAGED.copy())
        self.plant = example.MotorPlant(self.motors, ROBOT.manipulator)
        self.turns = True

    def advance(self, dt_s: float) -> None:
        self.clock_s += dt_s
        if self.turns:
            self.plant.cycle()

    def read(self) -> Reading:
        return self.plant.read()

    def command(self, joint_velocity: np.ndarray, drill_on: bool) -> None:
        self.plant.command(joint_velocity, drill_on)

    def hold(self) -> None:
        self.plant.hold()


@pytest.fixture
def driven() -> Driven:
    spec = importlib.util.spec_from_file_location("plant_template", EXAMPLE)
    example = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(example)
    return Driven(example)


def aimed(driven: Driven) -> tuple[Rig, np.ndarray]:
    """A robot that holds a target, and the wire's direction, CFCS."""
    rig = Rig(moved=driven)
    along = wire().rotation.apply([0.0, 0.0, 1.0])
    rig.reach(State.CALIBRATION)
    assert code(rig.send("CLB_1", Transform.of(T_MCS_CFCS.inv()))) == 1
    rig.command("TARGETING")
    said = metadata(length_mm=repr(LENGTH_MM), depth_limit_mm=repr(LENGTH_MM + 1.0))
    sent = Transform.of(wire(END_MM - LENGTH_MM * along, END_MM))
    assert code(rig.send("TGT_1", sent, version=2, metadata=said), "TARGET") == 1
    return rig, along


def tip(driven: Driven) -> np.ndarray:
    """(3,) CFCS, by the motors themselves."""
    return T_MCS_CFCS.inv().apply(ROBOT.manipulator.T_mcs_tool(driven.motors.position).translation)


def test_a_wire_is_drilled_through_it(driven):
    rig, along = aimed(driven)
    for command, state, depth_mm in (
        ("MOVE_TO_TARGET", State.ALIGNED, -20.0),
        ("DRILL", State.PAUSED, LENGTH_MM - 10.0),
        ("DRILL", State.DONE, LENGTH_MM),
    ):
        rig.command(command)
        rig.run(0.5)
        assert driven.motors.drill is (command == "DRILL")
        rig.run_until(state)
        assert not driven.motors.drill
        assert tip(driven) == pytest.approx(END_MM + (depth_mm - LENGTH_MM) * along, abs=0.05)


def test_its_motors_stop_where_nobody_commands_them(driven):
    rig, _ = aimed(driven)
    rig.command("MOVE_TO_TARGET")
    rig.run(0.5)
    driven.advance(WATCHDOG_S)
    before = driven.motors.position
    for _ in range(20):
        driven.advance(CYCLE_S)
    assert np.array_equal(driven.motors.position, before)


@pytest.mark.parametrize(
    ("change", "ends", "flag"),
    [({"stop_pressed": True}, State.EMERGENCY, PlantFlag.STOP_PRESSED), ({"run_held": False}, State.STOP, None)],
    ids=["stop button", "hold-to-run"],
)
def test_its_switches_end_a_motion(driven, change, ends, flag):
    rig, _ = aimed(driven)
    rig.command("MOVE_TO_TARGET")
    rig.run(0.5)
    for name, value in change.items():
        setattr(driven.motors, name, value)
    before = driven.motors.position
    rig.run(0.1)
    assert np.array_equal(driven.motors.position, before)
    assert rig.state is ends
    assert flag is None or driven.read().flags & flag


def test_a_loop_that_hangs_is_noticed(driven):
    rig, _ = aimed(driven)
    rig.command("MOVE_TO_TARGET")
    rig.run(0.5)
    driven.turns = False
    rig.run(0.06)
    assert rig.state is State.EMERGENCY
    assert "no sample from the drives" in rig.controller.machine.fault.text
