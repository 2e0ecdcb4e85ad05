"""The digital twin: C-arm, intensifier, femur, X-ray projection. It never imports what it judges."""

from sightline.twin.carm import SetUp, Variation, ViewTruth, bead_images, draw_setup

__all__ = ["SetUp", "Variation", "ViewTruth", "bead_images", "draw_setup"]
