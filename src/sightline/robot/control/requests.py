"""Answers to requests and their outcomes, and the robot's own panel."""

from dataclasses import dataclass, replace

import numpy as np

from sightline.robot.contract import Code
from sightline.robot.control.states import State
from sightline.robot.plant import Reading


@dataclass(frozen=True)
class Answer:
    """The immediate answer to a request. If not `done`, an Outcome follows."""

    code: Code
    text: str = ""
    done: bool = True


class RequestRefusedError(Exception):
    """A refused request; `answer` goes to the client."""

    def __init__(self, code: Code, text: str) -> None:
        super().__init__(text)
        self.answer = Answer(code, text)


@dataclass(frozen=True)
class Outcome:
    """How a command or a target's collision check ended, for the client that sent it; `client` None: for all."""

    client: int | None
    name: str
    code: Code
    text: str


@dataclass(frozen=True)
class RobotFault:
    """Why the robot is in EMERGENCY."""

    number: int
    code: Code
    text: str


@dataclass(frozen=True, eq=False)
class Snapshot:
    """The controller's state at one time. `depth_mm`: of the tip beyond the entry point, `depth_sd_mm`: its standard
    deviation, both None without a target; `guide_off`: as of `Machine`; `wanted` (n,): the commanded position of the
    joints."""

    state: State
    reading: Reading
    velocity: np.ndarray
    wanted: np.ndarray
    commanded: np.ndarray
    depth_mm: float | None
    depth_sd_mm: float | None
    guide_off: tuple[float, float] | None
    fault: RobotFault | None


class Outcomes:
    """Outcomes since the last `take`, and stops that are not done yet."""

    def __init__(self) -> None:
        self._due: list[Outcome] = []
        self._stops: list[Outcome] = []  # reported once the joints stand still
        self._after_stops: list[Outcome] = []

    @property
    def stopping(self) -> bool:
        """Whether a stop was obeyed and the joints have not yet come to rest."""
        return bool(self._stops)

    def add(self, outcome: Outcome) -> None:
        """Queue an outcome for immediate report."""
        self._due.append(outcome)

    def conclude(self, outcome: Outcome) -> None:
        """Queue the outcome of a motion or a collision check; if a stop ended it, after that stop."""
        (self._after_stops if self._stops else self._due).append(outcome)

    def stop(self, outcome: Outcome) -> None:
        """Queue a stop that was obeyed, to be reported when the joints stand still."""
        self._stops.append(outcome)

    def stand(self) -> None:
        """The joints stand still: release the stops and what they ended."""
        self._due += self._stops + self._after_stops
        self._stops, self._after_stops = [], []

    def still_move(self, text: str) -> None:
        """The joints still move: turn the stops into failures, which the next `stand` releases."""
        self._stops = [replace(stop, code=Code.HARDWARE, text=text) for stop in self._stops]

    def drop_stops(self, client: int) -> None:
        """Drop the stops of a client that is gone."""
        self._stops = [stop for stop in self._stops if stop.client != client]

    def take(self) -> tuple[Outcome, ...]:
        """Return and remove the outcomes that are due."""
        due, self._due = tuple(self._due), []
        return due


class Panel:
    """Reset button and key switch. The stop button and the hold-to-run switch act on the drives and come with the
    plant's readings (`PlantFlag`)."""

    def __init__(self, *, key_switch: bool = False) -> None:
        self.key_switch = key_switch  # if fitted, a reset over the link is refused
        self._pressed = False

    def reset(self) -> None:
        """Press the reset button: a person has dealt with the fault. Any thread may call it."""
        self._pressed = True

    def take_reset(self) -> bool:
        """Return whether the button was pressed since the last call."""
        pressed, self._pressed = self._pressed, False
        return pressed
