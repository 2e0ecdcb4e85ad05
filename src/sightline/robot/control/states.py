"""What the robot may be doing, and what leads from one state to another: the one table, as data.

A state is a phase of the convention or, below MOVE_TO_TARGET, an activity. What is not in the table is refused.
"""

from enum import Enum


class State(Enum):
    """The phases of the convention, then the activities below MOVE_TO_TARGET."""

    UNDEFINED = "UNDEFINED"
    START_UP = "START_UP"
    PLANNING = "PLANNING"
    CALIBRATION = "CALIBRATION"
    TARGETING = "TARGETING"
    MANUAL = "MANUAL"
    STOP = "STOP"
    EMERGENCY = "EMERGENCY"
    ALIGN = "ALIGN"
    ALIGNED = "ALIGNED"  # waits for the confirmation shot
    DRILL = "DRILL"
    PAUSED = "PAUSED"  # short of the tip, waits for the second shot
    DONE = "DONE"
    GUIDE = "GUIDE"  # holds a drill guide, a person drills
    RETRACT = "RETRACT"


class Cause(Enum):
    """What leads from state to state: a command of a client, or what the robot itself notices."""

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


COMMANDS = tuple(cause for cause in Cause if cause.value == cause.name)
# Where the robot stands still and waits for its next command.
READY = (State.START_UP, State.PLANNING, State.CALIBRATION, State.TARGETING, State.STOP)
ACTIVITIES = (State.ALIGN, State.ALIGNED, State.DRILL, State.PAUSED, State.DONE, State.GUIDE, State.RETRACT)
MOVING = (State.ALIGN, State.DRILL, State.RETRACT)
WAITING = tuple(state for state in ACTIVITIES if state not in MOVING)


def _table() -> dict[tuple[State, Cause], State]:
    still = (*READY, *WAITING, State.MANUAL)
    rest = (Cause.START_UP, Cause.PLANNING, Cause.CALIBRATION, Cause.TARGETING, Cause.MANUAL)
    table = {(state, cause): State[cause.name] for state in still for cause in rest}
    table[State.UNDEFINED, Cause.START_UP] = State.START_UP
    # Each MOVE_TO_TARGET goes one step further, so that a client of the old convention can go them all.
    table |= {
        (State.TARGETING, Cause.MOVE_TO_TARGET): State.ALIGN,
        (State.STOP, Cause.MOVE_TO_TARGET): State.ALIGN,
        (State.ALIGN, Cause.ARRIVED): State.ALIGNED,
        (State.ALIGNED, Cause.MOVE_TO_TARGET): State.DRILL,
        (State.ALIGNED, Cause.DRILL): State.DRILL,
        (State.ALIGNED, Cause.GUIDE): State.GUIDE,
        (State.DRILL, Cause.PAUSE): State.PAUSED,
        (State.PAUSED, Cause.MOVE_TO_TARGET): State.DRILL,
        (State.PAUSED, Cause.DRILL): State.DRILL,
        (State.DRILL, Cause.ARRIVED): State.DONE,
        (State.DONE, Cause.MOVE_TO_TARGET): State.RETRACT,
        (State.GUIDE, Cause.MOVE_TO_TARGET): State.RETRACT,
        (State.RETRACT, Cause.ARRIVED): State.PLANNING,
    }
    table |= {(state, Cause.RETRACT): State.RETRACT for state in (*READY, *WAITING)}
    table |= {(state, Cause.HALT): State.STOP for state in MOVING}
    for state in State:
        if state is State.EMERGENCY:
            # Standing still already: STOP is obeyed, and ends nothing.
            table |= {(state, cause): state for cause in (Cause.STOP, Cause.EMERGENCY, Cause.FAULT, Cause.LOST)}
            continue
        table[state, Cause.STOP] = State.UNDEFINED if state is State.UNDEFINED else State.STOP
        table[state, Cause.EMERGENCY] = table[state, Cause.FAULT] = State.EMERGENCY
        table[state, Cause.LOST] = State.UNDEFINED
    table[State.EMERGENCY, Cause.RESET] = State.UNDEFINED
    return table


TRANSITIONS = _table()


def phase(state: State) -> str:
    """The convention's phase that a state belongs to."""
    return "MOVE_TO_TARGET" if state in ACTIVITIES else state.value


def diagram() -> str:
    """The table as a state diagram in Mermaid, as docs/robot-link.md shows it. An arrow from a box of several states
    leads out of each of them; commands that change nothing are not drawn."""
    lines = ["stateDiagram-v2", "    [*] --> UNDEFINED"]
    for box, inside in _INSIDE.items():
        lines += [f"    state {box} {{", *(f"        {name}" for name in inside), "    }"]
    arrows: dict[tuple[str, str], list[str]] = {}
    for (cause, target), sources in _sources().items():
        for source in _boxed(sources):
            if source != target.value:
                arrows.setdefault((source, target.value), []).append(cause.value)
    return "\n".join(lines + [f"    {a} --> {b}: {', '.join(causes)}" for (a, b), causes in arrows.items()])


_BOXES = {
    "MOVE_TO_TARGET": ACTIVITIES,
    "READY": READY,
    "WAITING": WAITING,
    "MOVING": MOVING,
}  # the largest first
_INSIDE = {
    "READY": [state.value for state in READY],
    "WAITING": [state.value for state in WAITING],
    "MOVING": [state.value for state in MOVING],
    "MOVE_TO_TARGET": ["WAITING", "MOVING"],
}


def _sources() -> dict[tuple[Cause, State], set[State]]:
    out: dict[tuple[Cause, State], set[State]] = {}
    for (source, cause), target in TRANSITIONS.items():
        out.setdefault((cause, target), set()).add(source)
    return out


def _boxed(sources: set[State]) -> list[str]:
    """Names of the boxes, and of the states left over, that make up a set of states."""
    left, out = set(sources), []
    for box, states in _BOXES.items():
        if left.issuperset(states):
            out.append(box)
            left.difference_update(states)
    return out + [state.value for state in State if state in left]
