"""Calibration frames as data."""

from sightline.frame.model import Fiducial, Frame, FrameView, InUse, Plate, Tolerances

__all__ = ["Fiducial", "Frame", "FrameView", "InUse", "Plate", "Tolerances"]
