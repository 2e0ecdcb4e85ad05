"""Speed of the manipulator's arithmetic: the simulated plant against real time, and kinematics.

Processor time of one thread, the smallest of many runs.
"""

import time
from collections.abc import Callable
from functools import partial

import numpy as np
from scipy.spatial.transform import RigidTransform

from benchmarks.rows import Row
from sightline.robot.kinematics.manipulator import FEED, WRIST_MM, Manipulator, nominal_manipulator
from sightline.robot.kinematics.reach import check_reach, hip_surroundings
from sightline.robot.plant import CYCLE_S
from sightline.twin.anatomy.femur import Femur, to_cfcs, voxelise
from sightline.twin.robot.drilling import Bone
from sightline.twin.robot.plant import SimulatedPlant

REQUIRED_FACTOR = 50.0  # 300 insertions of two minutes in ten
GUIDE_GAP_MM, STANDOFF_MM = 10.0, 20.0
IMAGING = np.array([0.0, 0.0, np.pi / 4, 0.0, 0.0])
TILT_RAD = 1e-3  # of the displaced axes


def run(quick: bool) -> list[Row]:
    """Return the rows of this benchmark."""
    robot = nominal_manipulator()
    entry, end = _wire(robot)
    waypoints = np.stack([IMAGING, *(robot.inverse(entry, end, depth) for depth in (-STANDOFF_MM, 80.0))])
    theatre = hip_surroundings(robot.T_mcs_cfcs(IMAGING))
    runs = 20 if quick else 200
    factor = _factor(robot, seconds=5.0 if quick else 100.0)
    name, required = "times real time, drilling a femur", f"{REQUIRED_FACTOR:.0f}"
    rows = [Row("manipulator", name, f"{factor:.0f}", required, met=factor >= REQUIRED_FACTOR)]
    for name, one in (("nominal", robot), ("displaced", _displaced(robot))):
        inverse = 1e6 * _least(partial(one.inverse, entry, end), runs)
        pose = 1e6 * _least(partial(one.T_mcs_tool, IMAGING), runs)
        rows.append(Row("manipulator", f"inverse / pose of the tool, {name} axes", f"{inverse:.0f} / {pose:.0f} µs"))
    reach = 1e3 * _least(partial(check_reach, robot, waypoints, theatre), max(runs // 20, 3))
    return [*rows, Row("manipulator", "reach and collisions of a whole path", f"{reach:.0f} ms")]


def _wire(robot: Manipulator) -> np.ndarray:
    """Return entry and end (2, 3), MCS, of a femur's ideal wire with its middle at the frame's origin."""
    wire = to_cfcs(np.stack(Femur().wire_mm()), "right", np.zeros(3))
    return robot.T_mcs_cfcs(IMAGING).apply(wire - wire.mean(axis=0))


def _displaced(robot: Manipulator) -> Manipulator:
    twists = np.zeros((6, 6))
    twists[:, :3] = TILT_RAD * np.random.default_rng(1).standard_normal((6, 3))
    twists[:, 3:] = np.cross(WRIST_MM, twists[:, :3])
    return robot.displaced(twists)


def _factor(robot: Manipulator, seconds: float) -> float:
    """Return simulated over processor time in the fastest tenth of a drilling from stand-off to the wire's end."""
    femur = Femur()
    middle = to_cfcs(np.mean(femur.wire_mm(), axis=0), "right", np.zeros(3))
    place = robot.T_mcs_cfcs(IMAGING) * RigidTransform.from_translation(-middle)
    bone = Bone((voxelise(femur, "right", np.zeros(3), np.random.default_rng(1)),), place)
    start = robot.inverse(*_wire(robot), -STANDOFF_MM)
    plant = SimulatedPlant(robot, bone, np.random.default_rng(2), start)
    plant.guide_mm = start[FEED] + STANDOFF_MM - GUIDE_GAP_MM
    velocity, spent = np.array([0.0, 0.0, 0.0, 0.0, 1.0]), []
    for _ in range(10):
        begun = time.thread_time()
        for _ in range(round(seconds / 10 / CYCLE_S)):
            plant.command(velocity, drill_on=True)
            plant.advance(CYCLE_S)
        spent.append(time.thread_time() - begun)
    return seconds / 10 / min(spent)


def _least(work: Callable[[], object], runs: int) -> float:
    """Return the smallest processor time of the runs, s."""
    spent = []
    for _ in range(runs):
        begun = time.thread_time()
        work()
        spent.append(time.thread_time() - begun)
    return min(spent)
