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
from contextlib import ExitStack, closing, contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from threading import Thread
from typing import Any
from unittest.mock import patch

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from benchmarks.harness import Rows
from sightline.errors import RobotRefusedError
from sightline.rehearsal.operation import calibrated_robot, start_of
from sightline.robot.arms.adapter import ArmAdapter
from sightline.robot.arms.connect import connect
from sightline.robot.arms.streamed import StreamedArm
from sightline.robot.control.controller import Controller
from sightline.robot.control.insertion import Setup
from sightline.robot.control.states import State
from sightline.robot.kinematics.target import STANDOFF_MM
from sightline.robot.link.client import RobotClient
from sightline.robot.link.server import RobotServer, Simulation
from sightline.robot.plant import WATCHDOG_S

ROS2 = find_spec("rclpy") is not None
FRANKA = find_spec("franky") is not None and find_spec("franky_sim") is not None
NAMESPACE = "sightline_test"
ROOT = Path(__file__).parents[1]
PATIENCE_S = 60.0  # a program that does not answer for so long has hung
POLL_S = 0.004  # between two cycles, as of the control loop
GAIN_PER_S = 10.0  # of what a joint is short of its course, as in the control loop
REACHED = 1e-4  # rad, mm: a fifth of what is asked of the guide at 0.1 m
FIRST_SEED = 81_000
LATE_S = 0.1  # the limit of sightline.robot.arms.ros2
LOWER, UPPER = np.array([*[-2 * np.pi] * 6, 0.0]), np.array([*[2 * np.pi] * 6, 200.0])  # of the controller; rad, mm
ROTARY = np.array([True] * 6 + [False])
FAULTS = ("killed", "silent", "late", "frozen", "nan", "degrees", "renamed", "fewer")
ENTRY_MM, END_MM = np.array([35.0, 31.0, -4.0]), np.array([7.7, 2.3, 1.1])  # CFCS: a wire in a hip


def stream(arm: ArmAdapter, end: np.ndarray, duration_s: float) -> np.ndarray:
    """Bring an arm to `end` (n,) as the control loop does; return what it is short of it."""
    plant, begin, begun_s = StreamedArm(arm), arm.state().encoders, time.monotonic()
    while True:
        reading, since_s = plant.read(), time.monotonic() - begun_s
        if reading.fault:
            raise RobotRefusedError(reading.fault)
        t = min(since_s / duration_s, 1.0)
        share, pace = t**3 * (10 - 15 * t + 6 * t**2), 30 * t**2 * (1 - t) ** 2 / duration_s
        short = end - reading.encoders
        if since_s > duration_s + 2.0 or (t == 1 and np.abs(short).max() < REACHED / 2):
            plant.hold()
            return short
        plant.command(pace * (end - begin) + GAIN_PER_S * (begin + share * (end - begin) - reading.encoders), False)
        time.sleep(POLL_S)


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


class Linked:
    """An arm behind the robot's link, and a client whose target it has not got yet. `in_step`: the loop waits for the
    arm's own clock."""

    def __init__(self, kind: Any, address: str, design: Any, *, in_step: bool) -> None:
        self.robot = calibrated_robot(arm=design)
        self.home = start_of(self.robot.manipulator, "right")
        self._closing = connect(kind, address, self.robot.manipulator, self.home)
        self.arm = self._closing.thing
        self._at_s = self.arm.state().time_s
        plant = StreamedArm(self.arm, lambda: self._at_s) if in_step else StreamedArm(self.arm)
        setup = Setup("right", "SN-7", frame_mounted=False, into_bone=False, c_arm_away=True)
        controller = Controller(self.robot, plant, setup)
        self.machine = controller.machine
        self.server = RobotServer(controller, plant, Simulation(self._wait, virtual=True) if in_step else None, port=0)

    def __enter__(self) -> "Linked":
        self._closing.__enter__()
        self.server.__enter__()
        self.client = RobotClient(port=self.server.port)
        return self

    def __exit__(self, *error: Any) -> None:
        self.client.close()
        self.server.close()
        self._closing.__exit__(*error)

    def _wait(self, dt_s: float) -> None:
        due_s = self._at_s + dt_s
        with suppress(RobotRefusedError):  # the machine hears of it
            while (at_s := self.arm.state().time_s) < due_s - 1e-9:
                time.sleep(POLL_S / 8)
            self._at_s = due_s if at_s < due_s + 0.01 else at_s  # it went on while the loop stood

    def aim(self, by_mm: np.ndarray) -> None:
        """Send a target that is shifted by (2, 3), CFCS."""
        self.entry_mm, end = ENTRY_MM + by_mm[0], END_MM + by_mm[1]
        self.along = (end - self.entry_mm) / np.linalg.norm(end - self.entry_mm)
        x = np.cross([0.0, 0.0, 1.0], self.along)
        x /= np.linalg.norm(x)
        axes = np.stack([x, np.cross(self.along, x), self.along], axis=1)
        self.client.start_up()
        self.client.calibrate(self.robot.manipulator.T_mcs_cfcs(self.home))
        # A bare target is that of a wire of 95 mm.
        self.entry_mm = end - 95.0 * self.along
        self.client.aim(RigidTransform.from_components(end, Rotation.from_matrix(axes)))

    def off(self, T_mcs_flange: RigidTransform) -> tuple[float, float]:
        """Return how far the guide's mouth is from where it should be, mm, and its direction, degrees."""
        held = self.robot.manipulator.T_mcs_cfcs(self.home).inv() * T_mcs_flange * self.robot.manipulator.T_flange_tool
        along = held.rotation.apply([0.0, 0.0, 1.0])
        mouth = self.entry_mm - STANDOFF_MM * self.along
        angle = np.arctan2(np.linalg.norm(np.cross(along, self.along)), along @ self.along)
        return float(np.linalg.norm(held.translation - mouth)), float(np.rad2deg(angle))

    def moving(self, act: Any, past_s: float = 1.0) -> str:
        """Align, `act` when the arm has moved for some seconds of its own clock, and return why it came no further."""
        said: list[str] = []

        def align() -> None:
            try:
                self.client.align()
            except RobotRefusedError as error:
                said.append(str(error))

        thread = Thread(target=align)
        thread.start()
        begun_s = self.arm.state().time_s
        while self.machine.state is not State.ALIGN or self.arm.state().time_s < begun_s + past_s:
            assert thread.is_alive(), said
            time.sleep(POLL_S)
        act()
        thread.join(PATIENCE_S)
        return said[0] if said else ""


# A controller of ROS 2.


@contextmanager
def ros2_arm() -> Iterator[Any]:
    """Connect to the controller of `program("ros2_controller", NAMESPACE)`."""
    from benchmarks.ros2_controller import JOINTS
    from sightline.robot.arms.ros2 import Ros2Arm

    with closing(Ros2Arm(NAMESPACE, JOINTS, LOWER, UPPER, ROTARY)) as arm:
        yield arm


def ros2_local() -> None:
    """Keep what follows on this machine, and apart from other programs."""
    os.environ |= {"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST", "ROS_DOMAIN_ID": str(1 + os.getpid() % 100)}


@contextmanager
def patient(late_s: float = PATIENCE_S, watchdog_s: float = PATIENCE_S) -> Iterator[None]:
    """Let samples and cycles be late, and joints off their course: on a busy machine a process may stand still for
    longer than the robot waits."""
    limits = {"arms.ros2.LATE_S": late_s, "control.machine.WATCHDOG_S": watchdog_s}
    limits |= {"arms.adapter.START_RAD": 0.2, "arms.adapter.START_MM": 50.0, "control.course.MOVING_LIMIT_RAD": 0.2}
    with ExitStack() as stack:
        for name, value in limits.items():
            stack.enter_context(patch(f"sightline.robot.{name}", value))
        yield


@contextmanager
def ros2_linked() -> Iterator[tuple[Any, Linked]]:
    """Serve a six-axis arm of a controller in another process, whose program is given too."""
    home = calibrated_robot(arm="six-axis").manipulator
    joints = dict(zip(home.joints, start_of(home, "right").tolist(), strict=True))
    with (
        program("ros2_controller", NAMESPACE, json.dumps(joints)) as (process, _),
        Linked("ros2", NAMESPACE, "six-axis", in_step=False) as linked,
    ):
        linked.aim(np.zeros((2, 3)))
        yield process, linked


def ros2_follow(count: int) -> tuple[np.ndarray, dict[str, Any]]:
    """Return the errors (count, 7) at the ends of trajectories, rad and mm, and the controller's log."""
    rng, errors = np.random.default_rng(FIRST_SEED), []
    with program("ros2_controller", NAMESPACE) as (process, _):
        with ros2_arm() as arm:
            home = arm.state().encoders
            for _ in range(count):
                end = home + rng.uniform(-0.3, 0.3, 7) * np.where(ROTARY, 1.0, 100.0)
                errors.append(stream(arm, end, rng.uniform(2.2, 3.0)))
        return np.array(errors), ended(process)


@dataclass(frozen=True)
class Fault:
    """What a fault during motion led to: its `text`, and for how long after it, and how far, the joints moved on."""

    text: str
    moved_s: float
    moved: float


def ros2_fault(fault: str) -> Fault:
    """Let a fault happen while an arm moves that is served."""
    with ExitStack() as stack:
        stack.enter_context(patient())
        process, linked = stack.enter_context(ros2_linked())

        def begin() -> None:
            if fault in ("killed", "silent", "late", "frozen"):
                stack.enter_context(patient(LATE_S, WATCHDOG_S))
            if fault == "killed":
                process.kill()
            else:
                process.stdin.write(fault + "\n")
                process.stdin.flush()

        text = linked.moving(begin)
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
    """Return for how long after a time, and how far, the joints moved, rad."""
    times, q = log["time_s"], log["q"]
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
        time.sleep(1.0)
        log = ended(process)
    assert _moved(log, log["rests_s"][-1] + 0.1)[1] < REACHED, "the arm moves"  # ten times its lag
    return float(log["rests_s"][-1] - log["came_s"][-1])


# franky-sim.


def fr3_flange(q: np.ndarray) -> RigidTransform:
    """Return the poses of the flange at q (N, 7) by franky-sim's model, mm; its x and y axes are not turned as ours."""
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


@contextmanager
def franka_linked() -> Iterator[tuple[Any, Linked]]:
    """Serve franky-sim's arm; its program is given too."""
    home = start_of(calibrated_robot(arm="seven-axis").manipulator, "right").tolist()
    with (
        program("franka_simulator", json.dumps(home)) as (process, host),
        Linked("franka", host, "seven-axis", in_step=True) as linked,
    ):
        yield process, linked


def franka_align(count: int) -> np.ndarray:
    """Return the errors (count, 2) of the guide by the arm's own state and franky-sim's model, mm and degrees, where
    plans bring it."""
    rng, errors = np.random.default_rng(FIRST_SEED), []
    with franka_linked() as (_, linked):
        for _ in range(count):
            linked.aim(rng.uniform(-8.0, 8.0, (2, 3)))
            linked.client.align()
            begun_s = linked.arm.state().time_s
            while linked.arm.state().time_s < begun_s + 1.0:
                time.sleep(POLL_S)
            errors.append(linked.off(fr3_flange(linked.arm.state().encoders[None])[0]))
            linked.client.retract()
    return np.array(errors)


@dataclass(frozen=True)
class Stop:
    """After what time, ms, a motion is no longer commanded, and the guide has 5 % of its speed; its way, mm."""

    command_ms: float
    guide_ms: float
    way_mm: float


def franka_stop(how: str) -> Stop:
    """End a motion: "STOP" by a client, or "killed", the program that serves the arm."""
    home = start_of(calibrated_robot(arm="seven-axis").manipulator, "right").tolist()
    with (
        program("franka_simulator", json.dumps(home)) as (simulator, host),
        program("arm_peers", host, how) as (commander, now),
    ):
        ended_s = float(now)
        if how == "killed":
            commander.kill()
            ended_s = time.time()
        time.sleep(5.0)
        log = ended(simulator)
    at = fr3_flange(log["q"]).translation
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
            print("moving", flush=True)
            stream(arm, arm.state().encoders + np.where(ROTARY, 0.5, 50.0), 3.0)
        return
    with Linked("franka", where, "seven-axis", in_step=True) as linked:

        def stop() -> None:
            print(time.time(), flush=True)
            if how == "STOP":
                linked.client.stop()

        linked.aim(np.zeros((2, 3)))
        linked.moving(stop)


def rows(quick: bool) -> Rows:
    """Return what these arms do, where they are installed."""
    found = Rows("arm")
    for installed, add in ((FRANKA, _franka_rows), (ROS2, _ros2_rows)):
        if installed:
            add(found, quick)
    return found


def _franka_rows(found: Rows, quick: bool) -> None:
    count = 5 if quick else 50
    errors = franka_align(count)
    add = partial(found.number, unit="mm", most=0.05)
    add(f"franky-sim, {count} plans to ALIGNED: guide off its target by the arm's own state", errors[:, 0].max())
    found.number("franky-sim, its direction", errors[:, 1].max(), unit="°", most=0.02)
    for how, what in (("STOP", "STOP while moving"), ("killed", "our process killed")):
        stop = franka_stop(how)
        found.number(f"franky-sim, {what}: command ends", stop.command_ms, ".0f", "ms", most=100)
        found.number(f"franky-sim, {what}: guide at 5 % of its speed", stop.guide_ms, ".0f", "ms", most=100)


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
