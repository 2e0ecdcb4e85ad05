"""Simulated measurements on arms: images of a block on a flange, before a flat panel at rest, and a tracker's."""

import json
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from sightline.common.atomic import write_whole
from sightline.frame import Frame, Tolerances
from sightline.frame.solid_shape import FIELDS_MM, offset_mm
from sightline.imaging import Radiograph, write_dicom
from sightline.rehearsal.operation import calibrated_robot, true_manipulator
from sightline.robot.kinematics.by_images import propose_poses
from sightline.robot.kinematics.designs import six_axis
from sightline.robot.kinematics.manipulator import Manipulator
from sightline.twin import SetUp, Variation, draw_setup, render
from sightline.twin.objects.things import frame_scene, moved
from sightline.twin.scenes.specimens import tagged
from sightline.twin.xray.distributions import SolidPlace
from sightline.twin.xray.setup import BEAMS

VIEW, SIDE = "pa", "right"  # any one
# Errors of the arm's poses, 1 s.d. [ours]: repeatability as makers state it, and what it is at the flange's rotation.
POSE_SD_MM, POSE_SD_RAD = 0.03, 1e-4
BALL_MM = 0.05  # [ours] of a block that was drilled, not measured
# The flange at the start, and the block's middle on it as drawn; the block is fixed 2 mm and 2° off [ours].
START = RigidTransform.from_components([450.0, -120.0, 400.0], Rotation.from_rotvec([np.pi, 0.0, 0.0]))
DRAWN_MM, FIXED_SD = np.array([0.0, 45.0, 60.0]), np.array([np.radians(2.0)] * 3 + [2.0] * 3)
# A tracker's error of one coordinate, 1 s.d., what it looks at, and the feeds, mm [ours].
TRACKER_MM, TRACKED = 0.03, 20
TARGETS_MM = np.array([[40.0, 10.0, -20.0], [-35.0, 25.0, 30.0], [5.0, -50.0, 60.0]])
FEEDS_MM = [0.0, 50.0, 110.0, 180.0, 240.0]


def sample_block() -> Frame:
    """Return the block of the sample images."""
    stated = Tolerances(BALL_MM, 0.0, 0.0, 0.0, 0.0)
    return replace(Frame.load("block60"), serial="SN-7", tolerances=stated)


@dataclass(frozen=True, eq=False)
class BlockOnArm:
    """A block on a flange. `setup`: the C-arm, CFCS as the block stands at START; `mount`: CFCS to flange; `stated`
    (N): poses of the flange as the arm tells them; `true` (N): as they are."""

    setup: SetUp
    mount: RigidTransform
    stated: RigidTransform
    true: RigidTransform

    @staticmethod
    def draw(rng: np.random.Generator, frame: Frame) -> "BlockOnArm":
        """Draw C-arm, block, mount, and the errors of the proposed poses. Raises SetUpError."""
        # Half of the field that is free, since the block stands up to 10 mm off the beam's axis.
        reach_mm = offset_mm(frame.bodies[0], FIELDS_MM["30 cm panel"]) / 2
        stated = propose_poses(START, DRAWN_MM, reach_mm)
        at_block = Variation(place=SolidPlace(aim=1.0))
        setup = draw_setup(rng, frame, variation=at_block, views={VIEW: BEAMS[VIEW]})
        fixed = RigidTransform.from_exp_coords(FIXED_SD * rng.standard_normal(6))
        sd = np.array([POSE_SD_RAD] * 3 + [POSE_SD_MM] * 3)
        true = stated * RigidTransform.from_exp_coords(sd * rng.standard_normal((len(stated), 6)))
        return BlockOnArm(setup, RigidTransform.from_translation(DRAWN_MM) * fixed, stated, true)

    def motion(self, image: int) -> RigidTransform:
        """Return how the block moved from START to an image, CFCS."""
        return (START * self.mount).inv() * self.true[image] * self.mount

    def image(self, image: int, rng: np.random.Generator) -> Radiograph:
        """Draw a radiograph."""
        scene = moved(frame_scene(self.setup.true_frame), self.motion(image))
        return tagged(self.setup, VIEW, render(self.setup, VIEW, scene, rng))


def tracker_measurements(true: Manipulator, own_mm: np.ndarray, rng: np.random.Generator) -> dict[str, Any]:
    """Return what a person measures on an arm with a tracker: the parts of `Measurements`, as JSON types. `own_mm`
    (N, 3): balls of the frame, CFCS."""
    q = rng.uniform(0.8 * true.lower, 0.8 * true.upper, (TRACKED, true.count))
    targets = np.stack([true.T_mcs_flange(q).apply(place) for place in TARGETS_MM], axis=1)
    tips = true.T_flange_tool.apply(np.outer(FEEDS_MM, [0.0, 0.0, 1.0]))

    def noisy(points: np.ndarray) -> list[Any]:
        return (points + TRACKER_MM * rng.standard_normal(points.shape)).tolist()

    return {
        "axes": {"sd_mm": TRACKER_MM, "q": q.tolist(), "targets_mm": noisy(targets)},
        "frame": {"sd_mm": TRACKER_MM, "own_mm": own_mm.tolist(), "flange_mm": noisy(true.T_flange_cfcs.apply(own_mm))},
        "wire": {"sd_mm": TRACKER_MM, "feed_mm": FEEDS_MM, "tip_flange_mm": noisy(tips)},
    }


def write_samples(folder: Path, seed: int) -> list[Path]:
    """Write sample measurements for `sightline robot calibrate`, and return the files' names: a tracker's of the
    manipulator with its frame (`measured.json`, `frame.json`), images of a block on a six-axis arm with their list
    (`images.json`, `block.json`), and what is measured beside the mount that comes of them (`by-images.json`)."""
    rng, block, arm = np.random.default_rng(seed), sample_block(), six_axis()
    held = BlockOnArm.draw(rng, block)
    folder.mkdir(parents=True, exist_ok=True)
    gamma = replace(Frame.load("gamma"), serial=block.serial)
    block.save(folder / "block.json")
    gamma.save(folder / "frame.json")
    now = datetime.now(UTC).isoformat(timespec="seconds")
    images: list[dict[str, Any]] = []
    q = np.zeros(arm.count)
    for k, pose in enumerate(held.stated):
        name, q = f"image-{k + 1:02d}.dcm", arm.inverse_pose(pose * arm.T_flange_tool, q)
        write_dicom(held.image(k, rng), folder / name, SIDE)
        images.append({"file": name, "q": q.tolist()})
    robot = {"robot_serial": "simulated", "measured_on": now}
    pose_sd = {"mm": POSE_SD_MM, "rad": POSE_SD_RAD}
    listed = {**robot, "schema": "sightline-arm-images/1", "frame": "block.json", "arm": "six-axis", "pose_sd": pose_sd}
    head = {**robot, "schema": "sightline-robot-measurements/1", "frame_serial": block.serial, "side": SIDE}
    tracked = tracker_measurements(true_manipulator(calibrated_robot(SIDE), rng), gamma.xyz_mm, rng)
    guide = tracker_measurements(arm, block.xyz_mm, rng)["wire"]
    files = {
        "measured.json": {**head, **tracked},
        "images.json": {**listed, "images": images},
        "by-images.json": {**head, "arm": "six-axis", "frame": {"mount": "mount.json"}, "wire": guide},
    }
    return [write_whole(folder / name, json.dumps(content, indent=1).encode()) for name, content in files.items()]
