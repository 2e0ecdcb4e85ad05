"""What clients ask of the controller, and what it says: data alone."""

from dataclasses import dataclass

import numpy as np

from sightline.robot.contract import Code
from sightline.robot.control.motion.depth import SHOT_SD_MM
from sightline.robot.control.states import State
from sightline.robot.igtl import Message
from sightline.robot.plant import Reading


@dataclass(frozen=True)
class Command:
    """A command by its name, known or not. `overtaken`: a stop that was sent later has been heard before it.
    `by_name`: its client drills by DRILL, and never by a further MOVE_TO_TARGET."""

    name: str
    overtaken: bool = False
    by_name: bool = False


@dataclass(frozen=True)
class Register:
    """A registration, as it came."""

    message: Message


@dataclass(frozen=True)
class Aim:
    """A target, as it came."""

    message: Message


@dataclass(frozen=True)
class Reset:
    """A person's reset from afar, after they read this fault."""

    fault: int


@dataclass(frozen=True)
class ShotDepth:
    """How far beyond the entry point the second shot shows the tip, and its error, 1 s.d.; mm."""

    depth_mm: float
    sd_mm: float = SHOT_SD_MM


Request = Command | Register | Aim | Reset | ShotDepth


@dataclass(frozen=True)
class Answer:
    """To a request, at once. Where it is not yet `done`, an Outcome follows."""

    code: Code
    text: str = ""
    done: bool = True


class RequestRefusedError(Exception):
    """Becomes the answer to a request."""

    def __init__(self, code: Code, text: str) -> None:
        super().__init__(text)
        self.answer = Answer(code, text)


@dataclass(frozen=True)
class Outcome:
    """How a command, or the look at a target, ended, for the client that sent it; None: something all must know."""

    client: int | None
    name: str
    code: Code
    text: str


@dataclass(frozen=True)
class Fault:
    """Why the robot is in EMERGENCY."""

    number: int
    code: Code
    text: str


@dataclass(frozen=True, eq=False)
class Snapshot:
    """What there is to know now. `depth_mm` beyond the entry point, and its error, 1 s.d., None without a target;
    `wanted` (5,): where the joints should be."""

    state: State
    reading: Reading
    velocity: np.ndarray
    wanted: np.ndarray
    commanded: np.ndarray
    depth_mm: float | None
    depth_sd_mm: float | None
    fault: Fault | None
