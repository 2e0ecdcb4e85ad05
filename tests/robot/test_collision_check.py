"""The collision check off the control thread: answered when done, cancelled by a stop; a late one starts no motion."""

from concurrent.futures import Future
from threading import Event

import numpy as np
import pytest
from tests.robot.rig import CLIENT, T_MCS_CFCS, Rig, code, metadata, served, wire

from sightline.errors import RobotRefusedError
from sightline.robot.contract import Code
from sightline.robot.control.controller import MAX_CHECK_S
from sightline.robot.control.insertion import Insertion
from sightline.robot.control.states import State
from sightline.robot.igtl import Message, Status, String, Transform
from sightline.robot.link.client import RobotClient


class HeldChecks:
    """An executor whose checks end when the test says so."""

    def __init__(self, rig: Rig) -> None:
        self.begun: list[tuple] = []
        rig.controller.check_executor = self

    def __call__(self, work):
        result: Future[Insertion] = Future()
        self.begun.append((work, result))
        return result

    def end(self) -> None:
        work, result = self.begun[-1]
        if not result.cancelled():
            result.set_result(work())


def target(rig: Rig) -> list:
    return rig.send("TGT_1", Transform.of(wire()), version=2, metadata=metadata())


def names(said: list) -> list[str]:
    return [message.device_name for message in said]


def test_a_target_is_acknowledged_at_once_and_answered_when_it_was_checked():
    rig = Rig.at(State.TARGETING)
    checks = HeldChecks(rig)
    assert names(target(rig)) == ["ACK_1"]
    assert rig.run(0.5) == []
    assert rig.controller.machine.insertion is None
    checks.end()
    said = rig.run(0.01)
    assert names(said) == ["TARGET", "TARGET", "REACHABLE_TARGET"]
    assert code(said, "TARGET") == 1
    assert np.array_equal(said[1].body.matrix, wire().as_matrix())
    assert rig.controller.machine.insertion is not None


def test_what_is_in_the_way_is_the_answer():
    rig = Rig.at(State.TARGETING)
    checks = HeldChecks(rig)
    target(rig)
    checks.begun[-1][1].set_exception(RobotRefusedError("the table"))
    said = rig.run(0.01)
    assert code(said, "TARGET") == Code.CONFIGURATION
    assert rig.controller.machine.insertion is None


def test_a_bug_in_the_search_is_no_answer_that_moves_anything():
    rig = Rig.at(State.TARGETING)
    checks = HeldChecks(rig)
    target(rig)
    checks.begun[-1][1].set_exception(ZeroDivisionError())
    with pytest.raises(ZeroDivisionError):
        rig.run(0.01)
    assert rig.controller.machine.insertion is None
    assert not rig.controller.busy


def test_its_client_waits_and_others_may_stop_and_ask():
    rig = Rig.at(State.TARGETING)
    HeldChecks(rig)
    target(rig)
    for text in ("MOVE_TO_TARGET", "START_UP"):
        assert code(rig.command(text), text) == Code.NOT_READY
    assert names(target(rig)) == ["ACK_1", "TARGET"]
    assert rig.state is State.TARGETING
    (said,) = rig.send("CURRENT_STATUS", String("CURRENT_STATUS"), client=2)
    assert said.device_name == "TARGETING"


@pytest.mark.parametrize("how", ["STOP", "own STOP", "EMERGENCY", "lost", "stop button"])
def test_a_stop_makes_what_is_found_afterwards_void(how):
    rig = Rig.at(State.TARGETING)
    checks = HeldChecks(rig)
    target(rig)
    if how == "lost":
        rig.dialogue.left(CLIENT, rig.now_s)
    elif how == "stop button":
        rig.plant.stop_pressed = True
    else:
        rig.command(how.split()[-1], client=CLIENT if how == "own STOP" else 2)
    said = rig.run(0.2)
    answers = {"STOP": Code.NOT_READY, "own STOP": Code.NOT_READY, "lost": None}
    assert code(said, "TARGET") == answers.get(how, Code.EMERGENCY)
    assert how != "own STOP" or names(said) == ["STOP", "TARGET"]
    checks.end()
    assert code(rig.run(0.2), "TARGET") is None
    assert rig.controller.machine.insertion is None


def stopped_on_its_way() -> tuple[Rig, HeldChecks]:
    """With a target, and an arm that stands elsewhere than where its path was checked from."""
    rig = Rig.at(State.ALIGN)
    rig.run(1.0)
    rig.command("STOP")
    rig.run(0.5)
    return rig, HeldChecks(rig)


def test_a_motion_waits_for_its_check():
    rig, checks = stopped_on_its_way()
    said = rig.command("MOVE_TO_TARGET")
    assert names(said) == [f"ACK_{rig.number}", "CURRENT_STATUS"]
    rig.run(0.5)
    assert rig.state is State.STOP
    assert rig.speed() == 0.0
    checks.end()
    rig.run(0.2)
    assert rig.state is State.ALIGN
    assert code(rig.run_until(State.ALIGNED), "MOVE_TO_TARGET") == 1


@pytest.mark.parametrize("how", ["STOP", "late", "hold-to-run", "button", "pushed"])
def test_a_late_answer_moves_nothing(how):
    rig, checks = stopped_on_its_way()
    rig.command("MOVE_TO_TARGET")
    said = []
    if how == "STOP":
        said += rig.command("STOP", client=2)
    elif how == "late":
        said += rig.run(MAX_CHECK_S + 0.01)
    elif how == "hold-to-run":
        rig.plant.run_held = False
    elif how == "button":
        rig.plant.stop_pressed = True
    else:
        rig.plant.q = rig.plant.q + np.array([1.0, 0.0, 0.0, 0.0, 0.0])
    said += rig.run(0.05)
    checks.end()
    said += rig.run(0.3)
    assert rig.state is not State.ALIGN
    assert rig.speed() == 0.0
    assert code(said, "MOVE_TO_TARGET") == (Code.EMERGENCY if how == "button" else Code.NOT_READY)
    if how == "late":  # nothing has changed: now its way is known
        rig.command("MOVE_TO_TARGET")
        assert rig.state is State.ALIGN


def test_a_command_that_a_stop_overtook_is_void():
    rig = Rig.at(State.STOP)
    out = rig.dialogue.receive(CLIENT, Message(String("MOVE_TO_TARGET"), "CMD_A"), rig.now_s, overtaken=True)
    assert code([o.message for o in out], "MOVE_TO_TARGET") == Code.NOT_READY
    assert rig.state is State.STOP
    out = rig.dialogue.receive(CLIENT, Message(String("PLANNING"), "CMD_B"), rig.now_s, overtaken=True)
    assert code([o.message for o in out], "PLANNING") == 1


def test_behind_its_port_the_robot_goes_on_during_a_check(monkeypatch):
    """The loop runs, others are answered, and what its own client sent meanwhile is answered afterwards, in order."""
    free, checking = Event(), Event()
    real = Insertion.cleared

    def slow(*args):
        checking.set()
        assert free.wait(10.0)
        return real(*args)

    monkeypatch.setattr(Insertion, "cleared", slow)
    with served() as server, RobotClient(port=server.port) as robot, RobotClient(port=server.port) as other:
        robot.start_up()
        robot.calibrate(T_MCS_CFCS, 10.0)
        robot.command("TARGETING").refuse_unless_ok()
        with robot.connection.mailbox() as mail:
            robot.connection.send(Transform.of(wire()), "TGT_9", metadata=metadata(), imaged_s=10.0)
            robot.connection.send(String("MOVE_TO_TARGET"), "CMD_10")
            assert checking.wait(10.0)
            before = server.dialogue.cycles.count
            while server.dialogue.cycles.count < before + 10:
                assert other.status().error_name == "TARGETING"
            free.set()
            wanted = ("ACK_9", "TARGET", "REACHABLE_TARGET", "ACK_10")
            came = []
            while "ACK_10" not in came:
                message = mail.need(lambda m: m.device_name in wanted, 5.0, "answer")
                if message.device_name not in came:
                    came.append(message.device_name)
                    assert not isinstance(message.body, Status) or message.body.code == 1
        assert tuple(came) == wanted
        robot.stop()
