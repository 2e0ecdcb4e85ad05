"""A robot from a script: what a good one answers, of the convention of 2013 or of ours, and each fault by its name.

It knows no kinematics: its wire's tip goes straight from pose to pose. What it does wrong is in `flaws`, one word each;
without flaws it keeps the contract.
"""

import asyncio
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field

import numpy as np

from sightline.robot import contract
from sightline.robot.control.timing import LoopClock
from sightline.robot.igtl import (
    Capability,
    Command,
    CommandReply,
    Get,
    Message,
    NDArray,
    Rejected,
    Sensor,
    Status,
    Stream,
    String,
    Transform,
    encode,
)

PHASES = (
    "START_UP", "PLANNING", "CALIBRATION", "TARGETING", "MOVE_TO_TARGET", "MANUAL", "STOP", "EMERGENCY",
)  # fmt: skip
OURS = (
    contract.HAS_HEARTBEAT, contract.HAS_TELEMETRY, contract.HAS_DRILLING, contract.HAS_PLAN, contract.HAS_RESET,
    contract.IS_SIMULATED,
)  # fmt: skip
STEP_S = 0.01  # of a motion
SILENCE_S = 0.5  # of the client, while this robot itself runs
REACH_MM = 600.0  # of its tip, from where it stands at first
HOME = np.array([[0.0, 0.0, 1.0, 250.0], [1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 300.0], [0.0, 0.0, 0.0, 1.0]])  # MCS
SHORT_MM = 20.0  # before the entry point a robot of ours stands aligned
SIDE, SERIAL = "right", "SN-7"
DRIFT_MM_S = 0.4
LAID_ASIDE_MM = 15.0


@dataclass
class Peer(asyncio.Protocol):
    """A client's connection."""

    robot: "ScriptedRobot"
    stream: Stream = field(default_factory=Stream)
    transport: asyncio.Transport | None = None
    loop: asyncio.AbstractEventLoop = field(default_factory=asyncio.get_running_loop)
    telemetry: bool = False
    promised: bool = False
    heard_s: float = 0.0
    asked: dict[str, list] = field(default_factory=dict)  # by identifier: text, and the code that answered it

    def connection_made(self, transport) -> None:
        self.transport = transport
        self.robot.joined(self)

    def write(self, data: bytes) -> None:
        """Send bytes. Any thread."""
        self.loop.call_soon_threadsafe(self.transport.write, data)

    def data_received(self, data: bytes) -> None:
        if "whole pieces only" in self.robot.flaws:
            self.stream = Stream()
        for event in self.stream.feed(data):
            if self.robot.holds:
                self.robot.held.append((self, event))
                continue
            for peer, earlier in self.robot.held:
                self.robot.heard(peer, earlier)
            if self.robot.held and self.robot.late is not None:
                self.robot.tip = self.robot.late
            self.robot.held.clear()
            self.heard_s = self.robot.own.now_s
            self.robot.heard(self, event)
            if isinstance(event, Rejected) and event.fatal:
                self.transport.close()
                break

    def connection_lost(self, exc) -> None:
        self.robot.left(self)

    def send(self, name: str, body, later_s: float = 0.0) -> None:
        if self.transport.is_closing():
            return
        data = encode(Message(body, name))
        if later_s:
            asyncio.get_running_loop().call_later(later_s, self.transport.write, data)
        else:
            self.transport.write(data)

    __hash__ = object.__hash__
    __eq__ = object.__eq__


class ScriptedRobot:
    """`ours`: it knows what we added to the convention. `says_reachable`, `clients`: as robots of 2013 differ.
    `steps`: of a motion. `joints_at`: what its encoders say, where that matters."""

    def __init__(
        self,
        *flaws: str,
        ours: bool = True,
        clients: int = 8,
        says_reachable: bool = True,
        steps: int = 60,
        simulated: bool = True,
    ) -> None:
        self.flaws, self.steps = frozenset(flaws), steps
        self.ours, self.clients, self.says_reachable = ours, clients, says_reachable
        self.peers: list[Peer] = []
        self.lease: Peer | None = None
        self.phase, self.fault = "UNDEFINED", 7
        self.registration: np.ndarray | None = None  # maps MCS to CFCS
        self.target: np.ndarray | None = None  # the wire, MCS
        self.tip, self.moving, self.mover = HOME.copy(), None, None
        self.own = LoopClock()
        self.holds, self.held = False, []  # what it does not answer for the moment
        self.late: np.ndarray | None = None  # where it is once it has answered that
        self.joints_at: np.ndarray | None = None
        self.length_mm = 95.0  # from entry to tip
        self.depth_mm = -SHORT_MM
        self.expires_s = np.inf
        self.aligned = False
        self.deeper_mm = 0.0  # by which it drills deeper than it says
        self.open_hole_mm: float | None = None
        self.types = OURS if simulated else OURS[:-1]
        self.commands: list[str] = []
        self.plans: list[str] = []  # that it was sent, by their identifiers
        self.ends_s: dict[str, float] = {}  # of these
        self.turned_away = 0
        self.unexpected: list[str] = []  # what a robot of 2013 does not know

    # Who is there.

    def joined(self, peer: Peer) -> None:
        if len(self.peers) == self.clients:
            self.turned_away += 1
            peer.transport.close()
            return
        self.peers.append(peer)

    def left(self, peer: Peer) -> None:
        if peer in self.peers:
            self.peers.remove(peer)
        if peer is self.lease:
            self.lease = None
            if "goes on without its client" not in self.flaws:
                self.halt(13)
                self.phase = "UNDEFINED" if "keeps a lost client" not in self.flaws else self.phase
            if "keeps a lost client" not in self.flaws:
                self.registration = self.target = None
                self.aligned = False

    # Commands.

    def heard(self, peer: Peer, event) -> None:
        if isinstance(event, Rejected):
            self.unread(peer, event)
            return
        if "deaf on other connections" in self.flaws and peer is not self.peers[0]:
            return
        if "deaf to metadata" in self.flaws and event.metadata and not isinstance(event.body, Transform):
            return
        kind, _, number = event.device_name.partition("_")
        match kind, event.body:
            case "CMD", String(text):
                self.command(peer, number, text)
            case "CLB", Transform() as pose:
                self.register(peer, number, pose)
            case "TGT", Transform() as pose:
                self.aim(peer, number, pose, event.metadata)
            case _, String(text) if "CURRENT_POSITION" in (text, event.device_name):
                peer.send("CURRENT_POSITION", self.position())
            case _, String(text) if "CURRENT_STATUS" in (text, event.device_name):
                phase = "READY" if "wrong phase" in self.flaws else self.phase
                peer.send(phase, Status(1, phase if self.ours else "", phase, self.fault * (self.phase == "EMERGENCY")))
            case _ if self.ours:
                self.heard_ours(peer, event)
            case _, Get("CAPABILITY"):
                pass
            case _:
                self.unexpected.append(event.type_name)

    def heard_ours(self, peer: Peer, event) -> None:
        match event.body:
            case Capability(types):
                peer.telemetry, peer.promised = contract.HAS_TELEMETRY in types, contract.HAS_HEARTBEAT in types
                peer.send("", Capability(("STRING", *self.types)))
            case Get("CAPABILITY"):
                peer.send("", Capability(("STRING", *self.types)))
            case Get("NDARRAY"):
                peer.send(contract.MEASURED_JS, self.joints())
            case Command(number, contract.RESET, text):
                right = text == str(self.fault) or "any reset" in self.flaws
                self.phase = "UNDEFINED" if right and self.phase == "EMERGENCY" else self.phase
                peer.send(event.device_name, CommandReply(number, "" if right else "refused", ""))
            case Command(number, contract.SHOT_DEPTH, text):
                numbers = np.isfinite([*map(float, text.split())]).all()
                flaw = "takes a shot at any time" if numbers else "takes any shot"
                peer.send(event.device_name, CommandReply(number, "" if flaw in self.flaws else "refused", ""))

    def unread(self, peer: Peer, event: Rejected) -> None:
        if event.fault.value == "unknown type" and "hangs up on unknown types" in self.flaws:
            peer.transport.close()
        if event.fault.value != "wrong CRC":
            return
        if "hangs up on a wrong CRC" in self.flaws:
            peer.transport.close()
        if "answers a wrong CRC with text" in self.flaws:
            peer.transport.write(b"ERROR: the checksum does not match\n" * 9)
        if "ignores CRCs" in self.flaws and event.header.type_name == "STRING":
            self.heard(peer, Message(String(event.text), event.header.device_name))

    def command(self, peer: Peer, number: str, text: str) -> None:
        if text == "STOP" and "deaf to STOP" in self.flaws:
            return
        if self.ours and text not in ("STOP", "EMERGENCY") and self.repeated(peer, number, text):
            return
        self.commands.append(text)
        if text not in PHASES and "ignores unknown commands" in self.flaws:
            return
        if "no ACK" in self.flaws and text == "PLANNING":
            pass
        elif "late ACK" in self.flaws and text == "PLANNING":
            peer.send(f"ACK_{number}", String(text), 1.3)
        elif "STATUS before ACK" not in self.flaws:
            peer.send(f"ACK_{number}", String(text.lower() if "another ACK text" in self.flaws else text))
        code, moved = self.refusal(peer, text), self.moving
        peer.asked[number] = [text, code]
        if code == 1:
            self.obey(peer, text)
        peer.send("CURRENT_STATUS", Status(1, self.phase))
        moves = self.moving is not None and self.moving is not moved
        if not moves and (self.ours or code != 1 or text not in ("PLANNING", "CALIBRATION")):
            # As of 2013 none is sent on entering these.
            told = 3 if text == "EMERGENCY" and code == 1 else code
            peer.send(text[:20] or "UNKNOWN", Status(told))
        if moved is not None and self.moving is not moved and self.mover in self.peers:
            self.mover.send(moved.get_name(), Status(13))
            for entry in self.mover.asked.values():
                entry[1] = 13 if entry[0] == moved.get_name() else entry[1]
        if "STATUS before ACK" in self.flaws:
            peer.send(f"ACK_{number}", String(text))
        if "sends wrong CRCs" in self.flaws:
            data = encode(Message(Status(1), "NOISE"))
            peer.transport.write(data[:-1] + bytes([data[-1] ^ 1]))

    def repeated(self, peer: Peer, number: str, text: str) -> bool:
        """Whether this identifier was used before; then it is answered."""
        before, code = peer.asked.get(number, (None, 0))
        anew = {"acts on a repeat"} if before == text else {"takes an identifier twice"}
        if before == text == "MOVE_TO_TARGET":
            anew.add("moves on a repeat")
        if before is None or anew & self.flaws:
            return False
        peer.send(f"ACK_{number}", String(text))
        peer.send("CURRENT_STATUS", Status(1, self.phase))
        peer.send(text[:20], Status(code if before == text and "refuses a repeat" not in self.flaws else 10))
        return True

    def refusal(self, peer: Peer, text: str) -> int:
        """1, or the code by which it refuses."""
        if text in ("STOP", "EMERGENCY"):
            return 5 if "stops for its own client only" in self.flaws and peer is not (self.lease or peer) else 1
        if text not in (*PHASES, "DRILL", "GUIDE", "RETRACT"):
            return 12
        if self.ours and peer is not (self.lease or peer) and "no lease" not in self.flaws:
            return 5
        self.lease = peer
        if self.phase == "EMERGENCY" and "obeys in EMERGENCY" not in self.flaws:
            return 3
        if text == "PLANNING" and "no PLANNING from START_UP" in self.flaws and self.phase == "START_UP":
            return 13
        if text == "TARGETING" and self.registration is None:
            return 1 if "TARGETING without calibration" in self.flaws else 13
        if text == "MOVE_TO_TARGET":
            if self.phase == "MANUAL":
                return 1 if "moves in MANUAL" in self.flaws else 14
            if time.monotonic() > self.expires_s and "moves by an expired plan" not in self.flaws:
                return 10
            return 1 if self.target is not None or "moves without a target" in self.flaws else 13
        if text == "DRILL" and self.ours:
            ready = self.aligned or "drills unaligned" in self.flaws
            return 1 if ready and (peer.promised or "drills without heartbeats" in self.flaws) else 13
        if text == "GUIDE" and self.ours:
            return 1 if self.aligned or "guides unaligned" in self.flaws else 13
        return 1

    def obey(self, peer: Peer, text: str) -> None:
        ignored = self.flaws & {"ignores STOP while standing" if self.moving is None else "ignores STOP while moving"}
        ignored = ignored or ("deaf to others while moving" in self.flaws and peer is not self.lease and self.moving)
        if text == "STOP" and ignored:
            return
        if text in ("MOVE_TO_TARGET", "DRILL"):
            if self.target is not None:
                self.halt(13)
                self.phase = "MOVE_TO_TARGET"
                self.moving = asyncio.get_running_loop().create_task(self.move(peer, text), name=text)
                self.mover = peer
            return
        if text == "GUIDE":
            self.phase = "MOVE_TO_TARGET"
            return
        self.halt(13)
        self.aligned = False
        self.phase = "PLANNING" if text == "RETRACT" else text
        if text == "START_UP":
            self.registration = self.target = None

    def register(self, peer: Peer, number: str, pose: Transform) -> None:
        fault = pose.fault
        if fault is not None and f"takes a registration that is {_kind(fault)}" in self.flaws:
            fault = None
        good = fault is None and self.phase == "CALIBRATION" and "takes no registration" not in self.flaws
        metres = self.ours and np.linalg.norm(pose.matrix[:3, 3]) < 10.0
        good = good and ("takes a registration in metres" in self.flaws or not metres)
        self.registration = pose.matrix if good and pose.fault is None else None
        peer.send(f"ACK_{number}", self.echo(pose, "registration"))
        peer.send("CALIBRATION", Status(1 if good else 10))

    def aim(self, peer: Peer, number: str, pose: Transform, said) -> None:
        peer.send(f"ACK_{number}", self.echo(pose, "target"))
        good = self.phase == "TARGETING" and self.takes(pose, said)
        if "keeps a refused target" not in self.flaws:
            self.target = None
        if good and pose.fault is None and self.registration is not None:
            self.target = np.linalg.inv(self.registration) @ pose.matrix
        with suppress(ValueError):
            self.length_mm = float(said.get("length_mm", 95.0))
        self.expires_s = time.monotonic() + float(said.get("valid_s", "inf")) if good else np.inf
        if "plan" in said:
            self.plans.append(said["plan"])
            self.ends_s[said["plan"]] = min(self.ends_s.get(said["plan"], np.inf), self.expires_s)
        peer.send("TARGET", Status(1 if good else 10))
        if good:
            peer.send("TARGET", pose)
            if self.says_reachable:
                if self.open_hole_mm is not None:
                    peer.send(contract.OPEN_HOLE_DEPTH, Sensor(np.array([self.open_hole_mm])))
                reached = self.aside(self.aside(pose.matrix, "would lay it aside"), "would lay it deeper")
                peer.send("REACHABLE_TARGET", Transform(reached))

    def takes(self, pose: Transform, said) -> bool:
        if pose.fault is not None:
            return f"takes a target that is {_kind(pose.fault)}" in self.flaws
        place = np.linalg.inv(self.registration) @ pose.matrix
        if np.linalg.norm(place[:3, 3] - HOME[:3, 3]) > REACH_MM:
            return "takes a target out of reach" in self.flaws
        if not self.ours:
            return True
        if np.linalg.norm(pose.matrix[:3, 3]) < 1.0 and "takes metres" not in self.flaws:
            return False
        if said.get("coordinates", "CFCS") != "CFCS" and "takes any frame" not in self.flaws:
            return False
        if said.get("units", "mm") != "mm" and "takes any unit" not in self.flaws:
            return False
        if "plan" not in said:
            return True
        if any(key not in said for key in contract.PLAN_KEYS):
            return "takes half a plan" in self.flaws
        return self.fault_of(said) in ("", *self.flaws)

    def fault_of(self, said) -> str:
        """The flaw of a robot that takes this plan; '' where it is in order."""
        limit, valid = (_number(said[key]) for key in ("depth_limit_mm", "valid_s"))
        if not np.isfinite(length := _number(said["length_mm"])):
            return "takes any depth"
        faults = {
            "takes NO-GO": said["go"] != "yes",
            "takes any side": said["side"] != SIDE,
            "takes any serial": said["frame_serial"] != SERIAL,
            "takes any depth limit": not 0.2 <= limit - length <= 30.0,
            "takes an expired plan": valid <= 0.0,
            "takes an old plan anew": time.monotonic() > self.ends_s.get(said["plan"], np.inf),
            "takes a plan for ever": not valid <= 600.0,
        }
        return next((flaw for flaw, wrong in faults.items() if wrong), "")

    # What it does and says.

    async def move(self, peer: Peer, text: str) -> None:
        target = self.aside(self.target, "lays it aside")
        target = self.aside(target, "would lay it aside")
        short = 0.0
        if self.ours and text == "MOVE_TO_TARGET":
            short = 10.0 if "aligns in the bone" in self.flaws else self.length_mm + SHORT_MM
        end = target[:3, 3] + (self.deeper_mm * (text == "DRILL") - short) * target[:3, 2]
        start = self.tip[:3, 3].copy()
        for step in range(1, self.steps + 1):
            await asyncio.sleep(STEP_S)
            self.own.tick(time.monotonic())
            if self.unwatched(peer):
                self.moving, self.phase = None, "STOP"
                peer.send(text, Status(13))
                return
            self.tip = target.copy()
            self.tip[:3, 3] = start + step / self.steps * (end - start)
            peer.send("CURRENT_POSITION", self.position())
        self.moving, self.aligned = None, True
        self.depth_mm = self.length_mm - short
        if self.ours:
            peer.send(contract.DEPTH, Sensor(np.array([self.depth_mm])))
        peer.send(text, Status(1, "", "DONE" if text == "DRILL" else ""))
        peer.send("CURRENT_POSITION", self.position())

    def unwatched(self, peer: Peer) -> bool:
        """Whether its client has fallen silent."""
        silent = peer.promised and self.own.now_s - peer.heard_s > SILENCE_S
        lost = peer not in self.peers  # whom only the flaw lets move on
        return silent and not lost and "never notices silence" not in self.flaws

    def halt(self, code: int) -> None:
        if self.moving is not None:
            self.moving.cancel()
            self.moving = None

    def position(self):
        if self.registration is None:
            return Status(13, "UNCALIBRATED") if self.ours else Transform(self.tip)
        return Transform(self.registration @ self.tip)

    def joints(self) -> NDArray:
        rows = np.zeros((6, 5))
        rows[0, :3] = self.tip[:3, 3]
        rows[0] = rows[0] if self.joints_at is None else self.joints_at
        rows[4], rows[5] = -500.0, 500.0
        if "NaN in its joints" in self.flaws:
            rows[1, 2] = np.nan
        return NDArray(rows[:5] if "five rows of joints" in self.flaws else rows)

    def echo(self, pose: Transform, what: str) -> Transform:
        if f"echoes another {what}" not in self.flaws:
            return pose
        other = pose.matrix.copy()
        other[0, 3] += 0.01
        return Transform(other)

    def aside(self, matrix: np.ndarray, flaw: str) -> np.ndarray:
        out = matrix.copy()
        if flaw in self.flaws:
            out[:3, 3] += LAID_ASIDE_MM * out[:3, 2 if "deeper" in flaw else 0]
        return out

    async def tell(self) -> None:
        """The streams."""
        while True:
            await asyncio.sleep(contract.TELEMETRY_S)
            passed_s = self.own.tick(time.monotonic())
            if "drifts while it holds" in self.flaws and self.aligned:
                self.tip[0, 3] += passed_s * DRIFT_MM_S
            for peer in [peer for peer in self.peers if peer.telemetry]:
                peer.send(contract.MEASURED_CP, Transform(self.tip))
                peer.send(contract.MEASURED_JS, self.joints())
                if self.target is not None:
                    peer.send(contract.DEPTH_SD, Sensor(np.array([0.5])))
                    wrong = np.nan if "NaN as depth" in self.flaws else 0.0
                    peer.send(contract.DEPTH, Sensor(np.array([self.depth_mm + wrong])))


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return float("nan")


def _kind(fault: str) -> str:
    return "not finite" if "finite" in fault else "not rigid"


@contextmanager
def serving(robot: ScriptedRobot) -> Iterator[int]:
    """Its port."""
    ports: list[int] = []
    ready, loop, end = threading.Event(), asyncio.new_event_loop(), asyncio.Event()

    async def main() -> None:
        server = await loop.create_server(lambda: Peer(robot), "127.0.0.1", 0)
        ports.append(server.sockets[0].getsockname()[1])
        ready.set()
        telling = asyncio.create_task(robot.tell())
        await end.wait()
        telling.cancel()
        server.close()
        for peer in list(robot.peers):
            peer.transport.abort()
        robot.halt(13)
        await asyncio.sleep(0)

    thread = threading.Thread(target=lambda: loop.run_until_complete(main()))
    thread.start()
    assert ready.wait(10.0)
    try:
        yield ports[0]
    finally:
        loop.call_soon_threadsafe(end.set)
        thread.join()
        loop.close()


@contextmanager
def scripted(*flaws: str, **how) -> Iterator[int]:
    """Its port."""
    with serving(ScriptedRobot(*flaws, **how)) as port:
        yield port


def old_robot(answers_all: bool = True):
    """A robot of 2013: headers of version 1, no CAPABILITY, and unless `answers_all` nothing for unknown commands."""
    return scripted(*(() if answers_all else ("ignores unknown commands",)), ours=False, clients=1)
