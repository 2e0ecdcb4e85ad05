"""A block on an arm's flange as points: its balls in the images of `BlockOnArm`, its true mount, and OpenCV's."""

import os
import subprocess
import sys
from collections.abc import Sequence
from io import BytesIO
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from sightline.calibration import CArm, calibrate
from sightline.calibration.solids.calibrate_together import adjustment_of
from sightline.calibration.solids.panel_camera import PanelCamera
from sightline.common.geometry.rigid import displacement, rigid_fit
from sightline.detection import Observations
from sightline.frame import Fiducial, Frame
from sightline.frame.designs import LARGE_MM
from sightline.rehearsal.arm_images import POSE_SD_MM, POSE_SD_RAD, VIEW, BlockOnArm
from sightline.twin.xray.setup import shadow_centres_px

SD = np.array([POSE_SD_RAD] * 3 + [POSE_SD_MM] * 3)
# The detector's own statement for the sample images [measured: `bench_arm_images`, rendered images]: s.d. per axis, px.
LARGE_PX, SMALL_PX = 0.040, 0.055


def is_large(ball: Fiducial) -> bool:
    """Return whether a ball of a block is one of the large ones."""
    return ball.diameter_mm == LARGE_MM


def c_arm(held: BlockOnArm) -> CArm:
    """Return what the images state of the C-arm."""
    chain = held.setup.views[VIEW].chain
    return CArm(chain.sdd_mm, chain.pitch_mm)


def centres_px(held: BlockOnArm, image: int) -> dict[str, np.ndarray]:
    """Return the true centre (2,) of each ball's shadow, px."""
    balls = held.setup.true_frame.fiducials
    xyz, radius = held.motion(image).apply(held.setup.true_frame.xyz_mm), np.array([b.diameter_mm / 2 for b in balls])
    return dict(zip(held.setup.frame.xyz_mm_by_id, shadow_centres_px(held.setup.views[VIEW], xyz, radius), strict=True))


def seen(held: BlockOnArm, rng: np.random.Generator) -> list[Observations]:
    """Return the balls of all images, with noise as the detector states it."""
    sd = np.array([LARGE_PX if is_large(ball) else SMALL_PX for ball in held.setup.frame.fiducials])
    images = []
    for k in range(len(held.stated)):
        true = centres_px(held, k)
        uv = np.array(list(true.values())) + sd[:, None] * rng.standard_normal((len(sd), 2))
        noise, shape = sd[:, None, None] ** 2 * np.eye(2), held.setup.views[VIEW].chain.shape
        images.append(Observations(f"image {k + 1}", tuple(true), uv, noise, image_shape=shape))
    return images


def true_mount(held: BlockOnArm) -> RigidTransform:
    """Return where the block's balls, as they are, fit its file best."""
    return held.mount * rigid_fit(held.setup.frame.xyz_mm, held.setup.true_frame.xyz_mm)


def error(true: RigidTransform, found: RigidTransform) -> tuple[np.ndarray, float, float]:
    """Return the error of a mount: as a twist (6,), flange coordinates; in the block's middle, mm; as an angle, °."""
    twist = (true * found.inv()).as_exp_coords()
    middle = displacement(found.translation) @ twist
    return twist, float(np.linalg.norm(middle)), float(np.rad2deg(np.linalg.norm(twist[:3])))


def own_poses(images: Sequence[Observations], frame: Frame, arm: CArm) -> list[RigidTransform]:
    """Return the pose of the block in the C-arm, by each image alone."""
    cameras = [adjustment_of(calibrate(each, frame, c_arm=arm)).cameras[0] for each in images]
    return [RigidTransform.from_components(c.translation_mm, Rotation.from_matrix(c.rotation)) for c in cameras]


def poses_by(images: Sequence[Observations], frame: Frame, camera: PanelCamera) -> list[RigidTransform]:
    """Return the pose of the block in the C-arm in each image, by a camera that is known."""
    inner = np.diag([camera.focal_px, camera.focal_px, 1.0])
    inner[:2, 2] = camera.centre_px
    poses = []
    for each in images:
        xyz = np.array([frame.xyz_mm_by_id[ball] for ball in each.ids])
        _, turn, shift = cv2.solvePnP(xyz, each.uv_px, inner, None, flags=cv2.SOLVEPNP_SQPNP)
        turn, shift = cv2.solvePnPRefineLM(xyz, each.uv_px, inner, None, turn, shift)
        poses.append(RigidTransform.from_components(shift.ravel(), Rotation.from_rotvec(turn.ravel())))
    return poses


OPENCV4 = Path("out/opencv4")  # made by `make bench`: OpenCV 5.0 has no calibrateRobotWorldHandEye for Python
_PROGRAM = """
import io, sys, cv2, numpy as np
flange, block = np.load(io.BytesIO(sys.stdin.buffer.read()))
method, split = int(sys.argv[1]), lambda poses: ([p[:3, :3] for p in poses], [p[:3, 3] for p in poses])
for to_base, to_camera in zip(flange, block):
    turn, shift, *_ = cv2.calibrateRobotWorldHandEye(*split(to_camera), *split(to_base), method=method)
    sys.stdout.write(" ".join(map(repr, np.column_stack([turn, shift]).ravel().tolist())) + "\\n")
"""
METHODS = {"Shah": 0, "Li": 1}  # as OpenCV numbers them


def mounts_of_opencv(flange: np.ndarray, block: np.ndarray, method: int) -> list[RigidTransform]:
    """Return the block on the flange (S) by OpenCV, from poses (S, N, 4, 4) of the flange in the base and of the block
    in the C-arm."""
    given = BytesIO()
    np.save(given, np.stack([flange, block]))
    paths = os.pathsep.join([str(OPENCV4.resolve()), os.environ.get("PYTHONPATH", "")])
    done = subprocess.run(
        [sys.executable, "-c", _PROGRAM, str(method)],
        input=given.getvalue(), capture_output=True, check=True, env={**os.environ, "PYTHONPATH": paths},
    )  # fmt: skip
    rows = np.array([line.split() for line in done.stdout.decode().splitlines()], dtype=float).reshape(-1, 3, 4)
    return [RigidTransform.from_matrix(np.vstack([row, [0.0, 0.0, 0.0, 1.0]])).inv() for row in rows]
