"""Does a robot keep the contract of docs/robot-link.md? Asked over the link, of any robot; the answer is a table.

Nothing moves but in the dry run, which aligns in air and drills nothing. A question judges one thing: what leads to it
is taken as it comes, and where it does not lead there the question is not asked.
"""

from dataclasses import dataclass
from enum import Enum

from sightline.closing import Closing
from sightline.errors import SightlineError
from sightline.robot.igtl import Fault, Rejected
from sightline.robot.link.client import RobotClient
from sightline.robot.link.conformance.asking import Question, UnsupportedError
from sightline.robot.link.conformance.conversation import NotAskedError
from sightline.robot.link.conformance.motions import MOTIONS
from sightline.robot.link.conformance.questions import QUESTIONS


class Verdict(Enum):
    """Of one question."""

    PASSED = "pass"
    FAILED = "FAIL"
    UNSUPPORTED = "not supported"
    NOT_ASKED = "not asked"


@dataclass(frozen=True)
class Finding:
    """One question, its answer, and what was seen."""

    name: str
    verdict: Verdict
    seen: str


class Examination(Closing):
    """A robot's examination, over one connection; robots that take several, by their CAPABILITY, are asked over a
    second one too. Raises LinkError where nobody listens."""

    def __init__(self, host: str, port: int) -> None:
        self._host, self._port = host, port
        self._unreadable: list[Rejected] = []
        self._robot: RobotClient | None = RobotClient(host, port)
        self.simulated = self._robot.simulated

    def close(self) -> None:
        """End it."""
        if self._robot is not None:
            self._robot.close()
            self._robot = None

    def examine(self) -> list[Finding]:
        """All questions that move nothing."""
        found = [self._ask(name, question) for name, question in QUESTIONS.items()]
        return [*found, self._read_all()]

    def dry_run(self) -> list[Finding]:
        """Motions to a target in air ahead of the wire, most of them stopped; nothing is drilled. On robots of the old
        convention a MOVE_TO_TARGET may insert: the caller must have a person's word that nobody is in the way."""
        return [self._ask(name, question) for name, question in MOTIONS.items()]

    def _ask(self, name: str, question: Question) -> Finding:
        try:
            robot = self._connected()
            said = Finding(name, Verdict.PASSED, question(robot))
        except UnsupportedError as why:
            return Finding(name, Verdict.UNSUPPORTED, str(why))
        except NotAskedError as why:
            said = Finding(name, Verdict.NOT_ASKED, str(why))
        except SightlineError as error:
            said = Finding(name, Verdict.FAILED, str(error))
        if self._robot is not None:
            self._unreadable += self._robot.talk.unreadable
            self._robot.talk.unreadable.clear()
            if self._robot.talk.closed:
                self.close()
        return said

    def _connected(self) -> RobotClient:
        if self._robot is None:
            self._robot = RobotClient(self._host, self._port)
        return self._robot

    def _read_all(self) -> Finding:
        name = "every message can be read"
        # What is fatal has failed its question already; other types are the robot's own affair.
        bad = [e.reason for e in self._unreadable if not e.fatal and e.fault is not Fault.UNKNOWN_TYPE]
        if bad:
            return Finding(name, Verdict.FAILED, f"{len(bad)} could not, the first: {bad[0]}")
        return Finding(name, Verdict.PASSED, "CRC and content of all that came")
