"""Calibration frames as data."""

from sightline.frame.model import Frame
from sightline.frame.plate import Fiducial, FrameView, Plate
from sightline.frame.tolerances import InUse, Tolerances

__all__ = ["Fiducial", "Frame", "FrameView", "InUse", "Plate", "Tolerances"]
