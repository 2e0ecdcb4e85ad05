"""An arm with a controller of its own behind the link: aligned, held, stopped, its fault told; and its command."""

import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from tests.robot.arms import ARM_SETUP, SIX, FollowingArm, Streamed, at_images, calibrated, robot_file
from tests.robot.rig import END_MM, ENTRY_MM, ROBOT, metadata, served, wait_for, wire
from tests.robot.test_robot_server import at_mid_motion, client_of
from typer.testing import CliRunner

from sightline.cli import commands
from sightline.errors import RobotRefusedError
from sightline.rehearsal.operation import start_of
from sightline.robot import contract
from sightline.robot.arms.adapter import HOLD_S
from sightline.robot.control.states import State
from sightline.robot.kinematics.designs import ARM_SPEED_RAD_S
from sightline.robot.kinematics.target import STANDOFF_MM
from sightline.robot.link.client import RobotClient
from sightline.robot.link.server import RobotServer
from sightline.robot.plant import CYCLE_S

Served = tuple[FollowingArm, RobotServer, RobotClient]


@contextmanager
def aimed(halted: State | None = None) -> Iterator[Served]:
    """A six-axis arm, its server and a client that has sent it a target."""
    arm = FollowingArm(at_images(SIX))
    robot = (calibrated(SIX), Streamed(arm), ARM_SETUP)
    with served(virtual=True, halted=halted, arm=robot) as server, client_of(server) as client:
        client.start_up()
        client.calibrate(SIX.T_mcs_cfcs(at_images(SIX)), 10.0)
        client.aim(wire(), metadata(), 10.0)
        yield arm, server, client


def test_an_arm_brings_its_guide_to_the_plan_and_holds_it():
    with aimed() as (arm, _, client):
        client.align()
        client.guide()
        assert client.status().text.startswith("GUIDE")
        along = (END_MM - ENTRY_MM) / np.linalg.norm(END_MM - ENTRY_MM)
        held = SIX.T_mcs_cfcs(at_images(SIX)).inv() * SIX.T_mcs_tool(arm.state().encoders)
        assert np.allclose(held.translation, ENTRY_MM - STANDOFF_MM * along, atol=0.05)
        assert np.allclose(held.rotation.apply([0.0, 0.0, 1.0]), along, atol=1e-4)


def test_the_fault_of_its_controller_is_the_robot_s():
    with aimed(halted=State.ALIGN) as (arm, server, client), client_of(server) as other:
        spoiling = at_mid_motion(server, lambda: (setattr(arm, "spoil", "fault"), other.status()))
        with pytest.raises(RobotRefusedError, match="joint 3: protective stop"):
            client.align()
        spoiling.join()
        assert "joint 3: protective stop" in client.status().text


def test_a_stop_brings_it_to_rest_within_a_tenth_of_a_second():
    with aimed(halted=State.ALIGN) as (arm, server, client):
        moving: list[np.ndarray] = []
        stopping = at_mid_motion(server, lambda: (moving.append(arm.state().encoders), client.stop()))
        with pytest.raises(RobotRefusedError, match="stopped by a client's STOP"):
            client.align()
        stopping.join()
        wait_for(lambda: not server.dialogue.controller.busy)
        way = np.abs(arm.state().encoders - moving[0]).max()
        assert 0 < way < ARM_SPEED_RAD_S * (FollowingArm.LATE_S + 2 * CYCLE_S + HOLD_S / 2)


def serve(*given: object, say: str = "") -> str:
    done = CliRunner().invoke(commands, ["robot", "serve", *map(str, given)], input=say)
    assert done.exit_code in (2, 3), done.output
    return done.stderr


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("robot") / "robot.json"
    robot_file(SIX).write(made)
    return made


def test_a_person_confirms_the_set_up_of_an_arm_that_is_served(file):
    """With a block: not on the flange, and the hip where it is said to be."""
    command = [
        sys.executable,
        "-m",
        "sightline",
        "robot",
        "serve",
        str(file),
        "--arm",
        "sim",
        "--attached",
        "--port",
        "0",
    ]
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    with subprocess.Popen(command, **pipes) as process:  # noqa: S603 - our own program
        process.stdin.write("y\nn\n0 77 -22\ny\n")
        process.stdin.flush()
        while not (line := process.stdout.readline()).startswith("{"):
            assert line, process.stderr.read()
        with RobotClient(port=int(line[9:-2])) as client:
            assert contract.HAS_GUIDE in client.capabilities
            assert not client.simulated
            assert np.allclose(client.joints()[0], start_of(SIX, "right"), atol=1e-5)
        said = process.communicate()[1]
    assert process.returncode == 0
    assert "Robot R-1 at the simulator: right side, frame SN-7 on its flange" in said


def test_what_is_not_confirmed_or_contradicts_itself_is_not_served(file, tmp_path):
    assert "not confirmed" in serve(file, "--arm", "sim", say="n\n")
    assert "is not a place" in serve(file, "--arm", "sim", say="y\nn\n0 77 nan\ny\n")
    assert "robot serve robot.json --arm ros2 NAMESPACE" in serve(file, "--arm", "ros2")
    assert "robot serve robot.json --arm sim" in serve("--arm", "sim")
    for contradiction in (("--virtual",), ("--side", "left"), ("--frame", "block60"), ("--dialect", "brp2013")):
        assert "belong to simulators" in serve(file, "--arm", "sim", *contradiction)
    assert "needs --arm sim" in serve(file)
    (tmp_path / "fed.json").write_text(robot_file(ROBOT.manipulator).model_dump_json(by_alias=True))
    assert "without a feed" in serve(tmp_path / "fed.json", "--arm", "sim", say="y\ny\ny\n")


@pytest.mark.parametrize(("kind", "module"), [("franka", "franky"), ("ros2", "rclpy")])
def test_without_its_extra_an_arm_is_not_served(file, monkeypatch, kind, module):
    monkeypatch.setitem(sys.modules, module, None)  # as if it were not installed
    assert f"pip install 'sightline[{kind}]'" in serve(file, "--arm", kind, "somewhere", say="y\ny\ny\n")
