"""Phantoms: the paper's Perspex object and plastic femur, a pig's femur; and a fracture for any hip."""

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import RigidTransform

from sightline.twin.carm import SetUp
from sightline.twin.femur import BONE_PER_HU, Femur, to_cfcs, voxelise
from sightline.twin.motion import moved
from sightline.twin.scene import TEST_BALL_RADIUS_MM, TEST_BALLS_MM, HipScene
from sightline.twin.things import Ball, Box, Scene, SoftTissue, frame_scene
from sightline.twin.volumes import bored, fractured

PERSPEX_MM = np.array([60.0, 60.0, 50.0])  # size of the block with the four balls [ours]
PLASTIC_BORE_MM = 8.0  # diameter [paper]
FOAM_SHARE = 0.14  # polyurethane foam of 0.27 g/cm³ over glass-filled epoxy of 1.64, at 60 keV [calc]
# A pig of 100 kg: head of 34 mm, short neck, stout shaft [mem].
PIG = Femur(
    head_radius_mm=17.0,
    neck_radius_mm=13.0,
    neck_length_mm=36.0,
    neck_shaft_deg=132.0,
    shaft_radius_mm=13.0,
    canal_radius_mm=6.5,
    socket=False,
)
PIG_FLESH = SoftTissue(centre_mm=(20.0, 0.0), half_mm=(80.0, 65.0))  # [ours]
FRACTURE_SITE = 0.25  # share of the neck's length from the shaft's axis: trochanteric, the most common site [paper]


def perspex_object(at_mm: ArrayLike = (0.0, 0.0, 0.0)) -> tuple[Scene, np.ndarray]:
    """Return the paper's calibration object at a point (3,), CFCS, four independent balls in a Perspex block, and their
    centres (4, 3) mm."""
    balls_mm = np.asarray(at_mm) + TEST_BALLS_MM
    block = Box(balls_mm.mean(axis=0), np.eye(3), PERSPEX_MM / 2)
    balls = tuple(Ball((float(x), float(y), float(z)), TEST_BALL_RADIUS_MM) for x, y, z in balls_mm)
    return Scene(solids=balls, boxes=(block,)), balls_mm


def plastic_hip(setup: SetUp, femur: Femur | None = None) -> HipScene:
    """Return the paper's trial: a bare plastic femur with a bore of 8 mm along its ideal wire, whose middle lies at the
    hip's place.

    The femur is a shell of glass-filled epoxy in place of the cortex, filled with foam.
    """
    femur = replace(femur or Femur(), socket=False, cancellous_hu=FOAM_SHARE / BONE_PER_HU)
    head = setup.hip_mm - np.mean(to_cfcs(np.stack(femur.wire_mm()), setup.side, np.zeros(3)), axis=0)
    wire = to_cfcs(np.stack(femur.wire_mm()), setup.side, head)
    whole = replace(voxelise(femur, setup.side, head, None), material="composite", within=None)
    along = (wire[1] - wire[0]) / np.linalg.norm(wire[1] - wire[0])
    bore = bored(whole, np.stack([wire[0] - 5.0 * along, wire[1]]), PLASTIC_BORE_MM)  # start outside the surface
    return HipScene.of(frame_scene(setup.true_frame), Scene(volumes=(bore,)), femur, setup.side, head)


def porcine_hip(setup: SetUp, rng: np.random.Generator) -> HipScene:
    """Return the trials that the paper plans: a pig's femur in soft tissue, with the wire's middle at the hip's place.

    The femur has the human shape at a pig's sizes, so its trochanters are too large.
    """
    head = setup.hip_mm - np.mean(to_cfcs(np.stack(PIG.wire_mm()), setup.side, np.zeros(3)), axis=0)
    bone = Scene(volumes=(voxelise(PIG, setup.side, head, rng),))
    still = frame_scene(setup.true_frame) + Scene(tissue=PIG_FLESH.around(setup.hip_mm))
    return HipScene.of(still, bone, PIG, setup.side, head)


def broken(hip: HipScene, side: str, gap_mm: float = 1.0, motion: RigidTransform | None = None) -> HipScene:
    """Return a hip with a fracture across the base of its neck; `motion` displaces the shaft against head and wire.

    The bone must be the single volume of `hip_scene`, `plastic_hip` or `porcine_hip`, at rest.
    """
    (bone,) = hip.bone.volumes
    along = to_cfcs(hip.femur.towards_head, side, np.zeros(3))
    at = to_cfcs((1 - FRACTURE_SITE) * hip.femur.base_mm, side, hip.head_mm)
    shaft, head = fractured(bone, at, along, gap_mm)
    return replace(hip, bone=replace(hip.bone, volumes=(shaft if motion is None else moved(shaft, motion), head)))
