"""Detection on ARCADIS images, and the peers that other benchmarks of detection measure beside it."""

from pathlib import Path

import cv2
import numpy as np

from benchmarks.rows import Row
from sightline.detection import detect
from sightline.imaging import Radiograph, read_image

_DATA = Path(__file__).parents[3] / "shared" / "data" / "arcadis"
_BEADS = ("beads_0", "beads_orbit30", "beads_orbit60", "beads_spine_0")
_PLATES = ("plate_0", "plate_orbit30", "plate_orbit60")


def run(quick: bool) -> list[Row]:
    """Rows of the table; there are too few images for `quick` to leave any out."""
    return _arcadis()


def blobs_of_opencv(image: Radiograph) -> np.ndarray:
    """Dark blobs of 2-25 px radius by SimpleBlobDetector, at 8 bit, thresholds 10 apart."""
    parameters = cv2.SimpleBlobDetector.Params()
    parameters.minArea, parameters.maxArea = np.pi * 4, np.pi * 625
    parameters.minThreshold, parameters.maxThreshold, parameters.thresholdStep = 10, 250, 10
    parameters.minDistBetweenBlobs = 5
    pixels = cv2.convertScaleAbs(image.pixels, alpha=255.0 / image.white)
    return np.array([k.pt for k in cv2.SimpleBlobDetector.create(parameters).detect(pixels)]).reshape(-1, 2)


def blobs_of_trackpy(image: Radiograph) -> np.ndarray:
    """Dark blobs by trackpy.locate at the diameter of the smaller balls (19 px)."""
    import trackpy  # pyright: ignore[reportMissingImports]

    trackpy.quiet()
    frame = trackpy.locate(image.pixels.astype(np.float64), 19, invert=True, engine="numba", characterize=False)
    return frame[["x", "y"]].to_numpy()


def _arcadis() -> list[Row]:
    if not _DATA.is_dir():
        return [Row("detection", "ARCADIS images: absent, skipped", "")]
    rows = []
    for name in _BEADS:
        found = detect(read_image(_DATA / f"{name}.dcm"))
        size = found.radius_px / np.median(found.radius_px)
        small, large = int((abs(size - 1) < 0.15).sum()), int(((size > 1.4) & (size < 2)).sum())
        value = f"{small} small + {large} large + {len(found) - small - large} of no ball's size"
        met = (small, large, len(found)) == (16, 2, 18)
        rows.append(Row("detection", name, value, "16 small + 2 large, no other", met=met))
    for name in _PLATES:
        found = detect(read_image(_DATA / f"{name}.dcm"))
        holes = found.kind.count("hole")
        rows.append(Row("detection", name, f"{holes} holes", ">= 3500", met=holes >= 3500))
    return rows
