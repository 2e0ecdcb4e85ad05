"""Collision check of a path before motion: joint limits and clearances along straight lines in joint space.

The robot is modelled by capsules, its surroundings by boxes; distances between them are exact. The wire is left out,
and the guide of the patient alone: they are meant to touch the patient.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from sightline.common.checks import Check, at_least, at_most
from sightline.errors import UnusableInputError
from sightline.robot.kinematics.calibrated import REMOUNT_SD
from sightline.robot.kinematics.manipulator import Capsule, Manipulator

CLEARANCE_MM = 5.0  # least clearance: allows for drapes and a registration error of a millimetre [ours]
REMOUNT_LIMIT_MM = 2.0 * float(REMOUNT_SD[3])  # 0.1 mm: repeatability of a remounted frame
STEP_MM = 2.0  # largest movement of any point of the robot between two checked positions
# Positions at which the length of a way is measured, and allowance for its arcs being longer than their chords [ours]:
# 0.5 % for 20° between two.
_COARSE, _CHORD = 17, 1.05


@dataclass(frozen=True, eq=False)
class Obstacle:
    """A box: `T_mcs_box` is the pose of its centre, `half_mm` (3,) are half its edges. Boxes may share a name."""

    name: str
    T_mcs_box: RigidTransform
    half_mm: np.ndarray


@dataclass(frozen=True, eq=False)
class Surroundings:
    """The obstacles around the robot, and the frame it holds. `frame_mounted`: the frame is still on the flange.
    `remount_mm`: repeatability of a frame removed since its calibration; None: it was not removed."""

    obstacles: tuple[Obstacle, ...]
    frame_mounted: bool = True
    remount_mm: float | None = None


# Rims of the Γ frame's plates, CFCS: distance from the hip, half-edge; half their thickness (docs/frame-file.md).
PLATES_MM = ((150.0, 64.0), (300.0, 74.0))
PLATE_RADIUS_MM = 4.0
GUIDE_RADIUS_MM = 10.0  # [ours] of a guide's tube
# Typical surroundings [ours]. Corners of boxes about the hip's centre, CFCS (lateral, caudal or cranial, anterior), low
# and high: the patient, lateral of the incision's bottom some 35 mm on the bone; a table 500 mm wide, the hip 90 mm
# beside its middle. The detector's housing: its face 380 mm from the hip (1000 mm from a source at 620), edge 300 mm,
# depth 350 mm.
PATIENT_MM = ((-300.0, -900.0, -115.0), (70.0, 900.0, 100.0))
TABLE_MM = ((-340.0, -1000.0, -175.0), (160.0, 1000.0, -115.0))
DETECTOR_FACE_MM, DETECTOR_HALF_MM = 380.0, (150.0, 150.0, 175.0)
PATIENT, GUIDE = "patient", "guide"
SWING_RAD = np.deg2rad(np.arange(0.0, 90.1, 7.5))  # from the PA to the lateral view


def hip_surroundings(
    T_mcs_cfcs: RigidTransform, frame_mounted: bool = True, remount_mm: float | None = None, *, c_arm: bool = True
) -> Surroundings:
    """Return a supine patient on a table, hip at the frame's origin, and the C-arm as it swings between its views,
    unless it is drawn back (`c_arm` False)."""
    swings = [Rotation.from_euler("y", angle) for angle in SWING_RAD]  # +Z towards +X: anterior towards lateral
    centre_mm = (DETECTOR_FACE_MM + DETECTOR_HALF_MM[2]) * np.array([0.0, 0.0, 1.0])
    poses = [RigidTransform.from_components(swing.apply(centre_mm), swing) for swing in swings]
    return Surroundings(
        (
            _box(PATIENT, T_mcs_cfcs, *PATIENT_MM),
            _box("table", T_mcs_cfcs, *TABLE_MM),
            *(Obstacle("C-arm", T_mcs_cfcs * pose, np.array(DETECTOR_HALF_MM)) for pose in poses if c_arm),
        ),
        frame_mounted,
        remount_mm,
    )


def check_reach(robot: Manipulator, waypoints: np.ndarray, surroundings: Surroundings) -> tuple[Check, ...]:
    """Return the checks of a path through joint positions (K, n), straight between them: joint limits, clearance to
    each obstacle, and whether a remounted frame repeats its place. Raises UnusableInputError."""
    waypoints = np.asarray(waypoints, dtype=np.float64)
    if waypoints.ndim != 2 or waypoints.shape[1] != robot.count or not np.isfinite(waypoints).all():
        raise UnusableInputError(f"a path is one or more positions of {robot.count} finite joints")
    capsules = [*robot.parts, *guide_capsules(robot), *(frame_capsules(robot) if surroundings.frame_mounted else ())]
    path = between(robot, waypoints, capsules)
    names = dict.fromkeys(obstacle.name for obstacle in surroundings.obstacles)
    axes = part_axes(robot, path, capsules)
    return (
        _limits(robot, path),
        *(_clearance(name, [o for o in surroundings.obstacles if o.name == name], capsules, axes) for name in names),
        _remount(surroundings),
    )


def segment_to_box_mm(ends_mm: np.ndarray, half_mm: np.ndarray) -> np.ndarray:
    """Return the distance (...) of segments (..., 2, 3) from a box centred on the origin; 0 inside. The squared
    distance is convex along a segment, so its slope is bisected."""
    start, way = ends_mm[..., 0, :], ends_mm[..., 1, :] - ends_mm[..., 0, :]
    low, high = np.zeros(start.shape[:-1]), np.ones(start.shape[:-1])
    for _ in range(50):
        middle = (low + high) / 2
        at = start + middle[..., None] * way
        rising = ((at - np.clip(at, -half_mm, half_mm)) * way).sum(axis=-1) > 0
        low, high = np.where(rising, low, middle), np.where(rising, middle, high)
    at = start + ((low + high) / 2)[..., None] * way
    return np.linalg.norm(at - np.clip(at, -half_mm, half_mm), axis=-1)


def between(robot: Manipulator, waypoints: np.ndarray, capsules: Sequence[Capsule]) -> np.ndarray:
    """Return the path (N, n): the waypoints (K, n), with positions between them so close that no end of a capsule moves
    by more than STEP_MM."""
    path = [waypoints[:1]]
    for start, end in pairwise(waypoints):
        coarse = start + np.linspace(0.0, 1.0, _COARSE)[:, None] * (end - start)
        moved = np.linalg.norm(np.diff(part_axes(robot, coarse, capsules), axis=0), axis=-1).sum(axis=0)
        steps = int(np.ceil(_CHORD * moved.max(initial=0.0) / STEP_MM)) or 1
        path.append(start + np.arange(1, steps + 1)[:, None] / steps * (end - start))
    return np.concatenate(path)


def part_axes(robot: Manipulator, path: np.ndarray, capsules: Sequence[Capsule]) -> np.ndarray:
    """Return the capsules' axes (N, P, 2, 3), MCS, at every position."""
    stages = robot.stages(path)
    home = robot.T_mcs_flange_home
    lines = np.empty((len(path), len(capsules), 2, 3))
    for index, capsule in enumerate(capsules):
        moved = stages[:, capsule.joints]
        lines[:, index] = home.apply(capsule.ends_mm) @ np.swapaxes(moved[:, :3, :3], 1, 2) + moved[:, None, :3, 3]
    return lines


def frame_capsules(robot: Manipulator) -> Iterable[Capsule]:
    """Yield capsules for the rims and diagonals of the Γ frame's plates, as mounted."""
    for distance, half in PLATES_MM:
        corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * half
        pa = np.column_stack([corners, np.full(4, distance)])
        for plate in (pa, pa[:, [2, 0, 1]]):  # across Z, across X
            on_flange = robot.T_flange_cfcs.apply(plate)
            for first, second in ((0, 1), (1, 2), (2, 3), (3, 0), (0, 2), (1, 3)):
                yield Capsule("frame", robot.arm_joints, on_flange[[first, second]], PLATE_RADIUS_MM)


def guide_capsules(robot: Manipulator) -> Iterable[Capsule]:
    """Yield the capsule of a guide, where the arm holds one."""
    if robot.guide_mm:
        ends = robot.T_flange_tool.apply([[0.0, 0.0, -robot.guide_mm], [0.0, 0.0, 0.0]])
        yield Capsule(GUIDE, robot.arm_joints, ends, GUIDE_RADIUS_MM)


def _limits(robot: Manipulator, path: np.ndarray) -> Check:
    beyond = robot.beyond_limits(path)
    worst = [int(np.argmax(np.abs(column))) for column in beyond.T]
    excesses = [
        robot.describe_excess(j, path[worst[j], j], beyond[worst[j], j])
        for j in range(robot.count)
        if beyond[worst[j], j]
    ]
    if excesses:
        return Check("joint limits", False, None, None, "", f"On its way {'; '.join(excesses)}: move the robot's base.")
    return Check("joint limits", True, None, None, "", "All joints stay within their limits.")


def _clearance(obstacle: str, boxes: list[Obstacle], parts: list[Capsule], lines: np.ndarray) -> Check:
    judged = [k for k, part in enumerate(parts) if (obstacle, part.name) != (PATIENT, GUIDE)]
    parts, lines = [parts[k] for k in judged], lines[:, judged]
    radius = np.array([part.radius_mm for part in parts])
    left = np.full(lines.shape[:2], np.inf)
    for box in boxes:
        inside = box.T_mcs_box.inv().apply(lines.reshape(-1, 3)).reshape(lines.shape)
        middle = inside.mean(axis=2)
        most = np.linalg.norm(middle - np.clip(middle, -box.half_mm, box.half_mm), axis=-1) - radius
        least = most - np.linalg.norm(inside[:, :, 1] - inside[:, :, 0], axis=-1) / 2
        near = least <= min(most.min(), left.min())  # no other segment can be the nearest
        exact = segment_to_box_mm(inside[near], box.half_mm) - np.broadcast_to(radius, near.shape)[near]
        left[near] = np.minimum(left[near], exact)
    left -= STEP_MM / 2  # any position is at most half a step from a checked one
    at, part = np.unravel_index(np.argmin(left), left.shape)
    nearest, share, name = float(left[at, part]), at / max(len(left) - 1, 1), f"{obstacle} clearance"
    states = f"The {parts[part].name} leaves {max(nearest, 0.0):.0f} mm to the {obstacle}, {share:.0%} of the way"
    otherwise = f", at least {CLEARANCE_MM:.0f} are needed: move the robot's base or the {obstacle}."
    return at_least(name, nearest, CLEARANCE_MM, "mm", states, otherwise=otherwise)


def _remount(surroundings: Surroundings) -> Check:
    repeat = surroundings.remount_mm
    if repeat is None:
        return Check("frame remount", True, None, None, "", "The frame was not taken off since its calibration.")
    states = f"The frame was taken off and repeats its place to {repeat:.2f} mm"
    otherwise = f", more than {REMOUNT_LIMIT_MM:g}: calibrate its mount again."
    return at_most("frame remount", repeat, REMOUNT_LIMIT_MM, "mm", states, otherwise=otherwise)


def _box(name: str, T_mcs_cfcs: RigidTransform, low_mm, high_mm) -> Obstacle:
    low, high = np.array(low_mm), np.array(high_mm)
    return Obstacle(name, T_mcs_cfcs * RigidTransform.from_translation((low + high) / 2), (high - low) / 2)
