"""Calibration frames as data."""

from sightline.frame.model import Frame
from sightline.frame.plate import Fiducial, FrameView, Plate, RigidBody
from sightline.frame.tolerances import InUse, Tolerances

__all__ = ["Fiducial", "Frame", "FrameView", "InUse", "Plate", "RigidBody", "Tolerances"]
