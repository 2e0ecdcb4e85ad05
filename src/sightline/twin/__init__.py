"""The digital twin: C-arm, intensifier, bones, X-ray projection. It never imports the software that it tests."""

from sightline.twin.bone_scene import BONES, BoneScene, shown_bone_scene
from sightline.twin.bones import BoneModel
from sightline.twin.carm import SetUp, Variation, ViewTruth, bead_images, draw_setup
from sightline.twin.drawn_aids import drawn_aids, hip_aids
from sightline.twin.hard import BeadTruth, hard_scene
from sightline.twin.render import DOSES, Dose, render
from sightline.twin.scene import HipScene, hip_scene, shown_hip_scene
from sightline.twin.things import Scene
from sightline.twin.truth import truth_document, write_truth

__all__ = [
    "BONES",
    "DOSES",
    "BeadTruth",
    "BoneModel",
    "BoneScene",
    "Dose",
    "HipScene",
    "Scene",
    "SetUp",
    "Variation",
    "ViewTruth",
    "bead_images",
    "draw_setup",
    "drawn_aids",
    "hard_scene",
    "hip_aids",
    "hip_scene",
    "render",
    "shown_bone_scene",
    "shown_hip_scene",
    "truth_document",
    "write_truth",
]
