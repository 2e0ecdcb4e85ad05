"""Poses of an arm at which images of a block on its flange tell where the block is fixed."""

from collections.abc import Callable

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from sightline.common.geometry.rigid import fibonacci_sphere
from sightline.errors import RobotRefusedError, UnusableInputError

# Rotations about the second axis, rms [ours]: at 3° the block's place on the flange has an error of 0.5 mm, at 14°
# 0.09 mm (12 images, block60, an arm of 0.03 mm).
MIN_ROTATION = np.radians(5.0)
PROPOSED, ROTATION = 12, np.radians(30.0)  # [ours] 0.07 mm; wrists and cables allow it
_SMALLER = (1.0, 0.75, 0.5)  # shares of rotation and shift tried where the arm may not go further


def refuse_alike(poses: RigidTransform) -> None:
    """Raise RobotRefusedError for poses (N) of a flange that rotate about fewer than two axes.

    Rotated about one axis alone, the block leaves the same images wherever it sits along that axis.
    """
    rotations = poses.rotation
    turns = (rotations.mean().inv() * rotations).as_rotvec()
    first, second, _ = np.linalg.svd(turns, compute_uv=False) / np.sqrt(len(turns))
    if second < MIN_ROTATION:
        raise RobotRefusedError(
            f"the poses are too alike: the flange rotates by {np.degrees(first):.1f}° about one axis and by "
            f"{np.degrees(second):.1f}° about a second (rms; at least {np.degrees(MIN_ROTATION):.0f}°), which leaves "
            "open where the block is; rotate it by 20° to 40° about two axes or more"
        )


def propose_poses(
    start: RigidTransform,
    block_flange_mm: np.ndarray,
    reach_mm: float,
    count: int = PROPOSED,
    *,
    rotation: float = ROTATION,
    allowed: Callable[[RigidTransform], bool] | None = None,
) -> RigidTransform:
    """Return poses (N) of the flange in the base for the images that calibrate a block on it; N up to `count`, 8 to 15.

    `start`: a pose with the block in the middle of the image; `block_flange_mm` (3,): the block's middle, to 10 mm.
    It rotates by `rotation`, rad, about directions all over the sphere, and its middle moves by `reach_mm`, as the
    field allows (`solid_shape.offset_mm`). `allowed`: whether the arm can and may go to a pose; where it may not,
    rotation and shift are halved at most, else the pose is left out. Raises UnusableInputError, and RobotRefusedError
    where the poses left determine nothing.
    """
    if not 8 <= count <= 15:
        raise UnusableInputError(f"8 to 15 images determine the block on the flange, not {count}")
    directions = fibonacci_sphere(count)
    middle = start.apply(block_flange_mm)
    poses: list[RigidTransform] = []
    for axis, way in zip(directions, np.roll(directions, count // 2, axis=0), strict=True):
        for share in _SMALLER:
            turn = Rotation.from_rotvec(share * rotation * axis)
            shift = middle + share * reach_mm * way - turn.apply(middle)
            pose = RigidTransform.from_components(shift, turn) * start
            if allowed is None or allowed(pose):
                poses.append(pose)
                break
    if len(poses) < 8:
        raise RobotRefusedError(
            f"the arm may go to {len(poses)} of {count} poses; 8 are needed: begin where it has more space to rotate"
        )
    proposed = RigidTransform.concatenate(poses)
    refuse_alike(proposed)
    return proposed
