"""Calibration of a view: plane maps, focal point, calibrated views and their checks."""

from sightline.calibration.bead_view import BeadView, CalibrationInputs
from sightline.calibration.calibrate import calibrate
from sightline.calibration.lengths import BallSize, CArm
from sightline.calibration.maps.fit_map import fit_map
from sightline.calibration.matrix_view import MatrixView, view_from_matrix
from sightline.calibration.plates.setup_aid import SetupAdvice, advise
from sightline.calibration.solids.calibrate_together import calibrate_together
from sightline.calibration.view import CalibratedView, LinesOfSight, PlaneMap, Residuals

__all__ = [
    "BallSize",
    "BeadView",
    "CArm",
    "CalibratedView",
    "CalibrationInputs",
    "LinesOfSight",
    "MatrixView",
    "PlaneMap",
    "Residuals",
    "SetupAdvice",
    "advise",
    "calibrate",
    "calibrate_together",
    "fit_map",
    "view_from_matrix",
]
