"""The digital twin: C-arm, intensifier, bones, X-ray projection. It never imports the software that it tests."""

from sightline.twin.anatomy.bone_model import BoneModel, drawn_aids, hip_aids
from sightline.twin.objects.things import Scene
from sightline.twin.scenes.bone_scene import BONES, BoneScene, shown_bone_scene
from sightline.twin.scenes.hard import BeadTruth, hard_scene
from sightline.twin.scenes.hip_scene import HipScene, hip_scene, shown_hip_scene, truth_document, write_truth
from sightline.twin.xray.render import DOSES, Dose, render
from sightline.twin.xray.setup import SetUp, Variation, ViewTruth, bead_images, draw_setup

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
