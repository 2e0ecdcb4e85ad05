"""Adapters of arms with controllers of their own: what they refuse, and the Franka adapter in front of a fake.

`Franka` answers as franky 2.0.0 did in front of franky-sim 1.0.4, where each answer was tried: after `stop` the next
poll raises, after a lost connection `state` raises, and joints stand short of what is commanded.
"""

import importlib
import sys
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from benchmarks.arm_peers import smooth
from tests.robot.rig import wait_for

from sightline.errors import RobotRefusedError
from sightline.robot.arms.adapter import JointTrajectory, checked
from sightline.robot.plant import PlantFlag

JOINTS = tuple(f"joint{i}" for i in range(1, 8))
HOME, ROTARY = np.linspace(-0.6, 0.6, 7), np.ones(7, dtype=bool)
SHORT = np.array([0.0, 0, 0, 0, 0, 0, 1.7e-3])  # of the command, by friction
MODES = SimpleNamespace(**{name: SimpleNamespace(name=name) for name in ("Idle", "Move", "UserStopped", "Reflex")})


def test_a_trajectory_is_followed_as_its_samples_say() -> None:
    there = smooth(HOME, HOME + 0.2, 1.0)
    path = checked(there, JOINTS, HOME + 0.005, ROTARY)
    np.testing.assert_allclose(path(there.time_s), there.positions, atol=1e-12)
    np.testing.assert_allclose(path(there.time_s, 1), there.velocities, atol=1e-12)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"positions": np.zeros((2, 6))}, "7 joints"),
        ({"velocities": np.full((51, 7), np.nan)}, "not a number"),
        ({"time_s": np.zeros(51)}, "increase"),
        ({"velocities": np.ones((51, 7))}, "end at rest"),
        ({"positions": np.rad2deg(HOME) + np.zeros((51, 7))}, "joint1 is at -0.6000, and the trajectory begins at -34"),
    ],
)
def test_what_is_not_a_trajectory_from_here_is_refused(change: dict[str, np.ndarray], reason: str) -> None:
    parts = vars(smooth(HOME, HOME + 0.2, 1.0)) | change
    with pytest.raises(RobotRefusedError, match=reason):
        checked(JointTrajectory(**parts), JOINTS, HOME, ROTARY)


class Franka:
    """franky.Robot in front of an arm whose clock goes on by 10 ms at each sample."""

    joint_velocity_limit = joint_acceleration_limit = SimpleNamespace(get=lambda: np.full(7, 5.0))
    model_urdf = "<robot>" + "".join(f'<joint name="{name}" type="revolute"/>' for name in JOINTS) + "</robot>"

    def __init__(self, host: str, realtime_config: object) -> None:
        if host != "arm":
            raise ConnectionError("libfranka: Connection timeout")
        self.ms, self.q, self.course, self.short = 0, HOME.copy(), [], SHORT
        self.mode, self.moves, self.raises, self.lost = MODES.Idle, [], [], False

    @property
    def is_in_control(self) -> bool:
        return bool(self.course)

    @property
    def state(self) -> Any:
        if self.lost:
            raise RuntimeError("Net Exception")
        self.ms += 10
        if self.course:
            self.q = self.course.pop(0) - self.short
        time = SimpleNamespace(to_sec=lambda ms=self.ms: ms / 1000)
        return SimpleNamespace(
            time=time, q=self.q, q_d=self.q + self.short, robot_mode=self.mode, current_errors="[joint_reflex]"
        )

    def move(self, motion: list[Any] | str, asynchronous: bool) -> None:
        assert asynchronous
        assert not self.raises
        self.moves.append(motion)
        self.course = [] if motion == "stop" else [w.target.position for w in motion for _ in range(w.ms // 10)]

    def stop(self) -> None:
        self.fail("libfranka: Move command preempted!")

    def fail(self, text: str) -> None:
        self.course = []
        self.raises.append(RuntimeError(text))

    def poll_motion(self) -> bool:
        if self.raises:
            raise self.raises.pop()
        return not self.course


def waypoint(target: Any, minimum_time: int = 10, relative_dynamics_factor: float = 1.0) -> Any:
    target = target if isinstance(target, SimpleNamespace) else SimpleNamespace(position=target)
    return SimpleNamespace(target=target, ms=minimum_time)


@pytest.fixture
def module(monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    fake = SimpleNamespace(
        Robot=Franka,
        RobotMode=MODES,
        RealtimeConfig=SimpleNamespace(Ignore=0),
        JointState=lambda position, velocity: SimpleNamespace(position=position, velocity=velocity),
        JointWaypoint=waypoint,
        JointWaypointMotion=list,
        JointStopMotion=lambda: "stop",
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


def test_franka_joints_reach_their_target_although_friction_leaves_them_short(arm: Any) -> None:
    assert arm.joints == JOINTS
    arm.follow(smooth(arm.state().encoders, HOME + 0.1, 1.0))
    wait_for(lambda: np.abs(arm.state().encoders - HOME - 0.1).max() < 1e-9)
    assert [len(motion) for motion in arm._robot.moves] == [10, 1]  # waypoints each 0.1 s, and one correction


def test_franka_joints_that_stand_far_off_their_target_are_a_fault(arm: Any) -> None:
    arm._robot.short = 20 * SHORT
    arm.follow(smooth(HOME, HOME + 0.1, 1.0))
    assert "joint7 stands 0.0340 rad short of its target" in refused(arm)


def test_franka_stop_and_hold_end_a_motion_without_a_fault(arm: Any) -> None:
    for end, last in ((arm.stop, 1), (arm.hold, 3)):
        arm.follow(smooth(arm.state().encoders, HOME + 0.1, 60.0))
        end()
        wait_for(lambda: not arm._robot.is_in_control and not arm._robot.raises)
        at = arm.state().time_s + 0.5
        wait_for(lambda at=at: arm.state().time_s > at)  # no correction follows
        assert len(arm._robot.moves) == last
    assert arm._robot.moves[-1] == "stop"


def test_franka_motion_ends_if_nobody_reads_the_state(arm: Any, module: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    arm.follow(smooth(arm.state().encoders, HOME + 0.1, 60.0))
    monkeypatch.setattr(module, "UNASKED_S", -1.0)
    assert "its state was not read" in refused(arm)
    assert not arm._robot.is_in_control


def test_a_fault_of_a_franka_arm_is_told_until_a_person_goes_on(arm: Any) -> None:
    arm.follow(smooth(arm.state().encoders, HOME + 0.1, 60.0))
    arm._robot.fail("libfranka: Move command aborted: motion aborted by reflex!")
    assert "reflex" in refused(arm)
    with pytest.raises(RobotRefusedError, match="reflex"):
        arm.follow(smooth(HOME, HOME, 1.0))
    arm.stop()
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
    at = arm.state().encoders
    with pytest.raises(RobotRefusedError, match=r"velocity of joint1 would be 1\.\d times its limit"):
        arm.follow(smooth(at, at + 3.0, 1.0))
    with pytest.raises(RobotRefusedError, match="acceleration of joint1"):
        arm.follow(smooth(at, at + 0.5, 0.5))
    with pytest.raises(RobotRefusedError, match="no Franka arm at nowhere: libfranka: Connection timeout"):
        module.FrankaArm("nowhere")
