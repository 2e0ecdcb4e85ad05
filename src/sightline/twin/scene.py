"""Scenes: the demo's hip inside a frame, and hard ones for judging detection."""

from dataclasses import dataclass

import numpy as np

from sightline.twin.carm import SetUp
from sightline.twin.femur import Femur, SoftTissue, draw_femur, to_cfcs, voxelise
from sightline.twin.render import Scene
from sightline.twin.things import Ball, Point, frame_boxes, frame_solids

HEAD_SD_MM = 4.0  # of the centre of the head about the origin of CFCS, per axis [ours]
TEST_BALLS_MM = np.array(
    [[-18.0, -16.0, -12.0], [20.0, -12.0, 14.0], [-14.0, 20.0, 16.0], [16.0, 18.0, -15.0]]
)  # [ours]
TEST_BALL_RADIUS_MM = 1.5  # [ours]


def _point(xyz: np.ndarray) -> Point:
    return float(xyz[0]), float(xyz[1]), float(xyz[2])


@dataclass(frozen=True, eq=False)
class HipScene:
    """A hip in the frame. `entry_mm`, `end_mm` (3,): the ideal wire of `Femur.wire_mm`, CFCS; `head_mm` (3,)."""

    scene: Scene
    femur: Femur
    head_mm: np.ndarray
    entry_mm: np.ndarray
    end_mm: np.ndarray


def hip_scene(setup: SetUp, rng: np.random.Generator, femur: Femur | None = None) -> HipScene:
    """The set-up's true frame around a hip; the femur is drawn unless given."""
    femur = femur or draw_femur(rng)
    head = rng.normal(0.0, HEAD_SD_MM, 3)
    entry, end = (to_cfcs(p, setup.side, head) for p in femur.wire_mm())
    scene = Scene(
        solids=frame_solids(setup.true_frame),
        boxes=frame_boxes(setup.true_frame),
        bone=voxelise(femur, setup.side, head, rng),
        tissue=SoftTissue(),
    )
    return HipScene(scene, femur, head, entry, end)


def test_object(setup: SetUp) -> tuple[Scene, np.ndarray]:
    """The paper's calibration object: four balls in the frame at (4, 3) mm CFCS, neither bone nor tissue."""
    balls = tuple(Ball(_point(xyz), TEST_BALL_RADIUS_MM) for xyz in TEST_BALLS_MM)
    frame = setup.true_frame
    return Scene(solids=frame_solids(frame) + balls, boxes=frame_boxes(frame)), TEST_BALLS_MM
