"""A simulated block on the flange of an arm before a flat panel at rest: images at the poses that are proposed."""

import json
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from sightline.common.atomic import write_whole
from sightline.frame import Frame, Tolerances
from sightline.frame.solid_shape import FIELDS_MM, offset_mm
from sightline.imaging import Radiograph, write_dicom
from sightline.robot.kinematics.by_images import propose_poses
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


def write_arm_images(folder: Path, seed: int) -> Path:
    """Write sample images, block and list for `sightline robot calibrate --from-images`; return the list's file."""
    rng, block = np.random.default_rng(seed), sample_block()
    held = BlockOnArm.draw(rng, block)
    folder.mkdir(parents=True, exist_ok=True)
    block.save(folder / "block.json")
    images = []
    for k, pose in enumerate(held.stated):
        name = f"image-{k + 1:02d}.dcm"
        write_dicom(held.image(k, rng), folder / name, SIDE)
        images.append({"file": name, "T_base_flange": pose.as_matrix().tolist()})
    listed = {
        "schema": "sightline-arm-images/1",
        "robot_serial": "simulated",
        "frame": "block.json",
        "measured_on": datetime.now(UTC).isoformat(timespec="seconds"),
        "pose_sd": {"mm": POSE_SD_MM, "rad": POSE_SD_RAD},
        "images": images,
    }
    return write_whole(folder / "images.json", json.dumps(listed, indent=1).encode())
