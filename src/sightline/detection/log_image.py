"""The log intensity of an image, extrapolated beyond the field's edge, as detection uses it."""

from functools import cache

import cv2
import numpy as np

from sightline.common.kernels import kernel
from sightline.common.threads import at_once
from sightline.imaging import Radiograph

_COARSE = 4  # px; outside the field, pixels are filled at this resolution
_KNOWN = 0.01  # smallest share of a pyramid's pixel inside the field
_EDGE = 5  # px, side of the square that erodes two pixels of the field


def field_inset(image: Radiograph) -> np.ndarray:
    """Return the field (H, W) bool without burnt-in annotations and without its outermost two pixels.

    The outermost pixels may be mixed with the outside.
    """
    inset = cv2.erode(image.field_mask.view(np.uint8), np.ones((_EDGE, _EDGE), np.uint8)).view(bool)
    return inset if image.burnt_in is None else inset & ~image.burnt_in


def in_discs(shape: tuple[int, ...], discs: np.ndarray) -> np.ndarray:
    """Return (H, W) bool: which pixels lie in `discs` (N, 3): u, v and radius, px."""
    inside = np.zeros(shape, np.uint8)
    for u, v, radius in np.rint(16 * discs).astype(int).tolist():  # cv2 draws to a sixteenth of a pixel
        cv2.circle(inside, (u, v), radius, 1, -1, cv2.LINE_8, 4)
    return inside > 0


def log_image(image: Radiograph, mask: np.ndarray) -> np.ndarray:
    """Return the natural logarithm (H, W) float32 of the pixels; zero counts as half a grey level.

    Pixels outside `mask` are filled from a coarse pyramid of the inside, burnt-in annotations from a fine one.
    """
    return _completed(_logs(image), mask, image.burnt_in)


def field_and_logs(image: Radiograph) -> tuple[np.ndarray, np.ndarray]:
    """Return `field_inset` and `log_image`, computed by two threads."""
    mask, logs = at_once(lambda: field_inset(image), lambda: _logs(image))
    return mask, _completed(logs, mask, image.burnt_in)


def _logs(image: Radiograph) -> np.ndarray:
    """Return the logarithms of the pixels; less than half a grey level counts as half of one."""
    if image.pixels.dtype == np.float32:
        return np.log(np.maximum(image.pixels, np.float32(max(float(image.white) * 2.0**-16, 1e-30))))
    pixels = image.pixels.astype(np.uint16, copy=False).view()
    pixels.flags.writeable = False  # as an image's own: the kernel is compiled for one type
    return _looked_up(pixels, _logarithms())


def _completed(logs: np.ndarray, mask: np.ndarray, written: np.ndarray | None) -> np.ndarray:
    """Fill `logs` outside `mask`; return them with `written` filled too."""
    if not mask.all():
        values, known = (np.ascontiguousarray(whole[::_COARSE, ::_COARSE]) for whole in (logs, mask))
        _fill(logs, mask, _extrapolated(values, known))
    if written is not None:
        logs = np.where(written, _extrapolated(logs, ~written), logs)
    return logs


@cache
def _logarithms() -> np.ndarray:
    return np.log(np.maximum(np.arange(2**16), 0.5)).astype(np.float32)


def _extrapolated(values: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Return `values` (H, W), the unknown ones from a pyramid of the known, and none above the largest known value.

    Averages round up: a pixel above the white level would make all clipped pixels look unclipped.
    """
    brightest = values.max(where=known, initial=-np.inf)
    return np.minimum(_filled(np.where(known, values, np.float32(0)), known.astype(np.float32)), brightest)


def _filled(total: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Return `total` over `weight` where that is known, elsewhere the half-size image, filled in the same way."""
    if max(total.shape) <= 2:
        return total / np.maximum(weight, np.float32(1e-6))
    half = (total.shape[1] + 1) // 2, (total.shape[0] + 1) // 2
    smaller = _filled(*(cv2.resize(values, half, interpolation=cv2.INTER_AREA) for values in (total, weight)))
    filled = cv2.resize(smaller, total.shape[::-1], interpolation=cv2.INTER_LINEAR)
    return np.divide(total, weight, out=filled, where=weight > _KNOWN)


@kernel(nogil=True)
def _looked_up(pixels, table):
    values = np.empty(pixels.shape, np.float32)
    for i in range(pixels.shape[0]):
        for j in range(pixels.shape[1]):
            values[i, j] = table[pixels[i, j]]
    return values


@kernel(nogil=True)
def _fill(values, mask, coarse):
    """Fill `values` outside `mask` from both ends of each row: the field is convex, so it is one run per row."""
    height, width = values.shape
    for i in range(height):
        first, last = 0, width
        while first < width and not mask[i, first]:
            values[i, first] = coarse[i // _COARSE, first // _COARSE]
            first += 1
        while last > first and not mask[i, last - 1]:
            last -= 1
            values[i, last] = coarse[i // _COARSE, last // _COARSE]
