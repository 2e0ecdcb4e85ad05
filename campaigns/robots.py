"""Faulty clients and hardware: the arm must move only where it may, stop when told, and always answer.

The robot's controller and its dialogue, without a link; time is simulated, so that nothing depends on the machine.
Faults of a robot towards our client are covered by the tests of the conformance test.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform
from tests.robot.igtl_faults import in_pieces
from tests.robot.rig import CLIENT, ROBOT, T_MCS_CFCS, Rig, code, metadata, wire

from campaigns.campaign import Campaign, Damage, Ended
from sightline.robot.control.states import COMMANDS, MOVING, State
from sightline.robot.igtl import Capability, Message, String, Transform, encode
from sightline.robot.kinematics.designs import FEED
from sightline.robot.plant import CYCLE_S, PlantFlag, Reading

STILL = 0.02  # of a joint's full speed: limit of an arm at rest
STOPS_S = 0.3  # from full speed to rest at the joints' accelerations, with a margin
BEYOND_MM = 0.3  # allowed beyond a depth limit for feed error and braking
STATES = tuple(State)
TEXTS = (*(cause.value for cause in COMMANDS), "stop", "STOP ", "DANCE", "", "DRILL" * 40)
NUMBERS = ("nan", "inf", "-1", "0", "1e9", "1e308", "0.035", "", "sixty")


@dataclass
class Witness:
    """Watches a rig while time passes; `unsafe` is the first violation seen."""

    rig: Rig
    unsafe: str = ""
    still_since_s: float = -np.inf
    stopped_s: float | None = None

    def __post_init__(self) -> None:
        self.still_since_s = self.rig.now_s

    def run(self, seconds: float) -> None:
        """Advance the time cycle by cycle, checking in each."""
        for _ in range(max(1, round(seconds / CYCLE_S))):
            self.rig.run(CYCLE_S)
            self.look()

    def look(self) -> None:
        """Check for forbidden motion, from the plant's true state rather than its readings."""
        now, plant = self.rig.now_s, self.rig.plant
        moves = float(np.max(np.abs(plant.velocity) / ROBOT.manipulator.speed)) > STILL
        if self.rig.state in MOVING:
            self.still_since_s = now
        elif moves and now - self.still_since_s > STOPS_S:
            self.say(f"it moves in {self.rig.state.value}")
        if self.stopped_s is not None and moves and now - self.stopped_s > STOPS_S and self.rig.state not in MOVING:
            self.say("it moves after a stop")
        insertion = self.rig.controller.machine.insertion
        if insertion is not None and self.rig.state is State.DRILL:
            depth = float(plant.q[FEED] - insertion.q[FEED])
            if depth > insertion.depth_limit_mm + BEYOND_MM:
                self.say("the wire is beyond its depth limit")
            if insertion.depth_limit_mm > insertion.length_mm + 50.0:
                self.say("it drills to a limit that no plan has")
            others = np.delete(plant.q - insertion.q, FEED)
            if np.abs(others[:3]).max() > 0.5:
                self.say("it drills aside of its line")

    def say(self, what: str) -> None:
        """Record a violation; the first is kept."""
        self.unsafe = self.unsafe or what

    def send(self, name: str, body, client: int = CLIENT, **header) -> list[Message]:
        """Send a message and return the answers; a command must be answered."""
        answers = self.rig.send(name, body, client, **header)
        if name.startswith("CMD_") and not any(answer.device_name.startswith("ACK_") for answer in answers):
            self.say("a command without an answer")
        if isinstance(body, String) and body.text in ("STOP", "EMERGENCY"):
            self.stopped_s = self.rig.now_s
        elif code(answers) == 1:
            self.stopped_s = None
        return answers

    @property
    def ended(self) -> Ended:
        """How the try ended."""
        return Ended("unsafe", self.unsafe) if self.unsafe else Ended("right")


Play = Callable[[Witness, np.random.Generator], None]


def play(scenario: Play) -> Damage:
    """Return the class of one scenario, played from any state of the robot."""

    def make(rng: np.random.Generator) -> Ended:
        witness = Witness(Rig.at(STATES[int(rng.integers(len(STATES)))]))
        scenario(witness, rng)
        witness.run(0.5)
        return witness.ended

    return Damage(make)


def _command(rng: np.random.Generator) -> tuple[str, String]:
    return f"CMD_{rng.integers(1, 30)}", String(str(rng.choice(TEXTS)))


def _pose(rng: np.random.Generator) -> RigidTransform:
    matrix = wire().as_matrix()
    matrix[:3, 3] += rng.choice([0.0, 3.0, 60.0, 1e4]) * rng.standard_normal(3)
    if rng.random() < 0.2:
        matrix[:3, 3] /= 1000.0
    return RigidTransform.from_matrix(matrix)


def commands(witness: Witness, rng: np.random.Generator, clients: tuple[int, ...] = (CLIENT,)) -> None:
    """Send any commands, targets and registrations in any order, at any pace."""
    for _ in range(25):
        client = int(rng.choice(clients))
        kind = rng.random()
        if kind < 0.7:
            witness.send(*_command(rng), client=client)
        elif kind < 0.85:
            spoilt = {str(rng.choice(list(metadata()))): str(rng.choice(NUMBERS))} if rng.random() < 0.5 else {}
            witness.send(
                f"TGT_{rng.integers(9)}", Transform.of(_pose(rng)), client, version=2, metadata=metadata(**spoilt)
            )
        else:
            witness.send(f"CLB_{rng.integers(9)}", Transform.of(T_MCS_CFCS.inv()), client)
        witness.run(float(rng.choice([0.005, 0.1, 1.0])))


def several_clients(witness: Witness, rng: np.random.Generator) -> None:
    """Send `commands` from four clients at once."""
    commands(witness, rng, (CLIENT, 2, 3, 4))


def spoilt_bytes(witness: Witness, rng: np.random.Generator) -> None:
    """Send messages with changed bytes, in pieces."""
    for _ in range(15):
        name, body = _command(rng)
        data = bytearray(encode(Message(body, name)) + encode(Message(Transform.of(_pose(rng)), "TGT_1")))
        for at in rng.integers(0, len(data), int(rng.integers(1, 5))):
            data[at] = rng.integers(256)
        for event in in_pieces(bytes(data), rng):
            witness.rig.dialogue.receive(CLIENT, event, witness.rig.now_s)
        witness.run(0.1)


def numbers_in_transforms(witness: Witness, rng: np.random.Generator) -> None:
    """Send matrices with numbers that no pose has."""
    for _ in range(15):
        matrix = wire().as_matrix()
        matrix[rng.integers(3), rng.integers(4)] = rng.choice([np.nan, np.inf, -np.inf, 1e30, 0.0, -1.0])
        witness.send(
            f"{rng.choice(['TGT', 'CLB'])}_{rng.integers(9)}", Transform(matrix), version=2, metadata=metadata()
        )
        witness.send(*_command(rng))
        witness.run(0.1)


def stops(witness: Witness, rng: np.random.Generator) -> None:
    """Send a stop at any moment, from any client, followed by more commands."""
    witness.run(float(rng.uniform(0.0, 3.0)))
    witness.send(
        f"CMD_{rng.integers(9)}", String(str(rng.choice(["STOP", "EMERGENCY"]))), client=int(rng.integers(1, 5))
    )
    for _ in range(int(rng.integers(0, 4))):
        witness.send(*_command(rng))
    witness.run(1.0)


def lost_client(witness: Witness, rng: np.random.Generator) -> None:
    """Promise heartbeats, then fall silent or disconnect."""
    witness.rig.beat(Capability(("X_HEARTBEAT",)))
    witness.run(float(rng.uniform(0.0, 1.0)))
    if rng.random() < 0.5:
        witness.rig.dialogue.left(CLIENT, witness.rig.now_s)
    moving = witness.rig.state in MOVING
    witness.run(0.2 + STOPS_S)
    if moving and witness.rig.state in MOVING:
        witness.say("it goes on without its client")


def clock(witness: Witness, rng: np.random.Generator) -> None:
    """Let the clock jump by minutes or days, forward or back."""
    for _ in range(6):
        witness.rig.now_s += float(rng.choice([-86_400.0, -60.0, -1.0, 30.0, 900.0, 86_400.0]))
        witness.still_since_s = witness.rig.now_s
        witness.stopped_s = None
        witness.send(*_command(rng))
        witness.run(0.5)


# What a reading says from some moment on, by the last true one: values, or functions of the true reading.
SPOILT: dict[str, Callable[[Reading], dict[str, object]]] = {
    "encoders stick": lambda last: {"encoders": last.encoders},
    "encoders jump": lambda _: {"encoders": lambda now: now.encoders + np.array([0, 0, 0.3, 25.0, 0])},
    "encoders say nothing": lambda _: {"encoders": np.full(5, np.nan)},
    "readings are old": vars,
    "time runs back": lambda _: {"time_s": lambda now: -now.time_s},
    "force says nothing": lambda _: {"force_n": float("nan")},
    "force is huge": lambda _: {"force_n": 1e6},
    "all flags at once": lambda _: {"flags": ~PlantFlag.NONE},
    "no flag at all": lambda _: {"flags": PlantFlag.NONE},
}


def hardware(spoil: Callable[[Reading], dict[str, object]]) -> Damage:
    """Return the class of sensors that fail while the arm moves: it must stand within a second."""

    def make(rng: np.random.Generator) -> Ended:
        rig = Rig.at(MOVING[int(rng.integers(len(MOVING)))])
        rig.run(float(rng.uniform(0.0, 1.0)))
        witness = Witness(rig)
        rig.reads(**spoil(rig.plant.read()))
        for _ in range(int(rng.integers(0, 3))):
            witness.send(*_command(rng))
        witness.run(1.0)
        return witness.ended

    return Damage(make)


PLAYS = {
    "any commands": commands,
    "several clients": several_clients,
    "spoilt bytes": spoilt_bytes,
    "numbers that no pose has": numbers_in_transforms,
    "stops": stops,
    "lost client": lost_client,
    "clock": clock,
}
CLASSES = {name: play(scenario) for name, scenario in PLAYS.items()}
CLASSES |= {name: hardware(spoil) for name, spoil in SPOILT.items()}
CAMPAIGN = Campaign("robots", "Clients and hardware that do not behave", CLASSES)
