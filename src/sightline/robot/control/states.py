"""The robot's states and the table of transitions between them, as data.

A state is a phase of the 2013 convention or, within MOVE_TO_TARGET, an activity. A transition that is not in the table
is refused.
"""

from enum import Enum


class State(Enum):
    """The phases of the convention, then the activities within MOVE_TO_TARGET."""

    UNDEFINED = "UNDEFINED"
    START_UP = "START_UP"
    PLANNING = "PLANNING"
    CALIBRATION = "CALIBRATION"
    TARGETING = "TARGETING"
    MANUAL = "MANUAL"
    STOP = "STOP"
    EMERGENCY = "EMERGENCY"
    ALIGN = "ALIGN"
    ALIGNED = "ALIGNED"  # waiting for the confirmation shot
    DRILL = "DRILL"
    PAUSED = "PAUSED"  # short of the planned end, waiting for the second shot
    DONE = "DONE"
    GUIDE = "GUIDE"  # holding the drill guide while a person drills
    RETRACT = "RETRACT"


class Trigger(Enum):
    """The trigger of a transition: a client's command, or an event in the robot itself."""

    START_UP = "START_UP"
    PLANNING = "PLANNING"
    CALIBRATION = "CALIBRATION"
    TARGETING = "TARGETING"
    MOVE_TO_TARGET = "MOVE_TO_TARGET"
    MANUAL = "MANUAL"
    STOP = "STOP"
    EMERGENCY = "EMERGENCY"
    DRILL = "DRILL"
    GUIDE = "GUIDE"
    RETRACT = "RETRACT"
    ARRIVED = "arrived"
    PAUSE = "pause"
    HALT = "stopped by the robot"
    FAULT = "fault"
    LOST = "client lost"
    RESET = "reset by a person"


COMMANDS = tuple(trigger for trigger in Trigger if trigger.value == trigger.name)
# States in which the robot stands still and waits for its next command.
READY = (State.START_UP, State.PLANNING, State.CALIBRATION, State.TARGETING, State.STOP)
ACTIVITIES = (State.ALIGN, State.ALIGNED, State.DRILL, State.PAUSED, State.DONE, State.GUIDE, State.RETRACT)
MOVING = (State.ALIGN, State.DRILL, State.RETRACT)
WAITING = tuple(state for state in ACTIVITIES if state not in MOVING)


def _table() -> dict[tuple[State, Trigger], State]:
    still = (*READY, *WAITING, State.MANUAL)
    rest = (Trigger.START_UP, Trigger.PLANNING, Trigger.CALIBRATION, Trigger.TARGETING, Trigger.MANUAL)
    table = {(state, trigger): State[trigger.name] for state in still for trigger in rest}
    table[State.UNDEFINED, Trigger.START_UP] = State.START_UP
    # Each MOVE_TO_TARGET goes one step further, so that a client of the 2013 convention can complete an insertion.
    table |= {
        (State.TARGETING, Trigger.MOVE_TO_TARGET): State.ALIGN,
        (State.STOP, Trigger.MOVE_TO_TARGET): State.ALIGN,
        (State.ALIGN, Trigger.ARRIVED): State.ALIGNED,
        (State.ALIGNED, Trigger.MOVE_TO_TARGET): State.DRILL,
        (State.ALIGNED, Trigger.DRILL): State.DRILL,
        (State.ALIGNED, Trigger.GUIDE): State.GUIDE,
        (State.DRILL, Trigger.PAUSE): State.PAUSED,
        (State.PAUSED, Trigger.MOVE_TO_TARGET): State.DRILL,
        (State.PAUSED, Trigger.DRILL): State.DRILL,
        (State.DRILL, Trigger.ARRIVED): State.DONE,
        (State.DONE, Trigger.MOVE_TO_TARGET): State.RETRACT,
        (State.GUIDE, Trigger.MOVE_TO_TARGET): State.RETRACT,
        (State.RETRACT, Trigger.ARRIVED): State.PLANNING,
    }
    table |= {(state, Trigger.RETRACT): State.RETRACT for state in (*READY, *WAITING)}
    table |= {(state, Trigger.HALT): State.STOP for state in MOVING}
    for state in State:
        if state is State.EMERGENCY:
            # The robot already stands still: STOP is accepted and changes nothing.
            table |= {
                (state, trigger): state for trigger in (Trigger.STOP, Trigger.EMERGENCY, Trigger.FAULT, Trigger.LOST)
            }
            continue
        table[state, Trigger.STOP] = State.UNDEFINED if state is State.UNDEFINED else State.STOP
        table[state, Trigger.EMERGENCY] = table[state, Trigger.FAULT] = State.EMERGENCY
        table[state, Trigger.LOST] = State.UNDEFINED
    table[State.EMERGENCY, Trigger.RESET] = State.UNDEFINED
    return table


TRANSITIONS = _table()


def phase(state: State) -> str:
    """Return the convention's phase that a state belongs to."""
    return "MOVE_TO_TARGET" if state in ACTIVITIES else state.value
