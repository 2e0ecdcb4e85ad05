"""A bone's CT or mesh and calibrated views: what a view sees of it, and where it lies."""

from sightline.from_images.registration.bone import Bone
from sightline.from_images.registration.face import read_volume, register_bone
from sightline.from_images.registration.render import render
from sightline.from_images.registration.result import BonePose
from sightline.from_images.registration.search import Start

__all__ = ["Bone", "BonePose", "Start", "read_volume", "register_bone", "render"]
