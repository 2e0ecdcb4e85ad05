"""A program that runs franky-sim from the joints in its argument, as JSON: prints the arm's address, and at the end of
its input a log of each simulated millisecond as JSON: the system's time, positions, and whether a motion is commanded.

The damping of franky-sim's last joint is too large for steps of 1 ms, so that the joint swings by 0.1 mrad: of DAMPING,
the shares of it, the last leaves no swing.
"""

import json
import os
import sys
import time
from threading import Thread

import numpy as np
from franky_sim import SimulationServer
from franky_sim.mujoco_simulator import MUJOCO_DEFAULT_KV, MujocoSimulator

DAMPING = (1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 0.4)


def main() -> None:
    log: list[tuple[float, list[float], bool]] = []
    with MujocoSimulator() as simulator:
        robot = simulator.add_robot(json.loads(sys.argv[1]), kv=tuple(np.multiply(DAMPING, MUJOCO_DEFAULT_KV)))
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
