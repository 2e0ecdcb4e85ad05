"""Fit of a plane map to controls in one plane, without a frame: distortion grids and perforated plates."""

from typing import Literal

import numpy as np

from sightline.calibration.maps.hull import refuse_collinear
from sightline.calibration.maps.localized import LocalizedMap
from sightline.calibration.maps.polynomial import PolynomialMap
from sightline.calibration.maps.smooth import FittedSmoothMap
from sightline.calibration.view import PlaneMap
from sightline.common.threads import one_blas_thread
from sightline.errors import CalibrationRefusedError, UnusableInputError

Method = Literal["smooth", "polynomial", "localized"]
METHODS: tuple[Method, ...] = ("smooth", "polynomial", "localized")


@one_blas_thread
def fit_map(
    uv_px: np.ndarray, xy_mm: np.ndarray, method: Method = "smooth", noise_px: float | None = None, degree: int = 3
) -> PlaneMap:
    """Return the map between an image and a plane, fitted to controls: pixels (N, 2), plane coordinates (N, 2), mm.

    `noise_px`: standard deviation of the controls' pixels per axis, used by "smooth". None: estimated from the
    residuals, for a wrong value costs more: 0.1 px stated for a noise of 0.3 px overfits. `degree`: of "polynomial".
    Raises UnusableInputError, CalibrationRefusedError.

    >>> xy_mm = np.stack(np.meshgrid(np.arange(0.0, 80.0, 10.0), np.arange(0.0, 80.0, 10.0)), axis=-1).reshape(-1, 2)
    >>> uv_px = 5.0 * xy_mm + 0.001 * xy_mm**2 + 100.0
    >>> plane_map = sl.fit_map(uv_px, xy_mm, method="polynomial")
    >>> plane_map.to_plane(np.array([[300.0, 300.0]])).round(2)
    array([[39.69, 39.69]])
    """
    refuse_unknown_method(method)
    uv, xy = (np.asarray(a, dtype=np.float64) for a in (uv_px, xy_mm))
    if uv.ndim != 2 or uv.shape[1] != 2 or uv.shape != xy.shape:
        raise UnusableInputError(f"controls have the shapes {uv.shape} and {xy.shape}; give (N, 2) for both")
    if not (np.isfinite(uv).all() and np.isfinite(xy).all()):
        raise UnusableInputError("some controls are not finite; leave out what was not measured")
    if len(uv) < 3:
        raise CalibrationRefusedError(f"{len(uv)} controls given; give at least three, which every method needs")
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
    """Raise UnusableInputError, with the valid choices, for an unknown method."""
    if method not in METHODS:
        raise UnusableInputError(f"unknown method {method!r}; choose one of: {', '.join(METHODS)}")
