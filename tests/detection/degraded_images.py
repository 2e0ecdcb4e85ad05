"""Images degraded by export, compression and defects."""

import cv2
import numpy as np

from sightline.imaging import Radiograph


def in_8_bits(image: Radiograph) -> np.ndarray:
    return np.rint(image.pixels * (255 / image.white)).astype(np.uint8)


def jpeg(pixels: np.ndarray, quality: int) -> np.ndarray:
    return cv2.imdecode(jpeg_bytes(pixels, quality), cv2.IMREAD_UNCHANGED)


def jpeg_bytes(pixels: np.ndarray, quality: int) -> np.ndarray:
    return cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, quality])[1]


def levels(pixels: np.ndarray, count: int) -> np.ndarray:
    """Return pixels with `count` grey levels."""
    step = 256 // count
    return (pixels // step * step).astype(np.uint8)


def banded(pixels: np.ndarray, rows: int) -> np.ndarray:
    """Return pixels with a constant band in the middle."""
    out, top = pixels.copy(), (len(pixels) - rows) // 2
    out[top : top + rows] = 128
    return out


def blocks(pixels: np.ndarray, side: int) -> np.ndarray:
    """Return pixels that are constant in blocks."""
    height, width = pixels.shape
    small = cv2.resize(pixels, (width // side, height // side), interpolation=cv2.INTER_AREA)
    return cv2.resize(small, (width, height), interpolation=cv2.INTER_NEAREST)


def torn(pixels: np.ndarray, at: int, shift: int) -> np.ndarray:
    """Return pixels shifted to the right from row `at` on."""
    out = pixels.copy()
    out[at:] = np.roll(out[at:], shift, axis=1)
    return out


def interlaced(pixels: np.ndarray, down: int, right: int) -> np.ndarray:
    """Return pixels with every second line from a displaced image."""
    out = pixels.copy()
    out[1::2] = np.roll(pixels, (down, right), axis=(0, 1))[1::2]
    return out
