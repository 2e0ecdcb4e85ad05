"""A robot of yours behind Sightline's link: `python examples/plant_template.py robot.json [PORT]`.

Replace `Motors` by your motor controller's own program interface; `MotorPlant` and the rest may stay. What `Motors`
does here is a stand-in: joints that reach a commanded velocity at once. See docs/real-robot.md before anything real
moves.
"""

import sys
import time
from pathlib import Path
from threading import Event, Lock, Thread

import numpy as np

from sightline.robot.control.controller import Controller
from sightline.robot.control.insertion import Setup
from sightline.robot.kinematics.manipulator import Manipulator
from sightline.robot.kinematics.measured import RobotFile
from sightline.robot.link.server import PRIORITY, RobotServer, prefer_this_thread
from sightline.robot.plant import WATCHDOG_S, PlantFlag, Reading

SAMPLE_S = 0.002  # of your motor controller: at least twice for each cycle of 5 ms


class Motors:
    """Your motor controller. Its drives must stop by themselves where no velocity was set for WATCHDOG_S, and at once
    when the stop button is pressed or the hold-to-run switch is released: in its firmware, not here."""

    def __init__(self, position: np.ndarray) -> None:
        self.position, self.velocity, self.force_n = position, np.zeros(5), 0.0
        self.stop_pressed, self.run_held, self.drill = False, True, False
        self._set_s = time.monotonic()

    def set_velocity(self, velocity: np.ndarray) -> None:
        """mm/s and rad/s of lift, traverse, yaw, pitch, feed."""
        self.velocity, self._set_s = velocity, time.monotonic()

    def step(self, dt_s: float) -> None:
        """What your hardware does by itself."""
        alive = time.monotonic() - self._set_s < WATCHDOG_S
        if alive and self.run_held and not self.stop_pressed:
            self.position = self.position + dt_s * self.velocity


class MotorPlant:
    """`sightline.robot.plant.Plant` on your motor controller: a loop of its own samples it, so that `read` and
    `command` return at once. `with MotorPlant(...)` runs the loop."""

    def __init__(self, motors: Motors, manipulator: Manipulator) -> None:
        self._motors, self._manipulator = motors, manipulator
        self._lock, self._end = Lock(), Event()
        self._began_s = self._turned_s = time.monotonic()
        self._latest = self._sample()
        self._loop = Thread(target=self._run, name="motors", daemon=True)

    def __enter__(self) -> "MotorPlant":
        self._loop.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._end.set()
        self._loop.join()
        self.hold()

    # What the controller calls, every 5 ms.

    def read(self) -> Reading:
        """The latest sample. A loop that hangs gives an old one: the controller stops after 50 ms of it."""
        return self._latest

    def command(self, joint_velocity: np.ndarray, drill_on: bool) -> None:
        """Cut to the robot's speeds, whatever the controller asks."""
        limit = self._manipulator.speed
        with self._lock:
            self._motors.set_velocity(np.clip(joint_velocity, -limit, limit))
            self._motors.drill = drill_on

    def hold(self) -> None:
        """Stand still, the drill off."""
        self.command(np.zeros(5), drill_on=False)

    # The loop.

    def turn(self) -> None:
        """One turn of the loop: a new sample."""
        now = time.monotonic()
        with self._lock:
            self._motors.step(now - self._turned_s)  # leave this out: your hardware moves by itself
            self._latest = self._sample()
        self._turned_s = now

    def _run(self) -> None:
        prefer_this_thread(PRIORITY)  # where the system allows it: the control loop must never wait for a sample
        while not self._end.wait(SAMPLE_S):
            self.turn()

    def _sample(self) -> Reading:
        """Encoders in the units and directions of docs/robot.md: check each joint's sign by hand, slowly, first."""
        motors, flags = self._motors, PlantFlag.NONE
        for flag, on in (
            (PlantFlag.STOP_PRESSED, motors.stop_pressed),
            (PlantFlag.RUN_HELD, motors.run_held),
            (PlantFlag.DRILL_ON, motors.drill),
        ):
            flags |= flag if on else PlantFlag.NONE
        return Reading(time.monotonic() - self._began_s, motors.position.copy(), motors.force_n, flags)


def main(file: str, port: str = "18936") -> None:
    """Serve until Ctrl-C, or until standard input ends."""
    known = RobotFile.read(Path(file))
    robot = known.robot()
    # What a person has confirmed at the robot: side, frame, and that bone is to be met. Here the wire goes through air.
    setup = Setup(known.side, known.frame_serial, into_bone=False)
    motors = Motors(np.array([3.0, -5.0, np.pi / 4 if known.side == "right" else -np.pi / 4, 0.0, 0.5]))
    with MotorPlant(motors, robot.manipulator) as plant:
        controller = Controller(robot, plant, setup, first_fault=int(time.time()) % 1_000_000 + 1)
        with RobotServer(controller, plant, port=int(port)) as server:
            print(f"listening at 127.0.0.1:{server.port}", flush=True)
            sys.stdin.read()


if __name__ == "__main__":
    main(*sys.argv[1:])
