"""The conformance test finds ours conforming, tells an old robot from a bad one, and our client drives them all."""

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform
from tests.robot.rig import END_MM, T_MCS_CFCS, served, wire
from tests.robot.scripted_robot import old_robot

from sightline.errors import LinkError, RobotRefusedError
from sightline.robot.client import RobotClient
from sightline.robot.conformance import Verdict, dry_run, examine
from sightline.robot.igtl import Message, Status, String, Transform
from sightline.robot.transport import BlockingClient


def verdicts(port: int) -> dict[str, tuple[Verdict, str]]:
    return {finding.name: (finding.verdict, finding.seen) for finding in examine("127.0.0.1", port)}


def test_ours_passes_everything_and_stands_after_the_dry_run():
    with served() as server:
        found = verdicts(server.port)
        bad = {name: seen for name, (verdict, seen) in found.items() if verdict is not Verdict.PASSED}
        assert not bad
        finding = dry_run("127.0.0.1", server.port)
        assert finding.verdict is Verdict.PASSED, finding.seen
        depth = server.dialogue.controller.snapshot().depth_mm
        assert depth is None or depth < -15.0  # it stood at its stand-off


@pytest.mark.slow
def test_an_old_robot_passes_what_it_knows():
    with old_robot() as port:
        found = verdicts(port)
        assert {verdict for verdict, _ in found.values()} == {Verdict.PASSED, Verdict.UNSUPPORTED}
        unsupported = {name for name, (verdict, _) in found.items() if verdict is Verdict.UNSUPPORTED}
        assert unsupported == {
            "target in metres: 10", "plan that is NO-GO: 10", "plan in another frame: 10", "one client holds the lease",
            "forgets a lost client", "streams", "EMERGENCY waits for a reset",
        }  # fmt: skip
        assert dry_run("127.0.0.1", port).verdict is Verdict.PASSED


@pytest.mark.slow
def test_a_robot_that_does_not_answer_unknown_commands_fails():
    with old_robot(answers_all=False) as port:
        verdict, seen = verdicts(port)["unknown command: 12"]
        assert verdict is Verdict.FAILED
        assert "no ACK of DANCE" in seen


def test_nobody_there():
    with pytest.raises(LinkError, match="cannot connect"):
        list(examine("127.0.0.1", 1))


def test_our_client_drives_an_old_robot():
    with old_robot() as port, RobotClient(port=port) as robot:
        assert not robot.capabilities
        robot.start_up()
        robot.plan()
        robot.calibrate(RigidTransform.from_translation([500.0, 0.0, 0.0]))
        reached = robot.aim(wire())
        assert np.allclose(reached.translation, END_MM, atol=1e-4)
        robot.align()
        assert np.allclose(robot.position().translation, END_MM, atol=1e-4)
        with pytest.raises(RobotRefusedError, match="TARGET"):
            robot.aim(wire(END_MM, END_MM + 500))
        assert robot.stop().code == 1


class OldClient:
    """Follows the old convention alone: headers of version 1, phases, and waits for what that promises."""

    def __init__(self, port: int) -> None:
        self.link = BlockingClient(port=port)
        self.number = 0

    def command(self, text: str, timeout_s: float = 5.0) -> Status:
        self.number += 1
        self.link.send(Message(String(text), f"CMD_{self.number}"))
        assert self.until(f"ACK_{self.number}", 1.0).body == String(text)
        immediate = self.until("CURRENT_STATUS", 1.0)
        assert immediate.body.code == 1
        return self.until(text, timeout_s).body

    def transform(self, kind: str, matrix: np.ndarray, status: str) -> Status:
        self.number += 1
        self.link.send(Message(Transform(matrix), f"{kind}_{self.number}"))
        echo = self.until(f"ACK_{self.number}", 1.0)
        assert np.allclose(echo.body.matrix, matrix, atol=1e-4, equal_nan=True)
        return self.until(status, 5.0).body

    def until(self, name: str, timeout_s: float) -> Message:
        while (event := self.link.receive(timeout_s)) is not None:
            assert event.version == 1
            assert event.type_name in ("STRING", "STATUS", "TRANSFORM")  # nothing that it does not know
            if event.device_name == name:
                return event
        raise AssertionError(f"no {name}")


@pytest.mark.slow
def test_an_old_client_drives_ours_through_an_insertion_and_every_refusal():
    with served(virtual=True) as server:
        old = OldClient(server.port)
        assert old.command("MOVE_TO_TARGET").code == 13
        assert old.command("START_UP").code == 1
        assert old.command("PLANNING").code == 1
        assert old.command("TARGETING").code == 13
        assert old.command("MOVE_TO_TARGET").code == 13
        assert old.command("JUMP").code == 12
        assert old.command("MANUAL").code == 1
        assert old.command("MOVE_TO_TARGET").code == 14
        assert old.command("CALIBRATION").code == 1
        assert old.transform("CLB", np.diag([2.0, 2.0, 2.0, 1.0]), "CALIBRATION").code == 10
        assert old.transform("CLB", T_MCS_CFCS.inv().as_matrix(), "CALIBRATION").code == 1
        assert old.command("TARGETING").code == 1
        for bad in (np.diag([1.0, 1.0, 2.0, 1.0]), wire(END_MM * 1e-3 - 1e-3, END_MM * 1e-3).as_matrix()):
            assert old.transform("TGT", bad, "TARGET").code == 10
        assert old.transform("TGT", RigidTransform.from_translation([900.0, 0, 0]).as_matrix(), "TARGET").code == 10
        assert old.command("MOVE_TO_TARGET").code == 13
        # A bare target is a wire of 95 mm.
        along = wire().rotation.apply([0.0, 0.0, 1.0])
        end = END_MM + 50 * along
        target = RigidTransform.from_components(end, wire().rotation)
        assert old.transform("TGT", target.as_matrix(), "TARGET").code == 1
        assert np.allclose(old.until("TARGET", 1.0).body.matrix, target.as_matrix(), atol=1e-4)
        assert np.allclose(old.until("REACHABLE_TARGET", 1.0).body.matrix[:3, 3], end, atol=0.01)
        for depth_mm in (-20.0, 85.0, 95.0):  # aligned, paused, done
            assert old.command("MOVE_TO_TARGET", 60.0).code == 1
            tip = old.until("CURRENT_POSITION", 1.0).body.matrix[:3, 3]
            assert np.allclose(tip, end + (depth_mm - 95.0) * along, atol=0.05)
        assert old.command("MOVE_TO_TARGET", 60.0).code == 1  # back
        assert old.command("STOP").code == 1
        assert old.command("EMERGENCY").code == 3
        assert old.command("START_UP").code == 3
        assert old.command("STOP").code == 1
        old.link.close()
