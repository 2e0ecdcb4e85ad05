"""The robot's dialogue with clients: converts messages to requests, and answers and outcomes to messages.

It does no input or output: `receive` and `cycle` return the messages to be sent, in order.
"""

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from sightline.robot import contract
from sightline.robot.contract import Code
from sightline.robot.control.controller import TARGET, Controller
from sightline.robot.control.drilling import Drilling
from sightline.robot.control.requests import Answer, Outcome
from sightline.robot.control.states import COMMANDS, MOVING, Trigger
from sightline.robot.igtl import (
    MILLIMETRE,
    Capability,
    Command,
    CommandReply,
    Event,
    Get,
    Message,
    Rejected,
    Sensor,
    Status,
    String,
    Transform,
)
from sightline.robot.link.inbox import AnswerCache, stop_word
from sightline.robot.link.outgoing import (
    SIGHTLINE,
    Cycles,
    Dialect,
    NamedBody,
    Outgoing,
    Telemetry,
    echo_of,
    fitting,
    message_of,
    with_mirror,
)
from sightline.robot.plant import CYCLE_S

UNDERSTOOD = (
    "STRING",
    "STATUS",
    "TRANSFORM",
    "COMMAND",
    "CAPABILITY",
    "GET_STATUS",
    "GET_TRANS",
    "GET_NDARRAY",
    "GET_CAPABIL",
)
_ACTIVITIES = (Trigger.DRILL, Trigger.GUIDE, Trigger.RETRACT)
PHASES = tuple(command.value for command in COMMANDS if command not in _ACTIVITIES)  # of the 2013 convention
OFFERED = (contract.HAS_TELEMETRY, contract.HAS_DRILLING, contract.HAS_PLAN, contract.HAS_RESET)


@dataclass
class _Peer:
    version: int = 1  # of headers: 1 until the client sends 2
    telemetry: bool = False
    drills_by_name: bool = False
    mirrored: bool = False  # each STATUS also goes out as a STRING
    sent_emergency: bool = False  # sent EMERGENCY and has not been answered yet
    told_s: float = -np.inf
    asked: AnswerCache = field(default_factory=AnswerCache)


@dataclass
class Dialogue:
    """The dialogue of one controller with all its clients, which are identified by a number.

    `telemetry_s`: period of the streams. `truth`: a simulator's answer to SIMULATED_WIRE; None if there is none.
    `dialect`: for the clients.
    """

    controller: Controller
    simulated: bool = False
    truth: Callable[[], str] | None = None
    telemetry_s: float = contract.TELEMETRY_S
    dialect: Dialect = SIGHTLINE
    cycles: Cycles = field(default_factory=Cycles, init=False)

    def __post_init__(self) -> None:
        self._machine = self.controller.machine
        self._facts = Telemetry(self._machine, self.cycles)
        self._peers: dict[int, _Peer] = {}
        self._hole: Drilling | None = None
        self._events = 0  # events of this hole that were already sent

    def joined(self, client: int) -> None:
        """Add a client; its stop may have been handled already."""
        self._peers.setdefault(client, _Peer())

    def left(self, client: int, now_s: float) -> None:
        """Remove a client that is gone."""
        self._peers.pop(client, None)
        self.controller.lost(client, now_s)

    def receive(self, client: int, event: Event, now_s: float, overtaken: bool = False) -> list[Outgoing]:
        """Handle a client's message and return the answers. Every command and query is answered, nothing else is.
        `overtaken`: a stop that was sent later has been handled."""
        if isinstance(event, Rejected):
            return self._rejected(client, event)
        self.joined(client)
        peer = self._peers[client]
        peer.version = max(peer.version, event.version)
        self.controller.heard(client)
        return self._all(client, self._answer(client, event, now_s, overtaken))

    def cycle(self, now_s: float, unread_s: float = 0.0) -> list[Outgoing]:
        """Run one cycle of the controller and return the messages to send. `unread_s`: see `Controller.cycle`."""
        outgoing = []
        for outcome in self.controller.cycle(now_s, unread_s):
            for client in [outcome.client] if outcome.client is not None else list(self._peers):
                outgoing += self._all(client, self._of_outcome(client, outcome))
        return outgoing + self._new_events() + self._telemetry(now_s)

    # Answers, as (device name, body) in order.

    def _answer(self, client: int, message: Message, now_s: float, overtaken: bool) -> list[NamedBody]:
        name = message.device_name
        bodies: list[NamedBody] = []
        match message.body:
            case String(text):
                bodies = self._of_string(client, name, text, now_s, overtaken)
            case Transform():
                bodies = self._of_transform(client, message, now_s)
            case Command(number, command, text):
                bodies = [(name, self._of_command(client, number, command, text))]
            case Capability(types):
                self._peers[client].telemetry = contract.HAS_TELEMETRY in types
                self._peers[client].drills_by_name = contract.HAS_DRILLING in types
                self.controller.heard(client, heartbeat=contract.HAS_HEARTBEAT in types)
                bodies = [self._capability()]
            case Get("CAPABILITY"):
                bodies = [self._capability()]
            case Get("STATUS"):
                bodies = [self._facts.state_now()]
            case Get("TRANSFORM"):
                bodies = [self._facts.position()]
            case Get("NDARRAY"):
                bodies = [self._facts.joints(self._machine.snapshot())]
            case _:
                pass  # what is not understood gets no answer
        return bodies

    def _capability(self) -> NamedBody:
        watches = (contract.HAS_HEARTBEAT,) if self._machine.lease.watches else ()
        guides = () if self.controller.machine.robot.manipulator.has_feed else (contract.HAS_GUIDE,)
        here = OFFERED + guides + watches + ((contract.IS_SIMULATED,) if self.simulated else ())
        return "", Capability(UNDERSTOOD + here)

    def _of_transform(self, client: int, message: Message, now_s: float) -> list[NamedBody]:
        name = message.device_name
        if name.startswith(contract.TARGET):
            return self._of_target(client, message, now_s)
        if name.startswith(contract.CALIBRATION):
            answer = self.controller.register(client, message, now_s)
            return [echo_of(name, message.body), (Trigger.CALIBRATION.value, self._status(answer))]
        text = f"a TRANSFORM is named {contract.CALIBRATION}... or {contract.TARGET}..., not {name!r}"
        return [(fitting(name), Status(Code.UNKNOWN, Code.UNKNOWN.name, text))]

    def _of_string(self, client: int, name: str, text: str, now_s: float, overtaken: bool) -> list[NamedBody]:
        if name.startswith(contract.COMMAND):
            return self._of_phase(client, name, text, now_s, overtaken)
        if name == contract.HEARTBEAT:
            self.controller.heard(client, heartbeat=True)
            return []
        if name == contract.MIRROR_STATUS:
            self._peers[client].mirrored = True
            return [self._facts.state_now()]
        if contract.CURRENT_POSITION in (name, text):
            return [self._facts.position()]
        if contract.CURRENT_STATUS in (name, text):
            return [self._facts.state_now()]
        reason = f"a STRING is named {contract.COMMAND}..., {contract.HEARTBEAT}, or asks for {contract.CURRENT_STATUS}"
        return [(fitting(name), Status(Code.UNKNOWN, Code.UNKNOWN.name, reason))]

    def _of_phase(self, client: int, name: str, text: str, now_s: float, overtaken: bool) -> list[NamedBody]:
        """Answer a CMD_. A stop acts whatever its identifier; other commands act only the first time they come."""
        peer, stop = self._peers[client], stop_word(text)
        answer = None if stop else peer.asked.earlier(name, text)
        if answer is None:
            peer.sent_emergency |= stop == Trigger.EMERGENCY.value
            answer = self.controller.command(
                client, stop or text, now_s, overtaken=overtaken, by_name=peer.drills_by_name
            )
            peer.asked.put(name, text, answer)
        bodies: list[NamedBody] = [
            (contract.ACKNOWLEDGED + name.removeprefix(contract.COMMAND), String(text)),
            (contract.CURRENT_STATUS, self._after_command(stop or text)),
        ]
        entered = answer.code is Code.OK and text in (Trigger.PLANNING.value, Trigger.CALIBRATION.value)
        if not answer.done or (entered and not self.dialect.tells_entered):
            return bodies
        return [*bodies, (fitting(stop or text), self._status(answer))]

    def _after_command(self, text: str) -> Status:
        commanded = self.dialect.names_commanded and text in PHASES
        return replace(self._facts.current(), error_name=text) if commanded else self._facts.current()

    def _of_target(self, client: int, message: Message, now_s: float) -> list[NamedBody]:
        answer = self.controller.set_target(client, message, now_s)
        return [echo_of(message.device_name, message.body), *(self._target_answer(answer) if answer.done else [])]

    def _target_answer(self, answer: Answer) -> list[NamedBody]:
        bodies: list[NamedBody] = [(TARGET, self._status(answer))]
        insertion = self._machine.insertion
        if answer.code is Code.OK and insertion is not None:
            bodies.append((TARGET, insertion.sent))
            if self.dialect.tells_reachable:
                if (hole := self._machine.open_hole(insertion)) is not None:
                    bodies.append((contract.OPEN_HOLE_DEPTH, Sensor(np.array([hole.bottom_mm]), MILLIMETRE)))
                reached = insertion.T_cfcs_wire(self._machine.robot.manipulator)
                bodies.append(("REACHABLE_TARGET", Transform.of(reached)))
        return bodies

    def _of_command(self, client: int, number: int, command: str, text: str) -> CommandReply:
        if command == contract.SIMULATED_WIRE and self.truth is not None:
            return CommandReply(number, "", self.truth())
        request = self._request(client, command, text)
        if isinstance(request, str):
            return CommandReply(number, "refused", request)
        asked, identifier = self._peers[client].asked, f"COMMAND {number}"
        answer = asked.earlier(identifier, f"{command} {text}")
        if answer is None:
            answer = request()
            asked.put(identifier, f"{command} {text}", answer)
        return CommandReply(number, "" if answer.code is Code.OK else "refused", answer.text)

    def _request(self, client: int, command: str, text: str) -> Callable[[], Answer] | str:
        """Return the request in a COMMAND, or a text that says what is wrong with it."""
        if command == contract.RESET:
            digits = text.isascii() and text.isdigit() and len(text) < 10
            return partial(self.controller.reset, int(text)) if digits else f"{command} carries the number of the fault"
        if command == contract.SHOT_DEPTH:
            numbers = text[:80].split()
            with suppress(ValueError):
                if 1 <= len(numbers) <= 2:
                    return partial(self.controller.shot_depth, client, *map(float, numbers))
            return f"{command} carries a depth in mm, and its standard deviation if known: '79.6 0.15'"
        return f"there is no COMMAND {command[:40]!r}; there are {contract.RESET} and {contract.SHOT_DEPTH}"

    def _rejected(self, client: int, event: Rejected) -> list[Outgoing]:
        """Answer an unreadable message, which may have been a command; unknown types are not commands."""
        if event.fatal or event.header is None or event.header.type_name not in UNDERSTOOD:
            return []
        return self._all(client, [(contract.CURRENT_STATUS, Status(Code.CONFIGURATION, "UNREADABLE", event.reason))])

    def _of_outcome(self, client: int, outcome: Outcome) -> list[NamedBody]:
        answer = Answer(outcome.code, outcome.text)
        if outcome.name == TARGET:
            return self._target_answer(answer)
        if client in self._peers:
            self._peers[client].asked.ended(outcome.name, answer)
            if outcome.code is Code.EMERGENCY and self._peers[client].sent_emergency:
                self._peers[client].sent_emergency = False
                answer = Answer(self.dialect.own_emergency, outcome.text)
        bodies: list[NamedBody] = [(fitting(outcome.name), self._status(answer))]
        if outcome.name == Trigger.MOVE_TO_TARGET.value:
            bodies.append(self._facts.position())
        return bodies

    def _status(self, answer: Answer) -> Status:
        code = self.dialect.in_manual if answer.code is Code.MANUAL else answer.code
        return Status(int(code), "" if code is Code.OK else code.name, answer.text)

    # Streams.

    def _new_events(self) -> list[Outgoing]:
        """Return the supervision events since the last cycle for all clients with telemetry; they are never dropped."""
        if self._machine.drilling is not self._hole:
            self._hole, self._events = self._machine.drilling, 0
        noted = [] if self._hole is None else self._hole.noted[self._events :]
        self._events += len(noted)
        bodies: list[NamedBody] = [
            (contract.EVENT, String(f"{n.event.value}; {n.depth_mm:.2f} mm; {n.force_n:.1f} N")) for n in noted
        ]
        listening = [client for client, peer in self._peers.items() if peer.telemetry] if bodies else []
        return [outgoing for client in listening for outgoing in self._all(client, bodies)]

    def _telemetry(self, now_s: float) -> list[Outgoing]:
        """Return the streams that are due, and the position to the leaseholder while the robot moves."""
        outgoing: list[Outgoing] = []
        streams: list[NamedBody] = []
        moves_for = self.controller.lease if self._machine.state in MOVING else None
        for client, peer in self._peers.items():
            if now_s - peer.told_s <= self.telemetry_s - CYCLE_S / 2 or not (peer.telemetry or client == moves_for):
                continue
            peer.told_s = now_s
            if peer.telemetry and not streams:
                streams = self._facts.streams(self._machine.snapshot())
            position = [self._facts.position()] if client == moves_for else []
            outgoing += self._all(client, position + (streams if peer.telemetry else []), telemetry=True)
        return outgoing

    def _all(self, client: int, bodies: list[NamedBody], *, telemetry: bool = False) -> list[Outgoing]:
        peer = self._peers.get(client) or _Peer()
        if peer.mirrored:
            bodies = [each for name, body in bodies for each in with_mirror(name, body)]
        return [Outgoing(client, message_of(name, body, peer.version), telemetry) for name, body in bodies]
