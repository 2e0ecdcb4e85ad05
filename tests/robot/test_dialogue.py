"""What the robot answers where a client repeats itself, knows other words, or cannot read STATUS."""

import numpy as np
import pytest
from tests.robot.rig import CLIENT, T_MCS_CFCS, Rig, code, metadata, wire

from sightline.robot import contract
from sightline.robot.contract import MAX_KEPT, Code
from sightline.robot.control.requests import Answer
from sightline.robot.control.states import State
from sightline.robot.igtl import Capability, Get, Message, Status, String, Transform
from sightline.robot.link.inbox import AnswerCache

OTHER = 2


def named(said: list[Message]) -> list[str]:
    return [message.device_name for message in said]


def phase_command(rig: Rig, identifier: str, text: str, client: int = CLIENT) -> list[Message]:
    return rig.send(f"CMD_{identifier}", String(text), client)


def target(rig: Rig, identifier: str = "T", client: int = CLIENT, **said: str) -> list[Message]:
    return rig.send(f"TGT_{identifier}", Transform.of(wire()), client, version=2, metadata=metadata(**said))


def test_a_command_that_comes_twice_moves_once():
    rig = Rig.at(State.TARGETING)
    phase_command(rig, "M", "MOVE_TO_TARGET")
    repeated = phase_command(rig, "M", "MOVE_TO_TARGET")
    assert named(repeated) == ["ACK_M", "CURRENT_STATUS"]  # it goes on, and one STATUS will say how it ended
    said = rig.run_until(State.ALIGNED)
    assert named(said).count("MOVE_TO_TARGET") == 1
    ended = next(message.body for message in said if message.device_name == "MOVE_TO_TARGET")
    repeated = phase_command(rig, "M", "MOVE_TO_TARGET")
    assert named(repeated) == ["ACK_M", "CURRENT_STATUS", "MOVE_TO_TARGET"]
    assert repeated[2].body == ended
    rig.run(0.1)
    assert rig.state is State.ALIGNED
    assert code(phase_command(rig, "M", "DRILL"), "DRILL") == Code.CONFIGURATION
    assert rig.state is State.ALIGNED
    phase_command(rig, "N", "DRILL")
    assert rig.state is State.DRILL


def test_a_refused_command_stays_refused_under_its_identifier():
    rig = Rig.at(State.START_UP)
    first = phase_command(rig, "R", "TARGETING")
    assert code(first) == Code.NOT_READY
    phase_command(rig, "C", "CALIBRATION")
    rig.send("CLB_1", Transform.of(T_MCS_CFCS.inv()))
    assert phase_command(rig, "R", "TARGETING")[2].body == first[2].body
    assert rig.state is State.CALIBRATION
    assert code(phase_command(rig, "S", "TARGETING")) == 1


def test_identifiers_belong_to_their_connection():
    rig = Rig.at(State.START_UP)
    phase_command(rig, "1", "PLANNING")
    rig.dialogue.left(CLIENT, rig.now_s)
    assert code(phase_command(rig, "1", "START_UP", OTHER)) == 1


@pytest.mark.parametrize("word", ["STOP", "EMERGENCY", "stop", "STOP ", "STOP\0", "emergency"])
def test_a_stop_acts_whatever_its_identifier_and_its_spelling(word):
    rig = Rig.at(State.TARGETING)
    phase_command(rig, "M", "MOVE_TO_TARGET")
    rig.run(0.3)
    said = phase_command(rig, "M", word)
    assert said[0].body.text == word
    emergency = word.upper().startswith("E")
    said += rig.run(0.5)
    assert code(said, "EMERGENCY" if emergency else "STOP") == (3 if emergency else 1)
    assert rig.state is (State.EMERGENCY if emergency else State.STOP)
    assert rig.speed() < 0.01
    if not emergency:
        rig.command("MOVE_TO_TARGET")
        rig.run(0.3)
        assert code(phase_command(rig, "M", word) + rig.run(0.5), "STOP") == 1
        assert rig.state is State.STOP


def test_what_a_connection_asked_is_kept_within_bounds():
    asked = AnswerCache()
    for number in range(10 * MAX_KEPT):
        asked.put(f"CMD_{number}", "X" * 10_000, Answer(Code.UNKNOWN))
    assert len(asked._entries) == MAX_KEPT
    assert max(len(text) for text, _ in asked._entries.values()) <= 100
    assert asked.earlier(f"CMD_{10 * MAX_KEPT - 1}", "X" * 10_000).code is Code.UNKNOWN
    assert asked.earlier("CMD_0", "X") is None


def test_a_robot_is_not_called_simulated_unless_it_is():
    (answer,) = Rig().send("", Get("CAPABILITY"))
    assert contract.HAS_DRILLING in answer.body.types
    assert contract.IS_SIMULATED not in answer.body.types


@pytest.mark.parametrize("state", [State.ALIGNED, State.PAUSED], ids=lambda state: state.value)
def test_who_announced_drilling_drills_by_that_name_alone(state):
    rig = Rig.at(state)
    rig.send("", Capability(("X_DRILLING",)))
    said = rig.command("MOVE_TO_TARGET")
    assert code(said) == Code.NOT_READY
    assert "DRILL" in said[2].body.text
    assert rig.state is state
    rig.command("DRILL")
    assert rig.state is State.DRILL


def test_who_announced_drilling_aligns_and_draws_back_as_ever():
    for state, goes in ((State.TARGETING, State.ALIGN), (State.GUIDE, State.RETRACT)):
        rig = Rig.at(state)
        rig.send("", Capability(("X_DRILLING",)))
        rig.command("MOVE_TO_TARGET")
        assert rig.state is goes


@pytest.mark.parametrize("who", [CLIENT, OTHER])
@pytest.mark.parametrize("word", ["STOP", "EMERGENCY"])
def test_a_motion_s_status_comes_after_that_of_what_stopped_it(word, who):
    rig = Rig.at(State.TARGETING)
    rig.dialogue.joined(OTHER)
    rig.command("MOVE_TO_TARGET")
    rig.run(0.3)
    rig.command(word, client=who)
    told = [
        outgoing.message.device_name
        for _ in range(100)
        for outgoing in _cycle(rig)
        if outgoing.client == CLIENT and not outgoing.telemetry
    ]
    assert told[:2] == [word, "MOVE_TO_TARGET"]
    assert told[2:] == ["CURRENT_POSITION"]


def _cycle(rig: Rig):
    rig.now_s += 0.005
    rig.plant.advance(0.005)
    return rig.dialogue.cycle(rig.now_s)


def test_a_target_of_a_client_without_the_lease_is_not_echoed_as_accepted():
    from concurrent.futures import Future

    rig, checks = Rig.at(State.TARGETING), []
    rig.controller.check_executor = lambda work: checks.append((work, Future())) or checks[-1][1]
    target(rig)
    other = Transform(np.diag([1.0, 1.0, 1.0, 1.0]) + np.pad([[99.0]], ((0, 3), (3, 0))))
    assert code(rig.send("TGT_X", other, OTHER), "TARGET") == Code.DENIED
    work, check = checks[0]
    check.set_result(work())
    echo = next(m for m in rig.run(0.01) if m.device_name == "TARGET" and isinstance(m.body, Transform))
    assert np.array_equal(echo.body.matrix, Transform.of(wire()).matrix)


def test_a_plan_that_is_sent_again_is_as_old_as_it_was():
    rig = Rig.at(State.TARGETING)
    assert code(target(rig, "2", valid_s="3", plan="short"), "TARGET") == 1
    rig.run(2.0)
    assert code(target(rig, "3", valid_s="3", plan="short"), "TARGET") == 1
    rig.run(1.5)
    assert code(rig.command("MOVE_TO_TARGET")) == Code.CONFIGURATION
    said = target(rig, "4", valid_s="3", plan="short")
    assert code(said, "TARGET") == Code.CONFIGURATION
    assert "expired" in said[1].body.text
    assert rig.controller.machine.insertion is None  # the earlier target is void
    rig.command("START_UP")  # which forgets registration and target
    rig.command("CALIBRATION")
    rig.send("CLB_2", Transform.of(T_MCS_CFCS.inv()))
    rig.command("TARGETING")
    assert code(target(rig, "5", valid_s="3", plan="short"), "TARGET") == Code.CONFIGURATION
    assert code(target(rig, "6", valid_s="3", plan="anew"), "TARGET") == 1


def test_a_bare_target_lives_as_long_as_its_registration():
    rig = Rig.at(State.TARGETING)
    rig.now_s += 590.0
    assert code(rig.send("TGT_2", Transform.of(wire())), "TARGET") == 1
    assert rig.controller.machine.insertion.expires_s - rig.now_s == pytest.approx(10.0, abs=0.01)
    rig.now_s += 11.0
    said = rig.send("TGT_3", Transform.of(wire()))
    assert "register again" in said[1].body.text


def test_status_in_words_for_clients_that_cannot_read_it():
    rig = Rig.at(State.START_UP)
    said = rig.send("MIRROR_STATUS", String(""))
    assert [type(message.body) for message in said] == [Status, String]
    assert said[1].device_name == "STATUS"
    assert said[1].body.text.startswith("START_UP; 1; START_UP; START_UP; ")
    said = rig.command("TARGETING")
    assert named(said) == [f"ACK_{rig.number}", "CURRENT_STATUS", "STATUS", "TARGETING", "STATUS"]
    assert said[-1].body.text.startswith("TARGETING; 13; NOT_READY; there is no registration")
    assert named(rig.command("STOP", client=OTHER)) == [f"ACK_{rig.number}", "CURRENT_STATUS"]
