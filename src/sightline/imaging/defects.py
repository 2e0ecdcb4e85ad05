"""Defects that an image's own pixels show: lines that do not belong together, clipped pixels, compression."""

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.ndimage import median_filter

from sightline.checks import Check
from sightline.imaging.interlace import MOVED, comb
from sightline.imaging.radiograph import Radiograph

_RIM_PX = 12  # from the field's edge, where lines differ by nature [ours]
_AROUND = 24  # lines to either side that say how far lines usually differ [ours]
_STEP = 2.5  # times as much that a line must differ from the next: blurred noise alone makes 3.7 at a tear [calc]
_SHARE = 0.5  # of an image's width that a line must have in the field [ours]
_FARTHEST_PX, _NEAREST_PX = 64, 2  # shifts that are looked for; smaller ones are within a bead's blur [ours]
_EXPLAINED = 2.0  # times less that lines differ once shifted: below 1.3 in 28 whole images [twin, ARCADIS, XA]
_LINES = 5  # that are looked at
MOST_CLIPPED = 50.0  # % of the field; air beside the patient clips up to 32 % in images of the twin [ours]


@dataclass(frozen=True)
class Tear:
    """From line `at` on the image is shifted by `shift_px` along its lines; `rows`: these are rows, not columns."""

    at: int
    shift_px: int
    rows: bool

    @property
    def sentence(self) -> str:
        """What is wrong, and what to do."""
        line, along = ("row", "columns") if self.rows else ("column", "rows")
        return (
            f"the image is torn: from {line} {self.at} on it is shifted by {abs(self.shift_px)} {along}; its parts "
            "show different moments: take it again"
        )


def interlaced(image: Radiograph) -> str | None:
    """What is wrong with an image between whose two fields something moved, and what to do; None where nothing did."""
    if 100 * clipped_share(image) > MOST_CLIPPED:
        return None  # lines that are clipped have nothing to compare
    moved = comb(image)
    if moved <= MOVED:
        return None
    return (
        f"the image is interlaced and something moved between its two fields (comb {moved:.2f}, at most {MOVED:g}); "
        "take it again without movement, or from a progressive source"
    )


def torn(image: Radiograph) -> Tear | None:
    """The tear whose two sides match best once shifted back; None where none does."""
    # Quantum noise is the same everywhere in the square root of the pixels.
    pixels = np.sqrt(np.maximum(image.pixels, 0), dtype=np.float32)
    field = np.pad(image.field_mask.view(np.uint8), 1)  # the image's border is an edge too
    inside = cv2.erode(field, np.ones((2 * _RIM_PX + 1,) * 2, np.uint8))[1:-1, 1:-1]
    inside[image.pixels >= image.white] = 0
    return _torn(pixels, inside.view(bool), rows=True) or _torn(
        np.ascontiguousarray(pixels.T), np.ascontiguousarray(inside.T).view(bool), rows=False
    )


def _torn(pixels: np.ndarray, inside: np.ndarray, *, rows: bool) -> Tear | None:
    both = inside[1:] & inside[:-1]
    count = np.count_nonzero(both, axis=1)
    difference = pixels[1:] - pixels[:-1]
    difference[~both] = 0
    square = np.einsum("ij,ij->i", difference, difference) / np.maximum(count, 1)
    enough = np.flatnonzero(count > _SHARE * pixels.shape[1])
    if len(enough) < 2 * _AROUND:
        return None
    usual = median_filter(square[enough], 2 * _AROUND + 1)
    ratio = square[enough] / np.maximum(usual, 1e-12)
    found = []
    for k in np.argsort(-ratio)[:_LINES]:
        at = enough[k]
        if ratio[k] > _STEP and 1 <= at < len(pixels) - 2:
            shift, explained = _shift(pixels[at - 1 : at + 1], pixels[at + 1 : at + 3], both[at])
            if abs(shift) >= _NEAREST_PX and explained > _EXPLAINED:
                found.append((explained, Tear(int(at) + 1, shift, rows)))
    return max(found, key=lambda one: one[0])[1] if found else None


def _shift(above: np.ndarray, below: np.ndarray, inside: np.ndarray) -> tuple[int, float]:
    """By how many pixels the lines below lie further on than those above, and how much less they then differ: in each
    half of the line, since a tear shifts all of it and an edge of metal only looks so in places."""
    first, second, width = above.mean(axis=0), below.mean(axis=0), above.shape[1]
    level, known = float(first.mean()), inside.astype(np.float64)
    x, y = (first - level) * known, (second - level) * known
    shifts = np.arange(-_FARTHEST_PX, _FARTHEST_PX + 1)
    count, xx, yy, xy = (
        np.correlate(np.pad(later, _FARTHEST_PX), earlier, "valid")
        for later, earlier in ((known, known), (known, x * x), (y * y, known), (y, x))
    )
    square = np.where(count > _SHARE * width, (xx + yy - 2 * xy) / np.maximum(count, 1), np.inf)
    shift = int(shifts[np.argmin(square)])
    a, b = slice(max(0, -shift), width - max(0, shift)), slice(max(0, shift), width - max(0, -shift))
    at_rest = _halves((first - second) ** 2, inside)
    moved = _halves((first[a] - second[b]) ** 2, inside[a] & inside[b])
    return shift, float((at_rest / np.maximum(moved, 1e-12)).min())


def _halves(values: np.ndarray, counting: np.ndarray) -> np.ndarray:
    """(2,) means over the first and the second half of the values that count."""
    return np.array([half.mean() for half in np.array_split(values[counting], 2)])


def clipped_share(image: Radiograph) -> float:
    """Share of the field's pixels that are as bright or as dark as can be stored."""
    size = np.count_nonzero(image.field_mask)
    clipped = ((image.pixels >= image.white) | (image.pixels <= 0)) & image.field_mask
    return float(np.count_nonzero(clipped) / size) if size else 0.0


def image_checks(image: Radiograph) -> tuple[Check, ...]:
    """Checks of what limits every result from an image: clipped pixels; lossy compression and inversion if any."""
    share = 100 * clipped_share(image)
    sentence = f"{share:.1f} % of the field's pixels are as bright or as dark as can be stored: nothing is known there."
    checks = [Check("clipped pixels", share <= MOST_CLIPPED, share, MOST_CLIPPED, "%", sentence)]
    if image.lossy:
        sentence = "The image was compressed with loss, which moves edges: export it uncompressed if you can."
        checks.append(Check("compression", True, None, None, "", sentence))
    if image.is_inverted:
        sentence = (
            "The file shows the balls bright: the image was inverted. Export it as the C-arm stores it if you can."
        )
        checks.append(Check("inversion", True, None, None, "", sentence))
    return tuple(checks)
