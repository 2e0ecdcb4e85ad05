"""Adapters of arms with controllers of their own: what they refuse, and the Franka adapter in front of a fake.

`Franka` answers as franky 2.0.0 did in front of franky-sim 1.0.4, where each answer was tried: after a motion that was
aborted the next poll raises, after a lost connection `state` raises, and the arm moves until its last command ends.
"""

import importlib
import sys
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from tests.robot.rig import wait_for

from sightline.errors import RobotRefusedError
from sightline.robot.arms.adapter import JointTrajectory, checked
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
        self.ms, self.q, self.paces = 0, HOME.copy(), []
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
            self.q = self.q + 0.01 * self.paces.pop(0)
        time = SimpleNamespace(to_sec=lambda ms=self.ms: ms / 1000)
        return SimpleNamespace(time=time, q=self.q, robot_mode=self.mode, current_errors="[joint_reflex]")

    def move(self, motion: list[Any] | str, asynchronous: bool) -> None:
        assert asynchronous
        assert not self.raises
        self.moves.append(motion)
        self.paces = [] if motion == "stop" else [w.target for w in motion for _ in range(w.ms // 10)]

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


@pytest.fixture
def module(monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    fake = SimpleNamespace(
        Robot=Franka,
        RobotMode=MODES,
        RealtimeConfig=SimpleNamespace(Ignore=0),
        JointVelocityWaypoint=waypoint,
        JointVelocityWaypointMotion=list,
        JointVelocityStopMotion=lambda: "stop",
        Duration=int,
    )
    name = "sightline.robot.arms.franka"
    monkeypatch.setitem(sys.modules, "franky", fake)
    monkeypatch.delitem(sys.modules, name, raising=False)
    yield importlib.import_module(name)
    sys.modules.pop(name)


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


def test_a_franka_arm_is_brought_to_where_its_trajectories_lead(arm: Any) -> None:
    """Whatever part of each it follows before the next one comes."""
    assert arm.joints == JOINTS

    def arrived() -> bool:
        left = HOME + 0.05 - arm.state().encoders
        arm.follow(going(0 * SLOW, arm.state().encoders + left.clip(-0.01, 0.01)))
        return bool(np.abs(left).max() < 1e-3)

    wait_for(arrived)


def test_a_franka_arm_that_is_commanded_no_longer_is_at_rest_within_a_tenth_of_a_second(arm: Any) -> None:
    arm.follow(going(SLOW))
    wait_for(lambda: not arm._robot.is_in_control)
    [(on, rest)] = arm._robot.moves
    np.testing.assert_allclose(on.target, SLOW, atol=1e-9)
    assert (on.ms, rest.ms) == (40, 0)
    assert not rest.target.any()
    # What is left of 100 ms is enough at 10 rad/s², the limit of the arm, for any speed that it is given.
    assert SLOW.max() / 10.0 < 0.06


def test_franka_hold_ends_a_motion_without_a_fault(arm: Any) -> None:
    arm.follow(going(SLOW))
    arm.hold()
    arm.hold()  # at rest there is nothing to stop
    assert arm._robot.moves[1:] == ["stop"]
    assert arm.state().flags == PlantFlag.RUN_HELD


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
