"""The image as detection sees it: log intensity, continued beyond the field's edge."""

from functools import cache

import cv2
import numba as nb
import numpy as np

from sightline.imaging import Radiograph

_COARSE = 4  # px; what lies outside the field is filled at this coarseness
_EDGE = 5  # px, width of the square that takes the field's outermost two pixels away


def field_inset(image: Radiograph) -> np.ndarray:
    """(H, W) bool: the field without its outermost pixels, which may be mixed with what lies outside."""
    return cv2.erode(image.field_mask.view(np.uint8), np.ones((_EDGE, _EDGE), np.uint8)).view(bool)


def log_image(image: Radiograph, mask: np.ndarray) -> np.ndarray:
    """(H, W) float32: natural logarithm of the pixels, a zero taken for half a grey level; outside `mask` what a
    coarse pyramid of the inside holds nearest."""
    pixels = image.pixels
    if pixels.dtype == np.float32:
        logs = np.log(np.maximum(pixels, np.float32(max(float(image.white) * 2.0**-16, 1e-30))))
    else:
        logs = _looked_up(pixels, _logarithms(np.iinfo(pixels.dtype).max + 1))
    if not mask.all():
        _fill(logs, mask, _coarse_fill(logs[::_COARSE, ::_COARSE], mask[::_COARSE, ::_COARSE]))
    return logs


@cache
def _logarithms(count: int) -> np.ndarray:
    return np.log(np.maximum(np.arange(count), 0.5)).astype(np.float32)


def _coarse_fill(values: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """What is outside the mask from the nearest level of a masked pyramid that knows it."""
    weights: list[np.ndarray] = [mask.astype(np.float32)]
    sums: list[np.ndarray] = [np.where(mask, values, np.float32(0))]
    while min(sums[-1].shape) > 2:
        half = max(sums[-1].shape[1] // 2, 1), max(sums[-1].shape[0] // 2, 1)
        sums.append(cv2.resize(sums[-1], half, interpolation=cv2.INTER_AREA))
        weights.append(cv2.resize(weights[-1], half, interpolation=cv2.INTER_AREA))
    filled: np.ndarray = sums[-1] / np.maximum(weights[-1], 1e-6)
    for total, weight in zip(sums[-2::-1], weights[-2::-1], strict=True):
        coarse = cv2.resize(filled, total.shape[::-1], interpolation=cv2.INTER_LINEAR)
        filled = np.where(weight > 0.01, total / np.maximum(weight, 0.01), coarse)
    return filled


@nb.njit(parallel=True, cache=True)
def _looked_up(pixels, table):
    out = np.empty(pixels.shape, np.float32)
    for i in nb.prange(pixels.shape[0]):
        for j in range(pixels.shape[1]):
            out[i, j] = table[pixels[i, j]]
    return out


@nb.njit(parallel=True, cache=True)
def _fill(values, mask, coarse):
    for i in nb.prange(values.shape[0]):
        for j in range(values.shape[1]):
            if not mask[i, j]:
                values[i, j] = coarse[i // _COARSE, j // _COARSE]
