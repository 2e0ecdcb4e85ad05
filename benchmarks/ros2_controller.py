"""A program that behaves as a joint_trajectory_controller: `ros2_controller.py NAMESPACE [JOINTS]`.

As a controller of ros2_controllers with its defaults: a trajectory without a stamp begins at once, at the measured
state, and replaces the one before; it refuses empty ones, other joints, times that do not increase and ends that move.
The joints follow with a lag of 10 ms; a JSON object names them and says where they begin, rad and m. A line on standard
input is a fault to begin: `silent`, `late`, `frozen`, `nan`, `degrees`, `renamed`, `fewer`. At the
end of the input its log is printed as JSON: positions, when a message came and when it would be at rest, and what was
refused.
"""

import json
import os
import sys
from collections import deque
from threading import Thread
from typing import Any

import numpy as np
import rclpy
from rclpy.clock import Clock
from scipy.interpolate import CubicHermiteSpline
from sensor_msgs.msg import JointState
from trajectory_msgs.msg import JointTrajectory

# Six joints and a feed, as their file names them; what is published is in another order. SI units.
HOME = {"shoulder_pan": 0.3, "shoulder_lift": -1.2, "elbow": 1.4, "wrist_1": -0.5, "wrist_2": 0.8, "wrist_3": 0.1}
HOME |= {"feed": 0.05}
JOINTS = tuple(HOME)
CYCLE_S, LAG_S, LATE_S = 0.01, 0.01, 0.2


class Controller:
    """The controller and its arm."""

    def __init__(self, namespace: str, home: dict[str, float]) -> None:
        rclpy.init()
        self.joints, begin = tuple(home), np.array(list(home.values()))
        self.node, self.clock, self.fault = rclpy.create_node("controller"), Clock(), ""
        self.q, self.v, self.at_s = begin, np.zeros(len(begin)), self.now_s
        self.path: Any = CubicHermiteSpline([0.0, 1.0], [begin, begin], np.zeros((2, len(begin))))
        self.begun_s = self.at_s
        self.states: deque[tuple[float, Any]] = deque()  # on their way
        self.commands: deque[tuple[float, Any]] = deque()
        self.log: dict[str, list[Any]] = {
            "time_s": [],
            "q": [],
            "came_s": [],
            "rests_s": [],
            "refused": [],
            "faults": [],
        }
        self.publisher = self.node.create_publisher(JointState, f"{namespace}/joint_states", 10)
        topic = f"{namespace}/joint_trajectory_controller/joint_trajectory"
        self.node.create_subscription(JointTrajectory, topic, lambda m: self.commands.append((self.now_s, m)), 10)
        self.node.create_timer(CYCLE_S, self.cycle)

    @property
    def now_s(self) -> float:
        return 1e-9 * self.clock.now().nanoseconds

    def cycle(self) -> None:
        now_s, delay_s = self.now_s, LATE_S if self.fault == "late" else 0.0
        while self.commands and self.commands[0][0] + delay_s <= now_s:
            self.take(self.commands.popleft()[1], now_s)
        passed = min(now_s - self.begun_s, self.path.x[-1])
        left = np.exp((self.at_s - now_s) / LAG_S)
        self.q, self.at_s = self.path(passed) + left * (self.q - self.path(passed)), now_s
        self.v = (self.path(passed) - self.q) / LAG_S
        self.log["time_s"].append(now_s)
        self.log["q"].append(self.q.tolist())
        self.states.append((now_s, self.sample()))
        while self.states and self.states[0][0] + delay_s <= now_s:
            message = self.states.popleft()[1]
            if self.fault != "silent":
                self.publisher.publish(message)

    def take(self, message: JointTrajectory, now_s: float) -> None:
        times = np.array([p.time_from_start.sec + 1e-9 * p.time_from_start.nanosec for p in message.points])
        names = list(message.joint_names)
        if sorted(names) != sorted(self.joints) or len(times) == 0 or (np.diff(times, prepend=0.0) <= 0).any():
            self.log["refused"].append("names or times")
            return
        order = [names.index(joint) for joint in self.joints]
        positions = np.array([p.positions for p in message.points])[:, order]
        velocities = np.array([p.velocities for p in message.points])[:, order]
        if velocities[-1].any() or not np.isfinite(positions).all():
            self.log["refused"].append("moves at its end")
            return
        self.path = CubicHermiteSpline(
            np.append(0.0, times), np.vstack([self.q, positions]), np.vstack([self.v, velocities])
        )
        self.begun_s = now_s
        self.log["came_s"].append(now_s)
        self.log["rests_s"].append(now_s + times[-1])

    def sample(self) -> JointState:
        message = JointState(name=list(self.joints[::-1]), position=self.q[::-1].tolist())
        message.header.stamp = self.clock.now().to_msg()
        if self.fault == "frozen":
            message = self.states[-1][1] if self.states else self.frozen
        self.frozen = message
        if self.fault == "nan":
            message.position[2] = np.nan
        elif self.fault == "degrees":
            message.position = np.rad2deg(self.q[::-1]).tolist()
        elif self.fault == "renamed":
            message.name[1] = "tool0"
        elif self.fault == "fewer":
            message.name, message.position = message.name[1:], message.position[1:]
        return message


def main() -> None:
    controller = Controller(sys.argv[1], json.loads(sys.argv[2]) if len(sys.argv) > 2 else HOME)

    def listen() -> None:
        for line in sys.stdin:
            controller.fault = line.strip()
            controller.log["faults"].append(controller.now_s)
        print(json.dumps(controller.log), flush=True)
        os._exit(0)

    Thread(target=listen, daemon=True).start()
    print("ready", flush=True)
    rclpy.spin(controller.node)


if __name__ == "__main__":
    main()
