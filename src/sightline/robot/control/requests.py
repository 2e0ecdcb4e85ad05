"""Requests of clients to the controller, and its answers: plain data."""

from dataclasses import dataclass

import numpy as np

from sightline.robot.contract import Code
from sightline.robot.control.states import State
from sightline.robot.igtl import Message
from sightline.robot.kinematics.depth import SHOT_SD_MM
from sightline.robot.plant import Reading


@dataclass(frozen=True)
class CommandRequest:
    """A command by its name, known or not. `overtaken`: a stop that was sent later was handled before it.
    `by_name`: its client drills by DRILL only, never by a further MOVE_TO_TARGET."""

    name: str
    overtaken: bool = False
    by_name: bool = False


@dataclass(frozen=True)
class Register:
    """A registration as received."""

    message: Message


@dataclass(frozen=True)
class SetTarget:
    """A target as received."""

    message: Message


@dataclass(frozen=True)
class Reset:
    """A person's confirmation, over the link, that the fault of this number was read and may be reset."""

    fault: int


@dataclass(frozen=True)
class ShotDepth:
    """Depth of the tip beyond the entry point in the check shot, and its standard deviation; mm."""

    depth_mm: float
    sd_mm: float = SHOT_SD_MM


Request = CommandRequest | Register | SetTarget | Reset | ShotDepth


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
    deviation, both None without a target; `wanted` (5,): the commanded position of the joints."""

    state: State
    reading: Reading
    velocity: np.ndarray
    wanted: np.ndarray
    commanded: np.ndarray
    depth_mm: float | None
    depth_sd_mm: float | None
    fault: RobotFault | None
