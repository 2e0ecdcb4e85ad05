"""The rehearsal's robot as a process: it listens, tells simulated imaging devices the truth, and surely ends."""

import os
import signal
import sys
import time
from subprocess import PIPE, Popen
from threading import Timer

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation
from tests.systems import needs_posix

from sightline.errors import LinkError, RobotRefusedError
from sightline.frame import Frame
from sightline.rehearsal.process import RobotProcess
from sightline.rehearsal.rehearsal import Rehearsal
from sightline.robot.link.client import RobotClient

pytest.importorskip("mujoco")
SEED = 9


def gone(pid: int, within_s: float = 10.0) -> bool:
    end = time.monotonic() + within_s
    while time.monotonic() < end:
        try:
            os.kill(pid, 0)
        except ProcessLookupError:
            return True
        time.sleep(0.05)
    return False


@pytest.mark.slow
def test_it_is_the_robot_of_the_rehearsal_and_ends_with_its_block():
    rehearsal = Rehearsal.draw(SEED, Frame.load("gamma"))
    theatre = rehearsal.theatre()
    with RobotProcess(SEED, virtual=True) as process:
        with RobotClient(port=process.port) as robot:
            assert robot.simulated
            assert robot.status().error_name == "UNDEFINED"
            np.testing.assert_allclose(robot.joints()[0], theatre.imaged, atol=1e-9)
            wire = robot.simulated_wire()
            assert np.abs((wire.T_mcs_cfcs.inv() * theatre.T_mcs_cfcs).as_matrix() - np.eye(4)).max() < 1e-6
            np.testing.assert_allclose(wire.wire_mm, theatre.wire.wire_mm, atol=0.02)  # gravity creeps in the play
        assert process.alive
    assert not process.alive
    process.close()


@needs_posix
@pytest.mark.slow
def test_a_controller_that_is_killed_while_it_moves():
    """Its client notices; another start knows nothing, says so, and moves nothing. (Drives stop by their watchdog:
    tests/twin/test_simulated_plant.py.)"""
    wire = Rehearsal.draw(SEED, Frame.load("gamma")).hip.wire_mm
    z = (wire[1] - wire[0]) / np.linalg.norm(wire[1] - wire[0])
    turned = Rotation.align_vectors([z], [[0.0, 0.0, 1.0]])[0]
    with RobotProcess(SEED) as process, RobotClient(port=process.port) as robot:
        robot.start_up()
        robot.calibrate(robot.simulated_wire().T_mcs_cfcs)
        robot.aim(RigidTransform.from_components(wire[1], turned))
        killing = Timer(0.5, lambda: os.kill(process.pid, signal.SIGKILL))
        killing.start()
        with pytest.raises(LinkError, match=r"lost|closed"):
            robot.align()
        killing.join()
        with pytest.raises(LinkError):
            robot.status()
    assert not process.alive
    with RobotProcess(SEED) as process, RobotClient(port=process.port) as robot:
        assert robot.status().error_name == "UNDEFINED"
        before = robot.joints()[0]
        for attempt in (robot.align, robot.drill, robot.retract):
            with pytest.raises(RobotRefusedError, match="in UNDEFINED"):
                attempt()
        np.testing.assert_allclose(robot.joints()[0], before, atol=0.02)
        assert robot.status().error_name == "UNDEFINED"


@pytest.mark.slow
def test_one_that_cannot_start_says_why():
    with (
        RobotProcess(SEED, frame="unobtainium") as process,
        pytest.raises(LinkError, match=r"did not start: .*unobtainium"),
    ):
        _ = process.port


@pytest.mark.slow
def test_one_that_nobody_waited_for_ends_with_its_block():
    with RobotProcess(SEED) as process:
        pass
    assert not process.alive


@pytest.mark.slow
def test_it_does_not_outlive_who_started_it():
    """Even one that was killed without a word."""
    starts = "import sys\nfrom sightline.rehearsal.process import RobotProcess\n"
    starts += f"robot = RobotProcess({SEED}, virtual=True)\nassert robot.port\n"
    starts += "print(robot.pid, flush=True)\nsys.stdin.read()\n"
    with Popen([sys.executable, "-c", starts], stdin=PIPE, stdout=PIPE) as parent:  # noqa: S603
        pid = int(parent.stdout.readline())
        parent.kill()
    assert gone(pid)
