"""A bone's CT or mesh and calibrated views: what a view sees of it, and where it lies."""

from sightline.from_images.registration.bone import ScannedBone
from sightline.from_images.registration.register import read_volume, register_bone
from sightline.from_images.registration.render import render
from sightline.from_images.registration.result import BonePose
from sightline.from_images.registration.search import BoneStart

__all__ = ["BonePose", "BoneStart", "ScannedBone", "read_volume", "register_bone", "render"]
