"""The controller without a link: an answer to everything in every state, and motion that is watched."""

import numpy as np
import pytest
from tests.robot.rig import CLIENT, END_MM, ENTRY_MM, IMAGED, ROBOT, T_MCS_CFCS, Rig, code, metadata, wire

from sightline.robot.contract import Code
from sightline.robot.control.states import COMMANDS, MOVING, TRANSITIONS, WAITING, State, Trigger, phase
from sightline.robot.control.timing import Lease, LoopClock
from sightline.robot.igtl import Capability, Command, Status, String, Transform
from sightline.robot.kinematics.designs import FEED
from sightline.robot.plant import CYCLE_S, PlantFlag

OTHER = 2
STATES = tuple(State)


@pytest.mark.parametrize("state", STATES, ids=lambda state: state.value)
def test_every_command_in_every_state_gets_its_three_answers(state):
    for text in (*(trigger.value for trigger in COMMANDS), "DANCE", "", "start_up", "X" * 300, "\u00fc\n"):
        rig = Rig.at(state)
        said = rig.command(text)
        assert [type(message.body) for message in said[:2]] == [String, Status]
        assert said[0].device_name == f"ACK_{rig.number}"
        assert said[0].body.text == text
        assert said[1].device_name == "CURRENT_STATUS"
        assert said[1].body.error_name == phase(rig.state)
        trigger = next((trigger for trigger in COMMANDS if trigger.value == text), None)
        if trigger is None:
            assert said[2].body.code == Code.UNKNOWN
            assert rig.state is state
            continue
        wanted = (state, trigger) in TRANSITIONS and not _wants_something(state, trigger)
        if len(said) == 2:
            assert wanted
            assert rig.state is TRANSITIONS[state, trigger]
            if trigger not in (Trigger.STOP, Trigger.EMERGENCY):  # it moves, so its end is reported too
                rig.command("STOP")
            said += [message for message in rig.run(0.3) if message.device_name == text]
            assert len(said) == 3
            assert said[2].body.code == {Trigger.STOP: 1, Trigger.EMERGENCY: 3}.get(trigger, Code.NOT_READY)
        else:
            assert (said[2].body.code == 1) is wanted, (text, said[2].body)
        assert said[2].device_name == text
        assert said[2].body.text or said[2].body.code == 1


def _wants_something(state: State, trigger: Trigger) -> bool:
    """Legal, but the way there has left something out."""
    unregistered = state in (State.START_UP, State.PLANNING, State.CALIBRATION, State.MANUAL)
    return unregistered and trigger is Trigger.TARGETING


@pytest.mark.parametrize("state", STATES, ids=lambda state: state.value)
def test_registrations_targets_and_resets_are_answered_in_every_state(state):
    rig = Rig.at(state)
    said = rig.send("TGT_7", Transform.of(wire()))
    assert said[0].device_name == "ACK_7"
    assert (code(said, "TARGET") == 1) is (state is State.TARGETING)
    said = rig.send("CLB_8", Transform.of(T_MCS_CFCS.inv()))
    assert said[0].device_name == "ACK_8"
    assert (code(said, "CALIBRATION") == 1) is (state is State.CALIBRATION)
    (said,) = rig.send("reset", Command(5, "RESET", "1"), version=2)
    assert said.body.command_id == 5
    assert (said.body.error == "") is (state is State.EMERGENCY)


@pytest.mark.parametrize("state", STATES, ids=lambda state: state.value)
def test_any_client_may_stop_in_every_state(state):
    for text, ends in (("STOP", State.STOP), ("EMERGENCY", State.EMERGENCY)):
        rig = Rig.at(state)
        said = rig.command(text, client=OTHER)
        assert said[0].body == String(text)
        assert code(said + rig.run(0.5), text) == (1 if text == "STOP" else 3)
        expected = state if text == "STOP" and state in (State.UNDEFINED, State.EMERGENCY) else ends
        assert rig.state is expected
        before = rig.plant.read().encoders
        rig.run(0.2)
        assert np.abs(rig.plant.read().encoders - before).max() < 0.01


def test_an_insertion_from_beginning_to_end():
    rig = Rig.at(State.ALIGNED)
    manipulator = ROBOT.manipulator
    along = (END_MM - ENTRY_MM) / np.linalg.norm(END_MM - ENTRY_MM)

    def tip() -> np.ndarray:
        return T_MCS_CFCS.inv().apply(manipulator.T_mcs_tool(rig.plant.read().encoders).translation)

    assert np.allclose(tip(), ENTRY_MM - 20 * along, atol=0.05)
    said = rig.command("MOVE_TO_TARGET") + rig.run_until(State.PAUSED)
    assert (said[-2].device_name, said[-2].body.text) == ("MOVE_TO_TARGET", "PAUSED")
    assert said[-1].device_name == "CURRENT_POSITION"
    assert np.allclose(tip(), END_MM - 10 * along, atol=0.05)
    rig.command("DRILL")
    rig.run_until(State.DONE)
    assert np.allclose(tip(), END_MM, atol=0.05)
    assert rig.controller.machine.snapshot().depth_mm == pytest.approx(np.linalg.norm(END_MM - ENTRY_MM), abs=0.02)
    rig.command("RETRACT")
    rig.run_until(State.PLANNING)
    assert rig.plant.read().encoders[FEED] == pytest.approx(0.5, abs=0.02)
    assert rig.controller.machine.insertion is None


def test_the_arm_turns_only_with_the_wire_in_its_sleeve():
    rig = Rig.at(State.PAUSED)
    assert code(rig.command("STOP") + rig.run(0.5), "STOP") == 1
    rig.command("MOVE_TO_TARGET")
    arm = rig.plant.read().encoders[:FEED]
    while rig.plant.read().encoders[FEED] > 1.0:
        assert np.abs(rig.plant.read().encoders[:FEED] - arm).max() < 0.01
        rig.run(0.05)
    rig.run_until(State.ALIGNED)


def test_only_the_holder_of_the_lease_commands():
    rig = Rig.at(State.TARGETING)
    assert code(rig.command("MOVE_TO_TARGET", client=OTHER)) == Code.DENIED
    assert code(rig.send("TGT_1", Transform.of(wire()), client=OTHER)) == Code.DENIED
    assert rig.state is State.TARGETING
    rig.dialogue.left(CLIENT, rig.now_s)
    assert rig.state is State.UNDEFINED
    assert code(rig.command("START_UP", client=OTHER)) == 1


@pytest.mark.parametrize("state", STATES, ids=lambda state: state.value)
def test_a_lost_client_stops_the_robot_which_forgets(state):
    rig = Rig.at(state)
    if state is State.UNDEFINED:
        rig.command("START_UP")
    rig.dialogue.left(CLIENT, rig.now_s)
    assert rig.state is (State.EMERGENCY if state is State.EMERGENCY else State.UNDEFINED)
    rig.run(0.1)
    assert rig.speed() < 0.01
    assert rig.controller.machine.registration is None
    assert rig.controller.lease is None


@pytest.mark.parametrize("state", MOVING, ids=lambda state: state.value)
def test_silence_stops_a_client_that_promised_heartbeats_and_no_other(state):
    for promise in (String(""), Capability(("X_HEARTBEAT",)), None):
        rig = Rig.at(state)
        rig.beat(promise)
        said = rig.run(0.19)
        assert rig.state is state
        said += rig.run(0.05)
        assert rig.state is (state if promise is None else State.STOP)
        assert any("silent" in message.body.text for message in said) is (promise is not None)
    rig = Rig.at(state)
    for _ in range(5):
        rig.beat()
        rig.run(0.1)
    assert rig.state is state


@pytest.mark.parametrize("command", ["DRILL", "MOVE_TO_TARGET"])
def test_nothing_is_drilled_for_a_client_whose_loss_would_be_noticed_late(command):
    for state in (State.ALIGNED, State.PAUSED):
        rig = Rig.at(state)
        rig.beat(None)
        said = rig.command(command)
        assert code(said, command) == Code.NOT_READY
        assert "announce X_HEARTBEAT" in said[-1].body.text
        rig.beat()
        rig.command(command)
        assert rig.state is State.DRILL


def test_what_a_look_for_collisions_takes_is_no_silence():
    rig = Rig.at(State.TARGETING)
    rig.beat()
    rig.command("MOVE_TO_TARGET")
    rig.now_s += 0.4
    rig.run(0.1)
    assert rig.state is State.ALIGN


def test_a_loop_that_is_late_while_it_moves_stops():
    rig = Rig.at(State.ALIGN)
    rig.run(0.1)
    rig.now_s += 0.1
    said = rig.run(0.1)
    assert rig.state is State.STOP
    assert "late" in said[0].body.text
    assert rig.speed() < 0.01


def test_the_loop_clock_advances_by_little_and_never_back():
    own = LoopClock()
    assert [own.tick(now_s) for now_s in (5.0, 5.005, 9.0, 3.0, 3.01)] == pytest.approx([0.0, 0.005, 0.02, 0.0, 0.01])
    assert own.now_s == pytest.approx(0.035)


PAUSE_S = 0.3  # of the machine: longer than the drives' 0.05 s and the client's 0.2 s


@pytest.mark.parametrize("state", WAITING, ids=lambda state: state.value)
def test_a_controller_that_slept_does_not_blame_the_drives(state):
    """Their samples paused as it did, and come again some cycles after it woke."""
    rig = Rig.at(state)
    rig.now_s += PAUSE_S
    frozen = vars(rig.plant.read())
    rig.reads(**frozen)
    rig.run(0.03)
    assert rig.state is state
    rig.reads()
    rig.run(0.1)
    assert rig.state is state
    rig.reads(**frozen)  # but drives that are gone are noticed, and in time
    rig.run(0.06)
    assert rig.state is State.EMERGENCY
    assert "no sample from the drives" in rig.controller.machine.fault.text


def test_a_controller_that_pauses_does_not_blame_its_client():
    """Cycle after cycle it pauses, each time for less than it may; so does the client on the same machine."""
    rig = Rig.at(State.ALIGN)
    rig.beat()
    for _ in range(8):
        rig.now_s += 0.045
        rig.plant.advance(0.045)
        rig.dialogue.cycle(rig.now_s)
    assert rig.state is State.ALIGN
    rig.run(0.2)
    assert rig.state is State.STOP  # true silence


def test_only_the_holder_of_the_lease_must_be_heard():
    lease = Lease()
    lease.heard(0, 0.0, heartbeat=True)
    assert lease.silence(0.0, 10.0, 0.0) is None
    assert lease.take(0)
    assert "silent" in (lease.silence(0.0, 10.0, 0.0) or "")


def test_silence_counts_only_where_the_robot_listened():
    """What a client sent may lie in the robot's sockets; a robot that does not read them hears no stop either."""

    def run(rig: Rig, seconds: float, *, listened: bool) -> list[str]:
        said = []
        for k in range(round(seconds / CYCLE_S)):
            rig.now_s += CYCLE_S
            rig.plant.advance(CYCLE_S)
            unread_s = 0.0 if listened else (k + 1) * CYCLE_S
            said += [o.message.body for o in rig.dialogue.cycle(rig.now_s, unread_s) if not o.telemetry]
        return [body.text for body in said if isinstance(body, Status)]

    rig = Rig.at(State.DRILL)
    rig.beat()
    run(rig, 0.15, listened=True)
    run(rig, 0.15, listened=False)
    assert rig.state is State.DRILL
    rig.beat()  # it lay there
    run(rig, 0.19, listened=True)
    assert rig.state is State.DRILL
    assert any("client was silent" in text for text in run(rig, 0.02, listened=True))
    for promised in (True, False):
        for seconds, ends in ((0.195, State.DRILL), (0.21, State.STOP)):
            rig = Rig.at(State.DRILL)
            if promised:
                rig.beat()
            run(rig, 0.15, listened=True)
            said = run(rig, seconds, listened=False)
            assert rig.state is ends
            assert any("its own link" in text for text in said) is (ends is State.STOP)


def test_a_fault_waits_for_a_person():
    rig = Rig.at(State.ALIGN)
    rig.plant.stop_pressed = True
    said = rig.run(0.05)
    assert rig.state is State.EMERGENCY
    assert code(said, "MOVE_TO_TARGET") == Code.EMERGENCY
    assert code(said, "EMERGENCY") == Code.EMERGENCY
    assert code(rig.command("START_UP")) == Code.EMERGENCY
    rig.panel.reset()
    said = rig.run(0.05)
    assert rig.state is State.EMERGENCY  # the button is still pressed
    assert any("stop button" in message.body.text for message in said)
    rig.plant.stop_pressed = False
    rig.run(0.05)
    assert rig.state is State.EMERGENCY  # releasing it does not reset
    rig.panel.reset()
    rig.run(0.05)
    assert rig.state is State.UNDEFINED
    assert code(rig.command("TARGETING")) == Code.NOT_READY


def test_a_reset_pressed_before_the_fault_does_not_count():
    rig = Rig.at(State.PLANNING)
    rig.panel.reset()
    rig.run(0.05)
    rig.command("EMERGENCY")
    rig.run(0.05)
    assert rig.state is State.EMERGENCY


def test_a_reset_from_afar_names_the_fault():
    rig = Rig.at(State.EMERGENCY)
    rig.panel.reset()
    rig.run(0.05)
    rig.command("EMERGENCY")
    for number, (text, done) in enumerate((("1", False), ("zwei", False), ("\u00b2", False), ("", False), ("2", True))):
        (reply,) = rig.send("r", Command(number, "RESET", text), client=OTHER)
        assert (reply.body.error == "") is done
    assert rig.state is State.UNDEFINED
    locked = Rig(key_switch=True)
    locked.reach(State.EMERGENCY)
    (reply,) = locked.send("r", Command(9, "RESET", "1"))
    assert "key" in reply.body.text
    assert locked.controller.reset(1).code is Code.DENIED


def test_the_second_shot_sets_the_depth_anew():
    length = float(np.linalg.norm(END_MM - ENTRY_MM))
    rig = Rig.at(State.PAUSED)
    before = rig.plant.read().encoders[FEED]
    bad = ("nan", "inf", "", "-12", "30 0", "30 -1", "30 nan", "30 9", "30 0.1 7")
    good = f"{length - 8.5!r} 0.25"
    for number, (text, done) in enumerate((*((text, False) for text in bad), (good, True))):
        (reply,) = rig.send("shot", Command(number, "SHOT_DEPTH", text))
        assert (reply.body.error == "") is done, reply.body
    assert rig.send("shot", Command(len(bad), "SHOT_DEPTH", good))[0].body == reply.body  # a repeat refines nothing
    # The shot says 1.5 mm more than the encoders, and errs half as much as the plan: four parts of five are taken.
    now = rig.controller.machine.snapshot()
    assert now.depth_mm == pytest.approx(length - 10 + 0.8 * 1.5, abs=0.02)
    assert now.depth_sd_mm == pytest.approx(0.5 * np.sqrt(0.2))
    assert rig.send("shot", Command(40, "SHOT_DEPTH", repr(length - 8.5)), client=OTHER)[0].body.error == "refused"
    rig.command("DRILL")
    rig.run_until(State.DONE)
    assert rig.plant.read().encoders[FEED] - before == pytest.approx(10 - 0.8 * 1.5, abs=0.03)


@pytest.mark.parametrize("state", [state for state in STATES if state is not State.PAUSED], ids=lambda s: s.value)
def test_a_shot_s_depth_is_taken_in_the_pause_alone(state):
    (reply,) = Rig.at(state).send("shot", Command(3, "SHOT_DEPTH", "30"))
    assert reply.body.error == "refused"


def test_the_hold_to_run_switch():
    rig = Rig.at(State.TARGETING)
    rig.plant.run_held = False
    rig.run(0.05)
    assert code(rig.command("MOVE_TO_TARGET")) == Code.NOT_READY
    rig.plant.run_held = True
    rig.run(0.05)
    rig.command("MOVE_TO_TARGET")
    rig.run(0.5)
    rig.plant.run_held = False
    said = rig.run(0.2)
    assert rig.state is State.STOP
    assert any("hold-to-run" in message.body.text for message in said)
    assert rig.speed() < 0.01


def test_a_plan_expires_before_and_during_motion():
    rig = Rig.at(State.TARGETING)
    said = rig.send("TGT_2", Transform.of(wire()), version=2, metadata=metadata(valid_s="3"))
    assert code(said, "TARGET") == 1
    rig.command("MOVE_TO_TARGET")
    said = rig.run(3.5)
    assert rig.state is State.STOP
    assert any("expired" in message.body.text for message in said if isinstance(message.body, Status))
    said = rig.command("MOVE_TO_TARGET")
    assert code(said) == Code.CONFIGURATION
    assert "expired" in said[-1].body.text


@pytest.mark.parametrize("state", WAITING, ids=lambda state: state.value)
def test_a_robot_pushed_while_it_waits_is_a_fault(state):
    rig = Rig.at(state)
    rig.reads(flags=PlantFlag.RUN_HELD | PlantFlag.OVERLOAD)
    rig.run(0.1)
    assert rig.state is state  # an overloaded drive stops no robot that stands
    rig.reads(encoders=lambda reading: reading.encoders + np.array([0, 0.3, 0, 0, 0]))
    rig.run(0.05)
    assert rig.state is State.EMERGENCY
    assert "traverse was moved" in rig.controller.machine.fault.text


@pytest.mark.parametrize("joint", range(5))
def test_a_joint_that_does_not_follow_is_a_fault(joint):
    rig = Rig.at(State.TARGETING)
    rig.command("MOVE_TO_TARGET")
    stuck = rig.plant.read().encoders[joint]
    rig.reads(encoders=lambda reading: np.where(np.arange(5) == joint, stuck, reading.encoders))
    rig.run_until(State.EMERGENCY, 10.0)
    assert "from where it should be" in rig.controller.machine.fault.text


@pytest.mark.parametrize(
    ("change", "why"),
    [
        ({"encoders": np.full(5, np.nan)}, "no number"),
        ({"force_n": np.inf}, "no number"),
        ({"time_s": 1.0}, "clock has failed"),
        ("frozen", "no sample"),
        ({"force_n": 200.0}, "above its limit"),
        ({"encoders": IMAGED + 500.0}, "outside the workspace"),
        ({"flags": PlantFlag.RUN_HELD | PlantFlag.OVERLOAD}, "at the limit of its force"),
    ],
    ids=["encoders", "force", "clock", "frozen", "thrust", "workspace", "overload"],
)
def test_what_the_plant_says_wrong_while_drilling_is_a_fault(change, why):
    rig = Rig.at(State.DRILL)
    rig.run(0.5)
    rig.reads(**(vars(rig.plant.read()) if change == "frozen" else change))
    rig.run_until(State.EMERGENCY, 0.3)
    assert why in rig.controller.machine.fault.text
    rig.reads()
    rig.run(0.1)
    assert rig.speed() < 0.01


def test_a_wire_that_runs_past_its_depth_limit_is_a_fault():
    """The chuck slips, or a drive runs away: the loop sees the wire beyond the limit, where no command sent it."""
    rig = Rig.at(State.PAUSED)
    insertion = rig.controller.machine.insertion
    rig.command("DRILL")
    rig.run_until_depth(insertion.length_mm - 0.1)
    assert insertion.depth_limit_mm == pytest.approx(insertion.length_mm + 1.0)
    rig.reads(encoders=lambda _: rig.plant.q + np.array([0, 0, 0, 0, 1.2]))
    said = rig.run_until(State.EMERGENCY, 0.1)
    assert "depth limit" in rig.controller.machine.fault.text
    assert code(said, "DRILL") == Code.HARDWARE


def test_a_far_break_through_stops_and_a_near_one_does_not():
    rig = Rig.at(State.DRILL)
    for share, ends in ((0.3, State.DRILL), (0.7, State.STOP)):
        rig.run_until_depth(share * rig.controller.machine.insertion.length_mm)
        fell = rig.now_s + 1.0
        rig.reads(force_n=lambda _, fell=fell: 25.0 if rig.now_s < fell else 0.5)
        said = rig.run(2.0)
        assert rig.state is ends
        assert any("broke through" in m.body.text for m in said) is (ends is State.STOP)
