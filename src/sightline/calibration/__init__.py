"""Plane maps, the focal point, calibrated views."""

from sightline.calibration.view import CalibratedView, LinesOfSight, PlaneMap

__all__ = ["CalibratedView", "LinesOfSight", "PlaneMap"]
