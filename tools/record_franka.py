"""Record how the Franka adapter drives franky-sim: tests/robot/franka_exchange.json, which its test replays.

    python -m tools.record_franka

Needs `pip install sightline[franka] franky-sim` (660 MB), beside requirements-dev.lock.
"""

import importlib
import json
import sys
import time
from importlib.metadata import version
from threading import Lock
from typing import Any
from xml.etree import ElementTree

import franky
from benchmarks.arm_peers import program
from tests.robot.franka_exchange import HOME, RECORDED, Exchange, drive

SAMPLE_S = 0.02  # between two samples: a trajectory is sent after each, as every 20 ms by a `StreamedArm`


class Recorder:
    """Answers calls by franky itself, and keeps both."""

    def __init__(self) -> None:
        self.exchange: list[dict[str, Any]] = []
        self._lock = Lock()
        self._robot: Any = None
        self._next_s = 0.0

    def __call__(self, name: str, arguments: dict[str, Any]) -> Any:
        """Return franky's answer as JSON."""
        entry: dict[str, Any] = {"call": name, "arguments": arguments}
        try:
            entry["answer"] = self._answer(name, arguments)
        except Exception as error:
            entry["raises"] = str(error)
            raise
        finally:
            with self._lock:
                self.exchange.append(entry)
        return entry["answer"]

    def _answer(self, name: str, arguments: dict[str, Any]) -> Any:
        match name:
            case "Robot":
                config = getattr(franky.RealtimeConfig, arguments["realtime_config"])
                self._robot = franky.Robot(arguments["host"], realtime_config=config)
            case "model_urdf":
                return joints_alone(self._robot.model_urdf)
            case "joint_velocity_limit.get":
                return self._robot.joint_velocity_limit.get().tolist()
            case "state":
                state = self._robot.state
                while state.time.to_sec() < self._next_s:
                    time.sleep(SAMPLE_S / 20)
                    state = self._robot.state
                self._next_s = state.time.to_sec() + SAMPLE_S - 1e-6  # rounding
                mode, errors = state.robot_mode.name, str(state.current_errors)
                return {
                    "time_s": state.time.to_sec(), "q": state.q.tolist(), "robot_mode": mode, "current_errors": errors,
                }  # fmt: skip
            case "move":
                self._robot.move(motion_of(arguments["motion"]), asynchronous=arguments["asynchronous"])
            case "is_in_control":
                return self._robot.is_in_control
            case "poll_motion" | "join_motion":
                return getattr(self._robot, name)()
        return None


def joints_alone(urdf: str) -> str:
    """Return a model of nothing but the names and types of its joints."""
    joints = ElementTree.fromstring(urdf).iter("joint")  # noqa: S314 - franky-sim's own file
    lines = [f'<joint name="{joint.attrib["name"]}" type="{joint.attrib["type"]}"/>' for joint in joints]
    return f"<robot>{''.join(lines)}</robot>"


def motion_of(motion: dict[str, Any]) -> Any:
    """Return franky's motion of one in JSON, whose times are in ms."""
    [(name, waypoints)] = motion.items()
    if not waypoints:
        return getattr(franky, name)()
    points = []
    for waypoint in waypoints:
        times = {key: franky.Duration(ms) for key, ms in waypoint.items() if key != "target"}
        points.append(franky.JointVelocityWaypoint(waypoint["target"], **times))
    return getattr(franky, name)(points)


def main() -> None:
    """Write the file."""
    recorder = Recorder()
    exchange = Exchange(recorder)
    sys.modules["franky"] = exchange.franky  # pyright: ignore[reportArgumentType]
    adapter = importlib.import_module("sightline.robot.arms.franka")
    with program("franka_simulator", json.dumps(HOME.tolist())) as (process, host):
        drive(exchange, adapter.FrankaArm(host), process.kill)
    versions = {name: version(name) for name in ("franky-control", "franky-sim")}
    lines = ",\n".join(json.dumps(entry) for entry in recorder.exchange)
    RECORDED.write_text(f'{{"made_by": "python -m tools.record_franka",\n"versions": {json.dumps(versions)},\n'
                        f'"exchange": [\n{lines}\n]}}\n')  # fmt: skip


if __name__ == "__main__":
    main()
