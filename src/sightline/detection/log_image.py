"""The image as detection sees it: log intensity, continued beyond the field's edge."""

from functools import cache

import cv2
import numpy as np

from sightline.detection.compiled import exact
from sightline.imaging import Radiograph

_COARSE = 4  # px; what lies outside the field is filled at this coarseness
_KNOWN = 0.01  # share of a place of the pyramid that must lie in the field
_EDGE = 5  # px, width of the square that takes the field's outermost two pixels away


def field_inset(image: Radiograph) -> np.ndarray:
    """(H, W) bool: the field without what was written into it, and without its outermost pixels, which may be mixed
    with what lies outside."""
    inset = cv2.erode(image.field_mask.view(np.uint8), np.ones((_EDGE, _EDGE), np.uint8)).view(bool)
    return inset if image.burnt_in is None else inset & ~image.burnt_in


def log_image(image: Radiograph, mask: np.ndarray) -> np.ndarray:
    """(H, W) float32: natural logarithm of the pixels, a zero taken for half a grey level; outside `mask` what a
    coarse pyramid of the inside holds nearest, under what was written into the image what a fine one holds."""
    return logs_of(image, mask, image.burnt_in)


def logs_of(image: Radiograph, mask: np.ndarray, written: np.ndarray | None) -> np.ndarray:
    """`log_image`, where what is `written` into the image (H, W) is known from an image before."""
    pixels = image.pixels
    if pixels.dtype == np.float32:
        logs = np.log(np.maximum(pixels, np.float32(max(float(image.white) * 2.0**-16, 1e-30))))
    else:
        logs = _looked_up(pixels, _logarithms(np.iinfo(pixels.dtype).max + 1))
    if not mask.all():
        values, known = (np.ascontiguousarray(whole[::_COARSE, ::_COARSE]) for whole in (logs, mask))
        _fill(logs, mask, _filled(np.where(known, values, np.float32(0)), known.astype(np.float32)))
    if written is not None:
        known = ~written
        logs = np.where(known, logs, _filled(np.where(known, logs, np.float32(0)), known.astype(np.float32)))
    return logs


@cache
def _logarithms(count: int) -> np.ndarray:
    return np.log(np.maximum(np.arange(count), 0.5)).astype(np.float32)


def _filled(total: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """`total` over `weight` where that is known; elsewhere what the half-size image, filled likewise, holds there."""
    if max(total.shape) <= 2:
        return total / np.maximum(weight, np.float32(1e-6))
    half = (total.shape[1] + 1) // 2, (total.shape[0] + 1) // 2
    smaller = _filled(*(cv2.resize(values, half, interpolation=cv2.INTER_AREA) for values in (total, weight)))
    out = cv2.resize(smaller, total.shape[::-1], interpolation=cv2.INTER_LINEAR)
    return np.divide(total, weight, out=out, where=weight > _KNOWN)


@exact
def _looked_up(pixels, table):
    out = np.empty(pixels.shape, np.float32)
    for i in range(pixels.shape[0]):
        for j in range(pixels.shape[1]):
            out[i, j] = table[pixels[i, j]]
    return out


@exact
def _fill(values, mask, coarse):
    """The field is convex: in every row it is one run, and what lies beside it is filled from both ends."""
    height, width = values.shape
    for i in range(height):
        first, last = 0, width
        while first < width and not mask[i, first]:
            values[i, first] = coarse[i // _COARSE, first // _COARSE]
            first += 1
        while last > first and not mask[i, last - 1]:
            last -= 1
            values[i, last] = coarse[i // _COARSE, last // _COARSE]
