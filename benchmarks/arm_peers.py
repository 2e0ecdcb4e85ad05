"""Arms that nobody here wrote, behind our adapters: franky-sim, and a controller of ROS 2 in another process.

Each where it is installed: `pip install sightline[ros2]`; `pip install sightline[franka] franky-sim` (660 MB). Commands
and answers are timed by the arm's own clock, since a simulator on a busy machine is slower than the world.
"""

import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from benchmarks.harness import Rows
from sightline.errors import RobotRefusedError
from sightline.robot.arms.adapter import ArmAdapter, JointTrajectory

ROS2 = find_spec("rclpy") is not None
FRANKA = find_spec("franky") is not None and find_spec("franky_sim") is not None
NAMESPACE = "sightline_test"
ROOT = Path(__file__).parents[1]
PATIENCE_S = 60.0  # a program that does not answer for so long has hung
POLL_S = 0.004  # between two calls of `state`, as in the control loop
STIFF = 0.4  # share of franky-sim's damping: a lag of 40 ms
REACHED = 1e-4  # rad, mm: a fifth of what is asked of the guide at 0.1 m
FIRST_SEED = 81_000
LOWER, UPPER = np.array([*[-2 * np.pi] * 6, 0.0]), np.array([*[2 * np.pi] * 6, 200.0])  # of the controller; rad, mm
ROTARY = np.array([True] * 6 + [False])
FAULTS = ("killed", "silent", "late", "frozen", "nan", "degrees", "renamed", "fewer")


def smooth(start: np.ndarray, end: np.ndarray, duration_s: float) -> JointTrajectory:
    """Return a trajectory of five degrees from `start` to `end` (n,)."""
    t = np.linspace(0.0, 1.0, 1 + round(duration_s / 0.02))
    share, pace = t**3 * (10 - 15 * t + 6 * t**2), 30 * t**2 * (1 - t) ** 2 / duration_s
    return JointTrajectory(duration_s * t, start + share[:, None] * (end - start), pace[:, None] * (end - start))


def wait(arm: ArmAdapter, seconds: float, until: Any = lambda reading: False) -> bool:
    """Read an arm until `until` its reading, or for some seconds of its own clock; return whether it was."""
    begun_s = (reading := arm.state()).time_s
    while reading.time_s < begun_s + seconds:
        if until(reading):
            return True
        time.sleep(POLL_S)
        reading = arm.state()
    return False


@contextmanager
def program(name: str, *arguments: str) -> Iterator[Any]:
    """Run a program of this folder; give it and the first line that it prints."""
    command = [sys.executable, "-m", f"benchmarks.{name}", *arguments]
    pipes: dict[str, Any] = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    with subprocess.Popen(command, cwd=ROOT, **pipes) as process:
        try:
            yield process, process.stdout.readline().strip()
        finally:
            process.kill()


def ended(process: Any) -> dict[str, Any]:
    """End a program's input and return its log, as arrays."""
    out, _ = process.communicate(timeout=PATIENCE_S)
    return {key: np.array(values) for key, values in json.loads(out.splitlines()[-1]).items()}


# A controller of ROS 2.


@contextmanager
def ros2_arm() -> Iterator[Any]:
    """Connect to the controller of `program("ros2_controller", NAMESPACE)`."""
    from benchmarks.ros2_controller import JOINTS
    from sightline.robot.arms.ros2 import Ros2Arm

    arm = Ros2Arm(NAMESPACE, JOINTS, LOWER, UPPER, ROTARY)
    try:
        yield arm
    finally:
        arm.close()


def ros2_local() -> None:
    """Keep what follows on this machine, and apart from other programs."""
    os.environ |= {"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST", "ROS_DOMAIN_ID": str(1 + os.getpid() % 100)}


def patient() -> Any:
    """Let samples be late: on a busy machine another process may stand still for longer than the adapter waits."""
    return patch.multiple("sightline.robot.arms.ros2", LATE_S=PATIENCE_S, MISSED=10_000)


def ros2_follow(count: int) -> tuple[np.ndarray, dict[str, Any]]:
    """Return the errors (count, 7) at the ends of trajectories, rad and mm, and the controller's log."""
    rng, errors = np.random.default_rng(FIRST_SEED), []
    with program("ros2_controller", NAMESPACE) as (process, _):
        with ros2_arm() as arm:
            home = arm.state().encoders
            for _ in range(count):
                end = home + rng.uniform(-0.3, 0.3, 7) * np.where(ROTARY, 1.0, 100.0)
                duration_s = rng.uniform(0.4, 0.8)
                arm.follow(smooth(arm.state().encoders, end, duration_s))
                wait(arm, duration_s + 2.0, lambda reading, end=end: np.abs(reading.encoders - end).max() < REACHED)
                errors.append(arm.state().encoders - end)
        return np.array(errors), ended(process)


@dataclass(frozen=True)
class Fault:
    """What a fault during motion led to: its `text`, and for how long after it, and how far, the joints moved on."""

    text: str
    moved_s: float
    moved: float


def ros2_fault(fault: str) -> Fault:
    """Let a fault happen while the arm moves."""
    with program("ros2_controller", NAMESPACE) as (process, _), ros2_arm() as arm:
        with patient():
            q = arm.state().encoders
            arm.follow(smooth(q, q + np.where(ROTARY, 0.5, 50.0), 3.0))
            wait(arm, 1.0)
        if fault == "killed":
            process.kill()
        else:
            process.stdin.write(fault + "\n")
            process.stdin.flush()
        text = ""
        try:
            with nullcontext() if fault in ("killed", "silent", "late", "frozen") else patient():
                wait(arm, 1.0)
        except RobotRefusedError as error:
            text = str(error)
        if fault == "killed":
            return Fault(text, *_restarted())
        time.sleep(1.0)
        log = ended(process)
    return Fault(text, *_moved(log, log["faults"][0]))


def _restarted() -> tuple[float, float]:
    """Return for how long, and how far, a controller moves that begins after the fault of another."""
    with program("ros2_controller", NAMESPACE) as (process, _):
        time.sleep(3.0)
        log = ended(process)
    return _moved(log, log["time_s"][0])


def _moved(log: dict[str, Any], since_s: float) -> tuple[float, float]:
    """Return for how long after a time, and how far, rad or dm, the joints moved."""
    times, q = log["time_s"], log["q"] * np.where(ROTARY, 1.0, 10.0)
    after = times >= since_s
    speed = np.abs(np.diff(q, axis=0)).max(axis=1) / np.diff(times)
    moving = times[1:][after[1:] & (speed > 1e-3)]
    return float(moving[-1] - since_s) if len(moving) else 0.0, float(np.ptp(q[after], axis=0).max())


def ros2_commander() -> float:
    """Kill the program that commands a moving arm; return when its last message ends at rest, s after it came."""
    with program("ros2_controller", NAMESPACE) as (process, _):
        with program("arm_peers", "ros2") as (commander, _):
            time.sleep(1.0)
            commander.kill()
        time.sleep(0.5)
        log = ended(process)
    assert _moved(log, log["time_s"][-1] - 0.1)[1] == 0, "the arm moves"
    return float(log["rests_s"][-1] - log["came_s"][-1])


# franky-sim.


@contextmanager
def franka_arm(damping: float = 1.0) -> Iterator[tuple[Any, Any]]:
    """Run franky-sim and connect to it; give the arm and the simulator's process."""
    from sightline.robot.arms.franka import FrankaArm

    with program("franka_simulator", str(damping)) as (process, host):
        arm = FrankaArm(host)
        try:
            yield arm, process
        finally:
            arm.close()


def flange(q: np.ndarray) -> RigidTransform:
    """Return the poses of the flange at q (N, 7) by franky-sim's model, mm."""
    import franky_sim
    import pinocchio as pin

    model = pin.buildModelFromUrdf(str(Path(franky_sim.__file__).parent / "assets" / "fr3_clean.urdf"))
    data, frame = model.createData(), model.getFrameId("link8")
    poses = []
    for each in q:
        pin.framesForwardKinematics(model, data, each)
        poses.append(data.oMf[frame].homogeneous)
    pose = np.array(poses)
    return RigidTransform.from_components(1000 * pose[:, :3, 3], Rotation.from_matrix(pose[:, :3, :3]))


def franka_follow(count: int, damping: float = 1.0) -> np.ndarray:
    """Return the errors (count, 2) of the flange by the arm's own state at the ends of trajectories, mm and degrees."""
    rng, errors = np.random.default_rng(FIRST_SEED), []
    with franka_arm(damping) as (arm, _):
        home = arm.state().encoders
        for _ in range(count):
            end = home + rng.uniform(-0.3, 0.3, 7)
            arm.follow(smooth(arm.state().encoders, end, 2.0))
            wait(arm, 2.0)
            wait(arm, 8.0, lambda reading, end=end: np.abs(reading.encoders - end).max() < REACHED)
            wait(arm, 1.0)
            pose = flange(np.array([arm.state().encoders, end]))
            off = pose[0].inv() * pose[1]
            errors.append((np.linalg.norm(np.ptp(pose.translation, axis=0)), np.rad2deg(off.rotation.magnitude())))
    return np.array(errors)


@dataclass(frozen=True)
class Stop:
    """After what time, ms, a motion is no longer commanded, and the flange has 5 % of its speed; its way, mm."""

    command_ms: float
    flange_ms: float
    way_mm: float


def franka_stop(how: str, damping: float = 1.0) -> Stop:
    """End a motion by "stop", "hold" or "killed"."""
    with (
        program("franka_simulator", str(damping)) as (simulator, host),
        program("arm_peers", host, how) as (commander, now),
    ):
        ended_s = float(now)
        if how == "killed":
            commander.kill()
            ended_s = time.time()
        time.sleep(5.0)
        log = ended(simulator)
    at = flange(log["q"]).translation
    begun, window = int(np.searchsorted(log["time_s"], ended_s)), 10
    speed = np.linalg.norm(at[window:] - at[:-window], axis=1)
    fast = speed[begun:] > 0.05 * speed[begun - window]
    return Stop(
        float(np.argmin(log["commanded"][begun:])),
        float(np.flatnonzero(fast)[-1]) + window,
        float(np.linalg.norm(at[-1] - at[begun])),
    )


def main(where: str, how: str = "") -> None:
    """Command a motion that is ended or outlived: `ros2`, or the address of a Franka arm and how to end it."""
    if where == "ros2":
        with ros2_arm() as arm:
            q = arm.state().encoders
            arm.follow(smooth(q, q + np.where(ROTARY, 0.5, 50.0), 3.0))
            print("moving", flush=True)
            wait(arm, PATIENCE_S)
        return
    from sightline.robot.arms.franka import FrankaArm

    arm = FrankaArm(where)
    q = arm.state().encoders
    arm.follow(smooth(q, q + 0.3, 3.0))
    wait(arm, 1.5)
    now = time.time()
    if how != "killed":
        getattr(arm, how)()
    print(now, flush=True)
    wait(arm, PATIENCE_S)


def rows(quick: bool) -> Rows:
    """Return what these arms do, where they are installed."""
    found = Rows("arm")
    for installed, add in ((FRANKA, _franka_rows), (ROS2, _ros2_rows)):
        if installed:
            add(found, quick)
    return found


def _franka_rows(found: Rows, quick: bool) -> None:
    count = 5 if quick else 50
    errors = franka_follow(count)
    found.number(
        f"franky-sim, {count} trajectories: flange off its target by its own state",
        errors[:, 0].max(),
        unit="mm",
        most=0.05,
    )
    found.number("franky-sim, direction off by its own state", errors[:, 1].max(), unit="°", most=0.02)
    stops = {how: franka_stop(how) for how in ("stop", "hold", "killed")}
    stiff = franka_stop("stop", STIFF)
    found.number("franky-sim, STOP while moving: command ends", stops["stop"].command_ms, ".0f", "ms", most=100)
    found.number("franky-sim, hold while moving: command ends", stops["hold"].command_ms, ".0f", "ms", most=100)
    text = f"{stops['stop'].flange_ms:.0f} / {stiff.flange_ms:.0f} ms"
    found.add("franky-sim, STOP while moving: flange at 5 % of its speed, servo of 100 / 40 ms lag", text)
    found.number(
        "franky-sim, our process killed: flange at 5 % of its speed", stops["killed"].flange_ms, ".0f", "ms", most=100
    )


def _ros2_rows(found: Rows, quick: bool) -> None:
    ros2_local()
    count = 10 if quick else 100
    errors, _ = ros2_follow(count)
    followed = int((np.abs(errors) < REACHED).all(axis=1).sum())
    found.add(f"ROS 2, {count} trajectories: followed to {REACHED:g} rad", f"{followed}", f"{count}", followed == count)
    found.number("ROS 2, our process killed: at rest after the last message", ros2_commander(), unit="s", most=0.1001)
    faults = {name: ros2_fault(name) for name in FAULTS}
    named = [name for name, fault in faults.items() if fault.text]
    found.add("ROS 2, faults that are named", f"{len(named)}", f"{len(FAULTS)}", len(named) == len(FAULTS))
    moved = {name: fault.moved_s for name, fault in faults.items()}
    worst = max(moved, key=lambda name: moved[name])
    found.add("ROS 2, longest motion after a fault", f"{moved[worst]:.2f} s ({worst})")


if __name__ == "__main__":
    main(*sys.argv[1:])
