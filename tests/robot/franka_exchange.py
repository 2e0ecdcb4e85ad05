"""A drive of a Franka arm whose calls of franky, and the arm's answers, are recorded once and replayed.

`tools/record_franka.py` records it in front of franky-sim. The adapter's own thread takes a sample when `step` says so,
and nothing else runs meanwhile: the calls of both threads thus have one order.
"""

import json
from collections.abc import Callable
from enum import Enum
from functools import partial
from pathlib import Path
from threading import Event, Thread, get_ident
from types import SimpleNamespace
from typing import Any

import numpy as np
from tests.robot.rig import wait_for

from sightline.errors import RobotRefusedError
from sightline.robot.arms.adapter import JointTrajectory
from sightline.robot.plant import Reading

RECORDED = Path(__file__).with_name("franka_exchange.json")
HOME = np.array([0.1, -0.5, 0.2, -2.0, 0.3, 1.7, 0.6])  # rad, away from all limits
BY = np.array([0.03, -0.02, 0.04, 0.05, -0.03, 0.02, -0.06])  # rad, another way for each joint
FOLLOW_S, STOP_S, REST_S = 0.5, 0.2, 0.3  # a motion; one until it is stopped, as fast; what is watched after it [ours]
TOLERANCE = 1e-9  # of each number of a call: rounding, since the replayed joints are those recorded

Answer = Callable[[str, dict[str, Any]], Any]  # of a call of franky with its arguments; all as JSON
Mode = Enum("Mode", ["Other", "Idle", "Move", "Guiding", "Reflex", "UserStopped", "AutomaticErrorRecovery"])


class Exchange:
    """The module `franky`, and the arm behind it: its calls are answered by `answer`, whose errors it raises."""

    def __init__(self, answer: Answer) -> None:
        self.answer = answer
        self._asked, self._granted = Event(), Event()
        self.franky = SimpleNamespace(
            Robot=partial(Robot, self),
            RobotMode=Mode,
            RealtimeConfig=SimpleNamespace(Ignore="Ignore"),
            Duration=int,
            JointVelocityWaypoint=lambda target, **times_ms: {"target": np.asarray(target).tolist(), **times_ms},
            JointVelocityWaypointMotion=lambda waypoints: {"JointVelocityWaypointMotion": waypoints},
            JointVelocityStopMotion=lambda: {"JointVelocityStopMotion": []},
        )

    def asked(self) -> None:
        """Wait for `step`. Called by the adapter's thread."""
        self._asked.set()
        self._granted.wait()
        self._granted.clear()

    def step(self, arm: Any) -> None:
        """Give the adapter's thread one sample; return when it asks for the next one, or has ended."""
        wait_for(self._asked.is_set)
        self._asked.clear()
        self._granted.set()
        wait_for(lambda: self._asked.is_set() or not arm._thread.is_alive())

    def close(self, arm: Any) -> None:
        """Close the adapter, whose thread ends after one more sample."""
        closing = Thread(target=arm.close)
        closing.start()
        arm._closed.wait()
        self._granted.set()
        closing.join()


class Robot:
    """`franky.Robot`, as far as the adapter knows it."""

    def __init__(self, exchange: Exchange, host: str, realtime_config: str) -> None:
        self._exchange, self._began = exchange, get_ident()
        self._call("Robot", host=host, realtime_config=realtime_config)
        self.joint_velocity_limit = SimpleNamespace(get=lambda: np.array(self._call("joint_velocity_limit.get")))

    def _call(self, name: str, **arguments: Any) -> Any:
        return self._exchange.answer(name, arguments)

    @property
    def model_urdf(self) -> str:
        return self._call("model_urdf")

    @property
    def is_in_control(self) -> bool:
        return self._call("is_in_control")

    @property
    def state(self) -> SimpleNamespace:
        if get_ident() != self._began:
            self._exchange.asked()
        state = self._call("state")
        mode, time = Mode[state["robot_mode"]], SimpleNamespace(to_sec=lambda: state["time_s"])
        return SimpleNamespace(time=time, q=state["q"], robot_mode=mode, current_errors=state["current_errors"])

    def move(self, motion: dict[str, Any], asynchronous: bool) -> None:
        self._call("move", motion=motion, asynchronous=asynchronous)

    def poll_motion(self) -> bool:
        return self._call("poll_motion")

    def join_motion(self) -> bool:
        return self._call("join_motion")


def drive(exchange: Exchange, arm: Any, cut: Callable[[], None]) -> dict[str, list[Reading]]:
    """Read the arm, follow a trajectory, hold, stop while moving, lose the connection by `cut`, and close; return what
    the adapter read in each part, and raise what it raised."""
    try:
        return _drive(exchange, arm, cut)
    finally:
        exchange.close(arm)


def _drive(exchange: Exchange, arm: Any, cut: Callable[[], None]) -> dict[str, list[Reading]]:
    read: dict[str, list[Reading]] = {}

    def part(name: str, length_s: float, act: Callable[[Reading, float], None] | None = None) -> None:
        readings = read[name] = [arm.state()]
        while (since_s := readings[-1].time_s - readings[0].time_s) < length_s:
            if act is not None:
                act(readings[0], since_s)
            exchange.step(arm)
            readings.append(arm.state())

    part("read", 0.05)
    part("follow", FOLLOW_S + REST_S, lambda first, since_s: arm.follow(ahead(first.encoders, BY, since_s)))
    arm.hold()
    part("hold", REST_S)
    arm.hold()  # at rest there is nothing to stop
    part("back", STOP_S, lambda first, since_s: arm.follow(ahead(first.encoders, -BY, since_s)))
    arm.hold()
    part("stop", REST_S)
    cut()
    exchange.step(arm)
    try:
        arm.state()
    except RobotRefusedError as error:
        assert "connection is lost" in str(error)
        return read
    raise AssertionError("the connection is lost, and the arm has a state")


def ahead(q: np.ndarray, by: np.ndarray, since_s: float) -> JointTrajectory:
    """Return what a `StreamedArm` sends on the way from `q` by `by` (7,): on for 60 ms, at rest after 100 ms."""
    t = min(since_s / FOLLOW_S, 1.0)
    at = q + by * t**2 * (3 - 2 * t)
    velocity = by * 6 * t * (1 - t) / FOLLOW_S
    along_s, pace = np.array([0.0, 0.06, 0.08]), np.array([1.0, 1.0, 0.0])
    return JointTrajectory(np.array([0.0, 0.06, 0.1]), at + np.outer(along_s, velocity), np.outer(pace, velocity))


class Replay:
    """The answers of a recorded exchange, to the calls that were recorded. `wrong`: the first one that was not."""

    def __init__(self) -> None:
        self._left = json.loads(RECORDED.read_text())["exchange"][::-1]
        self.host = self._left[-1]["arguments"]["host"]
        self.wrong = ""

    def __call__(self, name: str, arguments: dict[str, Any]) -> Any:
        """Return the recorded answer, or raise the recorded error."""
        wanted = self._left.pop() if self._left and not self.wrong else {"call": "nothing", "arguments": {}}
        if not self.wrong and (name != wanted["call"] or not alike(arguments, wanted["arguments"])):
            self.wrong = f"{name} {arguments} was called; recorded: {wanted['call']} {wanted['arguments']}"
        if self.wrong:
            raise RuntimeError(self.wrong)
        if "raises" in wanted:
            raise RuntimeError(wanted["raises"])
        return wanted["answer"]

    def end(self) -> None:
        """Raise AssertionError unless all recorded calls were made, and no other."""
        assert not self.wrong, self.wrong
        assert not self._left, f"{self._left[-1]['call']} was not called"


def alike(one: Any, other: Any) -> bool:
    """Whether two JSON values have one shape, their numbers equal within TOLERANCE."""
    if isinstance(one, dict) and isinstance(other, dict):
        return one.keys() == other.keys() and all(alike(one[key], other[key]) for key in one)
    if isinstance(one, list) and isinstance(other, list):
        return len(one) == len(other) and all(map(alike, one, other))
    if isinstance(one, float) and isinstance(other, float):
        return abs(one - other) <= TOLERANCE
    return type(one) is type(other) and one == other
