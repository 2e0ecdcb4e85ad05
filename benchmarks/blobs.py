"""Peers that find dark blobs: OpenCV's SimpleBlobDetector and trackpy.locate."""

from collections.abc import Callable

import cv2
import numpy as np

Finder = Callable[[np.ndarray, float], np.ndarray]  # from pixels and their white to places (N, 2)


def opencv(**options: float) -> Finder:
    """Return SimpleBlobDetector, at 8 bit, with parameters by their names."""
    parameters = cv2.SimpleBlobDetector.Params()
    for name, value in options.items():
        setattr(parameters, name, value)
    detector = cv2.SimpleBlobDetector.create(parameters)

    def find(pixels: np.ndarray, white: float) -> np.ndarray:
        blobs = detector.detect(cv2.convertScaleAbs(pixels, alpha=255.0 / white))
        return np.array([blob.pt for blob in blobs]).reshape(-1, 2)

    return find


def trackpy(diameter: int, **options: float | bool) -> Finder:
    """Return trackpy.locate for blobs of a diameter, px."""
    import trackpy  # pyright: ignore[reportMissingImports]

    trackpy.quiet()

    def find(pixels: np.ndarray, _: float) -> np.ndarray:
        return trackpy.locate(pixels, diameter, invert=True, engine="numba", **options)[["x", "y"]].to_numpy()

    return find
