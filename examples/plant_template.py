"""Connect your robot to Sightline's link: `python examples/plant_template.py robot.json [PORT]`.

Replace `Motors` by your motor controller's programming interface; `MotorPlant` and the rest may stay. This `Motors` is
a stand-in with joints that reach a commanded velocity at once. Read docs/real-robot.md before any real robot moves.
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

SAMPLE_S = 0.002  # sampling of your motor controller: at least twice per cycle of 5 ms


class Motors:
    """Your motor controller.

    Its firmware, not this class, must stop the drives when no velocity was set for WATCHDOG_S, and at once when the
    stop button is pressed or the hold-to-run switch is released.
    """

    def __init__(self, position: np.ndarray) -> None:
        self.position, self.velocity, self.force_n = position, np.zeros_like(position), 0.0
        self.stop_pressed, self.run_held, self.drill = False, True, False
        self._set_s = time.monotonic()

    def set_velocity(self, velocity: np.ndarray) -> None:
        """Set the joints' velocities, from the base to the flange, mm/s and rad/s."""
        self.velocity, self._set_s = velocity, time.monotonic()

    def step(self, dt_s: float) -> None:
        """Simulate the motion that your hardware does by itself."""
        alive = time.monotonic() - self._set_s < WATCHDOG_S
        if alive and self.run_held and not self.stop_pressed:
            self.position = self.position + dt_s * self.velocity


class MotorPlant:
    """`sightline.robot.plant.Plant` for your motor controller.

    A separate loop samples it, so that `read` and `command` return at once. `with MotorPlant(...)` runs the loop.
    """

    def __init__(self, motors: Motors, manipulator: Manipulator) -> None:
        self._motors, self._manipulator = motors, manipulator
        self._lock, self._end = Lock(), Event()
        self._began_s = self._sampled_s = time.monotonic()
        self._latest = self._sample()
        self._loop = Thread(target=self._run, name="motors", daemon=True)

    def __enter__(self) -> "MotorPlant":
        self._loop.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._end.set()
        self._loop.join()
        self.hold()

    # Called by the controller every 5 ms.

    def read(self) -> Reading:
        """Return the latest sample. If the loop hangs, the sample is old, and the controller stops after 50 ms."""
        return self._latest

    def command(self, joint_velocity: np.ndarray, drill_on: bool) -> None:
        """Set velocities, limited to the robot's speeds, and the drill."""
        limit = self._manipulator.speed
        with self._lock:
            self._motors.set_velocity(np.clip(joint_velocity, -limit, limit))
            self._motors.drill = drill_on

    def hold(self) -> None:
        """Stop the joints and the drill."""
        self.command(np.zeros(self._manipulator.count), drill_on=False)

    # The loop.

    def cycle(self) -> None:
        """Run the loop once: take a new sample."""
        now = time.monotonic()
        with self._lock:
            self._motors.step(now - self._sampled_s)  # omit this line: your hardware moves by itself
            self._latest = self._sample()
        self._sampled_s = now

    def _run(self) -> None:
        prefer_this_thread(PRIORITY)  # if permitted: the control loop must never wait for a sample
        while not self._end.wait(SAMPLE_S):
            self.cycle()

    def _sample(self) -> Reading:
        """Return encoders, units and directions as in docs/robot.md. Check each joint's sign first, slowly, by hand."""
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
    # What a person confirmed at the robot: side, frame, and whether the wire enters bone. Here it moves through air.
    setup = Setup(known.side, known.frame_serial, into_bone=False, frame=known.frame)
    if robot.manipulator.has_feed:
        start = np.array([3.0, -5.0, np.pi / 4 if known.side == "right" else -np.pi / 4, 0.0, 0.5])
    else:
        start = (robot.manipulator.lower + robot.manipulator.upper) / 2
    motors = Motors(start)
    with MotorPlant(motors, robot.manipulator) as plant:
        controller = Controller(robot, plant, setup, first_fault=int(time.time()) % 1_000_000 + 1)
        with RobotServer(controller, plant, port=int(port)) as server:
            print(f"listening at 127.0.0.1:{server.port}", flush=True)
            sys.stdin.read()


if __name__ == "__main__":
    main(*sys.argv[1:])
