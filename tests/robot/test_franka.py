"""Adapters of arms with controllers of their own: what they refuse, and the Franka adapter in front of two arms.

One is an exchange that was recorded in front of franky-sim. The other, `Franka`, has the faults that the simulator has
not, and answers as franky 2.0.0 does: after a motion that was aborted the next poll raises, after a lost connection
`state` raises.
"""

import importlib
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from tests.robot import franka_exchange
from tests.robot.franka_exchange import Exchange, Replay
from tests.robot.rig import wait_for

from sightline.errors import RobotRefusedError
from sightline.robot.arms.adapter import REST_S, JointTrajectory, checked
from sightline.robot.plant import PlantFlag

JOINTS = tuple(f"joint{i}" for i in range(1, 8))
HOME, ROTARY = np.linspace(-0.6, 0.6, 7), np.ones(7, dtype=bool)
MODES = SimpleNamespace(**{name: SimpleNamespace(name=name) for name in ("Idle", "Move", "UserStopped", "Reflex")})


def going(velocity: np.ndarray, at: np.ndarray = HOME) -> JointTrajectory:
    """As a `StreamedArm` sends them: on for 60 ms, at rest after 100 ms."""
    ahead = at + 0.06 * velocity
    positions, velocities = [at, ahead, ahead + 0.02 * velocity], [velocity, velocity, 0 * velocity]
    return JointTrajectory(np.array([0.0, 0.06, 0.1]), np.array(positions), np.array(velocities))


SLOW = np.full(7, 0.2)


def test_a_trajectory_is_followed_as_its_samples_say() -> None:
    there = going(SLOW)
    path = checked(there, JOINTS, HOME + 0.005, ROTARY)
    np.testing.assert_allclose(path(there.time_s), there.positions, atol=1e-12)
    np.testing.assert_allclose(path(there.time_s, 1), there.velocities, atol=1e-12)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"positions": np.zeros((2, 6))}, "7 joints"),
        ({"velocities": np.full((3, 7), np.nan)}, "not a number"),
        ({"time_s": np.zeros(3)}, "increase"),
        ({"velocities": np.ones((3, 7))}, "end at rest within 0.1 s"),
        ({"time_s": np.array([0.0, 0.06, 0.2])}, "end at rest within 0.1 s"),
        ({"positions": np.rad2deg(HOME) + np.zeros((3, 7))}, "joint1 is at -0.6000, and the trajectory begins at -34"),
    ],
)
def test_what_is_not_a_trajectory_from_here_is_refused(change: dict[str, np.ndarray], reason: str) -> None:
    parts = vars(going(SLOW)) | change
    with pytest.raises(RobotRefusedError, match=reason):
        checked(JointTrajectory(**parts), JOINTS, HOME, ROTARY)


class Franka:
    """franky.Robot in front of an arm whose clock goes on by 10 ms at each sample."""

    joint_velocity_limit = SimpleNamespace(get=lambda: np.full(7, 2.0))
    model_urdf = "<robot>" + "".join(f'<joint name="{name}" type="revolute"/>' for name in JOINTS) + "</robot>"

    def __init__(self, host: str, realtime_config: object) -> None:
        if host != "arm":
            raise ConnectionError("libfranka: Connection timeout")
        self.ms, self.paces = 0, []
        self.mode, self.moves, self.raises, self.lost = MODES.Idle, [], [], False

    @property
    def is_in_control(self) -> bool:
        return bool(self.paces)

    @property
    def state(self) -> Any:
        if self.lost:
            raise RuntimeError("Net Exception")
        self.ms += 10
        if self.paces:
            self.paces.pop()
        time = SimpleNamespace(to_sec=lambda ms=self.ms: ms / 1000)
        return SimpleNamespace(time=time, q=HOME, robot_mode=self.mode, current_errors="[joint_reflex]")

    def move(self, motion: list[Any] | str, asynchronous: bool) -> None:
        assert asynchronous
        assert not self.raises
        self.moves.append(motion)
        self.paces = [] if motion == "stop" else [w for w in motion for _ in range(w.ms // 10)]

    def join_motion(self) -> None:
        while self.paces:
            _ = self.state

    def fail(self, text: str) -> None:
        self.paces = []
        self.raises.append(RuntimeError(text))

    def poll_motion(self) -> bool:
        if self.raises:
            raise self.raises.pop()
        return not self.paces


def waypoint(target: np.ndarray, minimum_time: int = 0, hold_target_duration: int = 0) -> Any:
    return SimpleNamespace(target=target, ms=minimum_time + hold_target_duration)


@contextmanager
def adapter(franky: Any) -> Iterator[Any]:
    """Give the adapter's module, imported with another franky."""
    name = "sightline.robot.arms.franka"
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(sys.modules, "franky", franky)
        patch.delitem(sys.modules, name, raising=False)
        try:
            yield importlib.import_module(name)
        finally:
            sys.modules.pop(name)


@pytest.fixture
def module() -> Iterator[Any]:
    fake = SimpleNamespace(
        Robot=Franka,
        RobotMode=MODES,
        RealtimeConfig=SimpleNamespace(Ignore=0),
        JointVelocityWaypoint=waypoint,
        JointVelocityWaypointMotion=list,
        JointVelocityStopMotion=lambda: "stop",
        Duration=int,
    )
    with adapter(fake) as module:
        yield module


@pytest.fixture
def arm(module: Any) -> Iterator[Any]:
    arm = module.FrankaArm("arm")
    yield arm
    arm.close()


def refused(arm: Any) -> str:
    """Wait until the arm reports a fault; return its text."""
    texts = []

    def faulty() -> bool:
        try:
            arm.state()
        except RobotRefusedError as error:
            texts.append(str(error))
        return bool(texts)

    wait_for(faulty)
    return texts[0]


def replayed(spoil: Callable[[Exchange, Any], None] | None = None) -> dict[str, np.ndarray]:
    """Return the times (N, 1) and joints (N, 7) that the adapter read in each part of the recorded drive. `spoil`
    makes the adapter a bad one. Raises AssertionError for any call that was not recorded, or was left out."""
    replay = Replay()
    exchange = Exchange(replay)
    with adapter(exchange.franky) as module:
        if spoil is not None:
            spoil(exchange, module)
        arm = module.FrankaArm(replay.host)
        assert arm.joints == JOINTS
        try:
            parts = franka_exchange.drive(exchange, arm, cut=lambda: None)
        finally:
            replay.end()  # the adapter takes what is wrong for a fault of the arm
    return {name: np.array([[each.time_s, *each.encoders] for each in readings]) for name, readings in parts.items()}


def test_the_adapter_calls_franky_as_it_did_when_the_simulated_arm_moved() -> None:
    read = replayed()
    goal = franka_exchange.HOME + franka_exchange.BY
    # The simulator's joints sag by some 1e-5 rad at rest; 2e-4 rad are 0.2 mm at 1 m.
    np.testing.assert_allclose(read["read"][:, 1:], franka_exchange.HOME + np.zeros((len(read["read"]), 7)), atol=2e-4)
    np.testing.assert_allclose(read["follow"][-1, 1:], goal, atol=2e-4)
    np.testing.assert_allclose(read["hold"][:, 1:], goal + np.zeros((len(read["hold"]), 7)), atol=2e-4)
    pace = np.diff(read["back"][-2:], axis=0)[0]
    assert np.abs(pace[1:]).max() / pace[0] > 0.1, "the arm is stopped while it moves"
    at_rest = read["stop"][:, 0] > read["stop"][0, 0] + REST_S
    assert np.ptp(read["stop"][at_rest, 1:], axis=0).max() < 2e-4


def spoilt_target(change: Callable[[np.ndarray], np.ndarray]) -> Callable[[Exchange, Any], None]:
    """Make an adapter that commands other velocities."""

    def spoil(exchange: Exchange, _: Any) -> None:
        good = exchange.franky.JointVelocityWaypoint
        exchange.franky.JointVelocityWaypoint = lambda target, **times: good(change(target), **times)

    return spoil


def spoilt_reading(change: Callable[[np.ndarray], np.ndarray]) -> Callable[[Exchange, Any], None]:
    """Make an adapter that reads other joints."""

    def spoil(_: Exchange, module: Any) -> None:
        good = module.FrankaArm.state
        module.FrankaArm.state = lambda arm: replace(good(arm), encoders=change(good(arm).encoders))

    return spoil


@pytest.mark.parametrize(
    "spoil",
    [
        pytest.param(spoilt_target(np.flip), id="commands the joints in the wrong order"),
        pytest.param(spoilt_target(np.rad2deg), id="commands degrees"),
        pytest.param(spoilt_target(lambda target: target[:6]), id="commands six joints"),
        pytest.param(spoilt_target(lambda target: target + 1e-6), id="commands 1e-6 rad/s more"),
        pytest.param(spoilt_reading(np.flip), id="reads the joints in the wrong order"),
        pytest.param(spoilt_reading(np.rad2deg), id="reads degrees"),
        pytest.param(lambda _, module: setattr(module.FrankaArm, "hold", lambda arm: None), id="does not stop"),
        pytest.param(lambda _, module: setattr(module, "SEND_S", 0.03), id="accelerates for too long"),
    ],
)
def test_a_bad_franka_adapter_fails_the_recorded_exchange(spoil: Callable[[Exchange, Any], None]) -> None:
    with pytest.raises(AssertionError, match=r"was called; recorded: "):
        replayed(spoil)


def test_a_franka_arm_that_is_commanded_no_longer_is_at_rest_within_a_tenth_of_a_second(arm: Any) -> None:
    arm.follow(going(SLOW))
    wait_for(lambda: not arm._robot.is_in_control)
    [(on, rest)] = arm._robot.moves
    np.testing.assert_allclose(on.target, SLOW, atol=1e-9)
    assert (on.ms, rest.ms) == (40, 0)
    assert not rest.target.any()
    # What is left of 100 ms is enough at 10 rad/s², the limit of the arm, for any speed that it is given.
    assert SLOW.max() / 10.0 < 0.06


def test_a_fault_of_a_franka_arm_is_told_until_a_person_goes_on(arm: Any) -> None:
    arm.follow(going(SLOW))
    arm._robot.fail("libfranka: Move command aborted: motion aborted by reflex!")
    assert "reflex" in refused(arm)
    with pytest.raises(RobotRefusedError, match="reflex"):
        arm.follow(going(SLOW))
    arm.hold()
    assert arm.state().flags == PlantFlag.RUN_HELD


def test_modes_and_a_lost_connection_of_a_franka_arm_are_told(arm: Any) -> None:
    arm._robot.mode = MODES.UserStopped
    wait_for(lambda: arm.state().flags == PlantFlag.STOP_PRESSED)
    arm._robot.mode = MODES.Reflex
    assert "joint_reflex" in refused(arm)
    arm._robot.mode = MODES.Idle
    wait_for(lambda: arm._state.robot_mode is MODES.Idle)
    arm._robot.lost = True
    assert "connection is lost" in refused(arm)
    arm.hold()
    assert "connection is lost" in refused(arm)


def test_what_a_franka_arm_cannot_do_is_refused(arm: Any, module: Any) -> None:
    with pytest.raises(RobotRefusedError, match=r"velocity of joint1 would be 1\.5 times its limit"):
        arm.follow(going(np.full(7, 3.0)))
    with pytest.raises(RobotRefusedError, match="no Franka arm at nowhere: libfranka: Connection timeout"):
        module.FrankaArm("nowhere")
