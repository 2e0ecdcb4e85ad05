"""A program that runs franky-sim, its damping times an argument: prints the arm's address, and at the end of its input
a log of each simulated millisecond as JSON: the system's time, positions, and whether a motion is commanded.

franky-sim's servo has a lag of 0.1 s, its damping over its stiffness. The damping of the last joint is too large for
steps of 1 ms, so that the joint swings.
"""

import json
import os
import sys
import time
from threading import Thread

from franky_sim import SimulationServer
from franky_sim.mujoco_simulator import MUJOCO_DEFAULT_KV, MujocoSimulator


def main() -> None:
    log: list[tuple[float, list[float], bool]] = []
    with MujocoSimulator() as simulator:
        robot = simulator.add_robot(kv=tuple(float(sys.argv[1]) * gain for gain in MUJOCO_DEFAULT_KV))
        with SimulationServer(simulator) as server:

            def listen() -> None:
                sys.stdin.read()
                print(
                    json.dumps(dict(zip(("time_s", "q", "commanded"), zip(*log, strict=True), strict=True))), flush=True
                )
                os._exit(0)

            def step(_: object) -> None:
                log.append((time.time(), list(robot.inner_state.q), robot.server.current_motion_id > 0))

            simulator.register_post_step_callback(step)
            print(robot.hostname, flush=True)
            Thread(target=listen, daemon=True).start()
            server.run_forever()


if __name__ == "__main__":
    main()
