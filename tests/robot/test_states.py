"""The table of states, and its picture."""

import re
from pathlib import Path

from sightline.robot.control.states import ACTIVITIES, COMMANDS, MOVING, READY, TRANSITIONS, WAITING, State, Trigger

PAGE = Path(__file__).parents[2] / "docs" / "robot-link.md"


def test_a_fault_is_left_by_a_reset_alone():
    left = {trigger for (state, trigger), to in TRANSITIONS.items() if state is State.EMERGENCY and to is not state}
    assert left == {Trigger.RESET}
    assert TRANSITIONS[State.EMERGENCY, Trigger.RESET] is State.UNDEFINED
    assert not any(trigger is Trigger.RESET for state, trigger in TRANSITIONS if state is not State.EMERGENCY)


def test_nothing_drills_that_was_not_aligned_and_confirmed():
    into = {(state, trigger) for (state, trigger), to in TRANSITIONS.items() if to is State.DRILL}
    assert into == {
        (state, trigger)
        for state in (State.ALIGNED, State.PAUSED)
        for trigger in (Trigger.DRILL, Trigger.MOVE_TO_TARGET)
    }


def test_a_robot_in_motion_obeys_no_command_but_stop():
    for state in MOVING:
        legal = {trigger for trigger in COMMANDS if (state, trigger) in TRANSITIONS}
        assert legal == {Trigger.STOP, Trigger.EMERGENCY}


def test_every_state_is_reached_and_left():
    assert {to for (state, _), to in TRANSITIONS.items() if to is not state} == set(State)
    assert {state for (state, _), to in TRANSITIONS.items() if to is not state} == set(State)
    assert set(ACTIVITIES) == set(MOVING) | set(WAITING)
    assert not set(READY) & set(ACTIVITIES)


def test_the_diagram_of_the_page_shows_every_transition_that_changes_something():
    drawn = re.search(r"```mermaid\n(.*?)\n```", PAGE.read_text(), flags=re.DOTALL)
    assert drawn is not None
    inside = {name: text.split() for name, text in re.findall(r"state (\w+) \{(.*?)\}", drawn[1], flags=re.DOTALL)}
    boxes = {"READY": READY, "WAITING": WAITING, "MOVING": MOVING}
    assert inside.pop("MOVE_TO_TARGET") == ["WAITING", "MOVING"]
    assert inside == {name: [state.value for state in states] for name, states in boxes.items()}
    shown = set()
    for source, to, triggers in re.findall(r"^    (\w+) --> (\w+): (.+)$", drawn[1], flags=re.MULTILINE):
        for state in (boxes | {"MOVE_TO_TARGET": ACTIVITIES}).get(source) or (State(source),):
            shown |= {(state, Trigger(trigger), State(to)) for trigger in triggers.split(", ")}
    table = {(state, trigger, to) for (state, trigger), to in TRANSITIONS.items()}
    assert {arrow for arrow in table if arrow[0] is not arrow[2]} <= shown <= table
