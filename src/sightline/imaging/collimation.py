"""The field of view: what of an image the X-rays reach through the collimator."""

import cv2
import numpy as np

from sightline.imaging.radiograph import Radiograph


def field_mask(radiograph: Radiograph) -> np.ndarray:
    """(H, W) bool, True inside the collimation."""
    small = cv2.resize(radiograph.pixels, None, fx=0.25, fy=0.25, interpolation=cv2.INTER_AREA)
    bright = (small > 0.02 * np.percentile(small, 95)).astype(np.uint8)
    count, labels, stats, _ = cv2.connectedComponentsWithStats(bright)
    if count < 2:
        return np.ones(radiograph.shape, dtype=bool)
    body = (labels == 1 + np.argmax(stats[1:, cv2.CC_STAT_AREA])).astype(np.uint8)
    outline = max(cv2.findContours(body, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)[0], key=len)
    hull = cv2.fillConvexPoly(np.zeros_like(body), cv2.convexHull(outline), 1)
    mask = cv2.resize(hull, radiograph.shape[::-1], interpolation=cv2.INTER_NEAREST).astype(bool)
    mask.flags.writeable = False
    return mask
