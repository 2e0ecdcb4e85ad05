"""Calibration frames as data."""

from sightline.frame.model import Fiducial, Frame, FrameView, Plate, Tolerances

__all__ = ["Fiducial", "Frame", "FrameView", "Plate", "Tolerances"]
