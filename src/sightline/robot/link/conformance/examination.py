"""The conformance test of a robot against the contract of docs/robot-link.md, over the link."""

from dataclasses import dataclass
from enum import Enum

from sightline.common.closing import Closing
from sightline.errors import SightlineError
from sightline.robot.igtl import Fault, Rejected
from sightline.robot.link.client import RobotClient
from sightline.robot.link.conformance import commands, poses
from sightline.robot.link.conformance.conversation import Conversation, NotAskedError, Question, UnsupportedError

QUESTIONS: dict[str, Question] = {
    **commands.COMMANDS,
    **poses.QUESTIONS,
    **commands.STOPS,
    **commands.MESSAGES,
    **commands.CLIENTS,
    **commands.EMERGENCIES,
}


class ConformanceVerdict(Enum):
    """The verdict on one question."""

    PASSED = "pass"
    FAILED = "FAIL"
    UNSUPPORTED = "not supported"
    NOT_ASKED = "not asked"


@dataclass(frozen=True)
class Finding:
    """One question with its verdict and what was observed."""

    name: str
    verdict: ConformanceVerdict
    seen: str


class Examination(Closing):
    """Conformance test of one robot. It opens a second connection where the robot's CAPABILITY allows several clients.

    Raises LinkError where no robot listens.
    """

    def __init__(self, host: str, port: int) -> None:
        self._host, self._port = host, port
        self._unreadable: list[Rejected] = []
        self._robot: RobotClient | None = RobotClient(host, port)
        self.simulated = self._robot.simulated

    def close(self) -> None:
        """Close the connection."""
        if self._robot is not None:
            self._robot.close()
            self._robot = None

    def examine(self) -> list[Finding]:
        """Ask all questions that do not move the robot, and return the findings."""
        findings = [self._ask(name, question) for name, question in QUESTIONS.items()]
        return [*findings, self._read_all()]

    def dry_run(self) -> list[Finding]:
        """Run motions to a target in air ahead of the wire, most of them stopped, and return the findings.

        It sends no DRILL. Warning: on robots of the 2013 convention MOVE_TO_TARGET may insert the wire. Call it only
        after a person has confirmed that the path is clear.
        """
        return [self._ask(name, question) for name, question in poses.MOTIONS.items()]

    def _ask(self, name: str, question: Question) -> Finding:
        try:
            if self._robot is None:
                self._robot = RobotClient(self._host, self._port)
            finding = Finding(name, ConformanceVerdict.PASSED, question(Conversation(self._robot)))
        except UnsupportedError as why:
            return Finding(name, ConformanceVerdict.UNSUPPORTED, str(why))
        except NotAskedError as why:
            finding = Finding(name, ConformanceVerdict.NOT_ASKED, str(why))
        except SightlineError as error:
            finding = Finding(name, ConformanceVerdict.FAILED, str(error))
        if self._robot is not None:
            self._unreadable += self._robot.connection.unreadable
            self._robot.connection.unreadable.clear()
            if self._robot.connection.closed:
                self.close()
        return finding

    def _read_all(self) -> Finding:
        name = "every message can be read"
        # Fatal errors have already failed their question; other message types are allowed.
        bad = [e.reason for e in self._unreadable if not e.fatal and e.fault is not Fault.UNKNOWN_TYPE]
        if bad:
            seen = f"correct the robot's encoding: {len(bad)} of its messages cannot be read, the first: {bad[0]}"
            return Finding(name, ConformanceVerdict.FAILED, seen)
        return Finding(name, ConformanceVerdict.PASSED, "CRC and content of all received messages are valid")
