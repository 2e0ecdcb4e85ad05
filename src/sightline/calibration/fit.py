"""A plane map through controls of one plane, without a frame: distortion grids and perforated plates."""

from typing import Literal

import numpy as np

from sightline.calibration.hull import refuse_collinear
from sightline.calibration.localized import LocalizedMap
from sightline.calibration.polynomial import PolynomialMap
from sightline.calibration.smooth import FittedSmoothMap
from sightline.calibration.view import PlaneMap
from sightline.errors import CalibrationRefusedError, UnusableInputError

Method = Literal["smooth", "polynomial", "localized"]
METHODS: tuple[Method, ...] = ("smooth", "polynomial", "localized")


def fit_map(
    uv_px: np.ndarray, xy_mm: np.ndarray, method: Method = "smooth", noise_px: float | None = None, degree: int = 3
) -> PlaneMap:
    """The map between an image and a plane through controls: pixels (N, 2), plane coordinates (N, 2), mm.

    `noise_px`: standard deviation of the controls' pixels per axis ("smooth" weighs by it); None: it is estimated from
    the residuals [ours], since a wrong one costs more: 0.1 px stated of 0.3 px overfits. `degree` of "polynomial".
    Raises UnusableInputError, CalibrationRefusedError.
    """
    refuse_unknown_method(method)
    uv, xy = (np.asarray(a, dtype=np.float64) for a in (uv_px, xy_mm))
    if uv.ndim != 2 or uv.shape[1] != 2 or uv.shape != xy.shape:
        raise UnusableInputError(f"controls have the shapes {uv.shape} and {xy.shape}; (N, 2) twice was expected")
    if not (np.isfinite(uv).all() and np.isfinite(xy).all()):
        raise UnusableInputError("controls hold values that are not finite; leave out what was not measured")
    if len(uv) < 3:
        raise CalibrationRefusedError(f"{len(uv)} controls given; every method needs at least three")
    if noise_px is not None and not noise_px > 0:
        raise UnusableInputError(f"noise_px is {noise_px}; give a standard deviation above zero, or None if unknown")
    refuse_collinear(uv, "in the image, the controls")
    refuse_collinear(xy, "on the plane, the controls")
    if method == "localized":
        return LocalizedMap.fit(uv, xy)
    if method == "polynomial":
        return PolynomialMap.fit(uv, xy, degree)
    return FittedSmoothMap.fit(uv, xy, noise_px)


def refuse_unknown_method(method: str) -> None:
    """Raises UnusableInputError, naming the valid choices."""
    if method not in METHODS:
        raise UnusableInputError(f"there is no method {method!r}; choose one of: {', '.join(METHODS)}")
