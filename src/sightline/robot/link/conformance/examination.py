"""The conformance test of a robot against the contract of docs/robot-link.md, over the link."""

from contextlib import suppress
from dataclasses import dataclass
from enum import Enum

from sightline.common.closing import Closing
from sightline.errors import RobotRefusedError, SightlineError
from sightline.robot import contract
from sightline.robot.igtl import Fault, Rejected
from sightline.robot.link.client import RobotClient
from sightline.robot.link.conformance import commands, poses
from sightline.robot.link.conformance.conversation import (
    Conversation,
    NotAskedError,
    Question,
    UnsupportedError,
    Workplace,
)

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

    `frame_serial`: of the frame on its flange. Raises LinkError where no robot listens.
    """

    def __init__(self, host: str, port: int, frame_serial: str) -> None:
        self._host, self._port = host, port
        self._workplace = Workplace(frame_serial)
        self._unreadable: list[Rejected] = []
        self._robot: RobotClient | None = RobotClient(host, port)
        self.simulated = self._robot.simulated

    def close(self) -> None:
        """Close the connection."""
        if self._robot is not None:
            self._robot.close()
            self._robot = None

    def draw_back(self) -> None:
        """Draw the wire into its sleeve, so that targets are within reach. Call it only after a person has confirmed
        that the way is clear. A robot that cannot do it is examined where it stands."""
        robot = self._robot
        if robot is not None and contract.HAS_DRILLING in robot.capabilities:
            with suppress(RobotRefusedError):
                robot.start_up()
                robot.retract()

    def examine(self) -> list[Finding]:
        """Ask all questions that do not move the robot, and return the findings."""
        findings = [self._ask(name, question) for name, question in QUESTIONS.items()]
        return [*findings, self._read_all()]

    def dry_run(self) -> list[Finding]:
        """Run motions to targets in air ahead of the wire, most of them stopped, and return the findings. The arm ends
        on the line where the test found it.

        A robot that keeps the contract drills nothing. Warning: a faulty one may, and on robots of the 2013 convention
        MOVE_TO_TARGET may insert the wire. Call it only after a person has confirmed that the path is clear.
        """
        return [self._ask(name, question) for name, question in poses.MOTIONS.items()]

    def leave_out_dry_run(self) -> list[Finding]:
        """Return the findings of a dry run that nobody agreed to: none of its questions was asked."""
        return [Finding(name, ConformanceVerdict.NOT_ASKED, "there was no dry run") for name in poses.MOTIONS]

    def _ask(self, name: str, question: Question) -> Finding:
        try:
            if self._robot is None:
                self._robot = RobotClient(self._host, self._port)
            finding = Finding(name, ConformanceVerdict.PASSED, question(Conversation(self._robot, self._workplace)))
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
