"""Defects visible in an image's pixels: tears, clipped pixels, compression, interlaced fields."""

from dataclasses import dataclass, replace

import cv2
import numpy as np

from sightline.common.checks import Check
from sightline.imaging.radiograph import Radiograph

# Of the search for tears, [ours] if without a source: tried on torn images of the twin and intact ones, also of C-arms.
_RIM_PX = 12  # left out at the field's edge, where lines always differ
_AROUND = 24  # lines to either side that define the usual difference between lines
_STEP = 2.5  # times the usual difference, at a tear; there, blurred noise alone gives 3.7 [calc]
_SHARE = 0.5  # of the image's width that must lie in the field: shorter lines match by chance
_MAX_SHIFT_PX, _MIN_SHIFT_PX = 64, 2  # range of the search; smaller shifts are within a bead's blur
# Smallest ratio of differences before and after the shift, in either half of the lines, since the edge of a shutter
# matches in one: 344 whole images have up to 1.17, but for 1.7 where two balls match. And the smallest ratio of the
# median over all shifts to that at the best: lines without structure match at any [gVirtualXray, ARCADIS, XA].
_EXPLAINED, _UNLIKE = 1.25, 2.0
_LINES = 5  # candidates examined
_BLOCK = 8  # lines of a block of JPEG: at their edges all differ
MAX_CLIPPED = 50.0  # [ours] % of the field: air beside the patient clips up to 32 % in images of the twin


@dataclass(frozen=True)
class Tear:
    """A shift by `shift_px` along the image's lines, from line `at` on; `rows`: the lines are rows, not columns."""

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
    """Return what is wrong with an interlaced image with movement between its fields, and what to do; else None."""
    moved = comb(image)
    if moved <= MOVED or 100 * clipped_share(image) > MAX_CLIPPED:  # clipped lines cannot be compared
        return None
    return (
        f"the image is interlaced and something moved between its two fields (comb {moved:.2f}, at most {MOVED:g}); "
        "take it again without movement, or from a progressive source"
    )


def torn(image: Radiograph) -> Tear | None:
    """Return the tear whose two sides match best after shifting back, or None."""
    # The square root makes the variance of quantum noise the same everywhere.
    pixels = np.sqrt(np.maximum(image.pixels, 0), dtype=np.float32)
    field = np.pad(image.field_mask.view(np.uint8), 1)  # the image's border is an edge too
    inside = cv2.erode(field, np.ones((2 * _RIM_PX + 1,) * 2, np.uint8))[1:-1, 1:-1]
    inside[image.pixels >= image.white] = 0
    return _torn(pixels, inside.view(bool), rows=True) or _torn(
        np.ascontiguousarray(pixels.T), np.ascontiguousarray(inside.T).view(bool), rows=False
    )


def _torn(pixels: np.ndarray, inside: np.ndarray, *, rows: bool) -> Tear | None:
    from scipy.ndimage import median_filter  # here: its import takes 40 ms

    both = inside[1:] & inside[:-1]
    count = np.count_nonzero(both, axis=1)
    difference = pixels[1:] - pixels[:-1]
    difference[~both] = 0
    square = np.einsum("ij,ij->i", difference, difference) / np.maximum(count, 1)
    enough = np.flatnonzero(count > _SHARE * pixels.shape[1])
    if len(enough) < 2 * _AROUND:
        return None
    beside = np.maximum(np.roll(square, 2), np.roll(square, -2))[enough]  # a bead's rim covers some lines
    usual = np.maximum(median_filter(square[enough], 2 * _AROUND + 1), beside)
    for phase in range(_BLOCK):
        lines = slice(phase, None, _BLOCK)
        usual[lines] = np.maximum(usual[lines], median_filter(square[enough][lines], 2 * _AROUND // _BLOCK + 1))
    ratio = square[enough] / np.maximum(usual, 1e-12)
    tears = []
    for k in np.argsort(-ratio)[:_LINES]:
        at = enough[k]
        if ratio[k] > _STEP and 1 <= at < len(pixels) - 2:
            shift, explained = _shift(pixels[at - 1 : at + 1], pixels[at + 1 : at + 3], both[at])
            if abs(shift) >= _MIN_SHIFT_PX and explained > _EXPLAINED:
                tears.append((explained, Tear(int(at) + 1, shift, rows)))
    return max(tears, key=lambda tear: tear[0])[1] if tears else None


def _shift(above: np.ndarray, below: np.ndarray, inside: np.ndarray) -> tuple[int, float]:
    """Return the shift, px, of the lines below against those above, and by what factor it reduces their difference, in
    the half of the lines where it does so less: a tear shifts both, an edge of metal only a part; 0 and 1 where others
    match as well."""
    first, second, width = above.mean(axis=0), below.mean(axis=0), above.shape[1]
    level, known = float(first.mean()), inside.astype(np.float64)
    x, y = (first - level) * known, (second - level) * known
    shifts = np.arange(-_MAX_SHIFT_PX, _MAX_SHIFT_PX + 1)
    count, xx, yy, xy = (
        np.correlate(np.pad(later, _MAX_SHIFT_PX), earlier, "valid")
        for later, earlier in ((known, known), (known, x * x), (y * y, known), (y, x))
    )
    square = np.where(count > _SHARE * width, (xx + yy - 2 * xy) / np.maximum(count, 1), np.inf)
    shift = int(shifts[np.argmin(square)])
    if np.median(square[np.isfinite(square)]) < _UNLIKE * square.min():
        return 0, 1.0
    a, b = slice(max(0, -shift), width - max(0, shift)), slice(max(0, shift), width - max(0, -shift))
    at_rest = _halves((first - second) ** 2, inside)
    moved = np.maximum(_halves((first[a] - second[b]) ** 2, inside[a] & inside[b]), 1e-12)
    return shift, float((at_rest / moved).min())


def _halves(values: np.ndarray, counting: np.ndarray) -> np.ndarray:
    """Return the means (2,) over the first and the second half of the counting values."""
    return np.array([half.mean() for half in np.array_split(values[counting], 2)])


def clipped_share(image: Radiograph) -> float:
    """Return the share of the field's pixels that are as bright or as dark as can be stored."""
    size = np.count_nonzero(image.field_mask)
    if not size:
        return 0.0
    whole = image.pixels.dtype != np.float32  # integers are compared with an integer in half the time
    clipped = image.pixels >= (int(np.ceil(image.white)) if whole else image.white)
    clipped |= image.pixels <= 0
    clipped &= image.field_mask
    return float(np.count_nonzero(clipped) / size)


def image_checks(image: Radiograph) -> tuple[Check, ...]:
    """Return the checks of an image: clipped pixels; also tears, lossy compression and inversion, where they apply."""
    share = 100 * clipped_share(image)
    sentence = f"{share:.1f} % of the field's pixels are as bright or as dark as can be stored: nothing is known there."
    checks = [Check("clipped pixels", share <= MAX_CLIPPED, share, MAX_CLIPPED, "%", sentence)]
    # Beads show a smaller tear, but a block's lie in a small part of its image.
    tear = torn(image)
    if tear is not None:
        checks.append(Check("image rows", False, abs(tear.shift_px), None, "px", f"T{tear.sentence[1:]}."))
    if image.lossy:
        sentence = "The image was compressed with loss, which moves edges: export it uncompressed if you can."
        checks.append(Check("compression", True, None, None, "", sentence))
    if image.is_inverted:
        sentence = (
            "The file shows the balls bright: the image was inverted. Export it as the C-arm stores it if you can."
        )
        checks.append(Check("inversion", True, None, None, "", sentence))
    return tuple(checks)


# In a progressive frame, a line differs from the mean of its neighbours by no more than from the mean of the lines two
# away; white noise gives a ratio of 1. Movement between two fields gives a larger ratio.
# [twin, every eighth column: PAL at rest 1.025-1.045 with 120 quanta per pixel and 1.042-1.054 with 15; moved by 1 px
# 1.066-1.086 with 120, lost in noise with 15; progressive frames, degraded in 13 ways, 0.994 at most]
MOVED = 1.06


def comb(image: Radiograph) -> float:
    """Return the rms difference of lines from the mean of their neighbours, over that of the lines two away; see MOVED.

    Lines repeated by an enlargement are left out: structure makes the same steps between them.
    """
    pixels, field = image.pixels[:, ::8].astype(np.float32), image.field_mask[:, ::8]
    a, b, c, d, e = (pixels[k : len(pixels) - 4 + k] for k in range(5))
    own = (b != c).any(axis=1) & (c != d).any(axis=1)
    inside = field[:-4] & field[4:] & own[:, None]
    if not inside.any():
        return 0.0
    near, far = (np.sqrt(np.square(c - 0.5 * (x + y))[inside].mean(dtype=np.float64)) for x, y in ((b, d), (a, e)))
    return float(near / max(far, 1e-6))


def field_of(image: Radiograph, which: int) -> Radiograph:
    """Return the image of the first (0, even lines) or second (1) field, with the other field's lines interpolated.

    Lines keep their places, so beads keep their centres; the resolution across the lines is halved.
    """
    pixels = image.pixels.astype(np.float32)
    lines = np.arange(image.shape[0])
    missing = lines[lines % 2 != which]
    above, below = missing - 1, missing + 1
    above[above < 0], below[below >= len(lines)] = below[above < 0], above[below >= len(lines)]
    pixels[missing] = 0.5 * (pixels[above] + pixels[below])
    if image.pixels.dtype != np.float32:
        pixels = np.rint(pixels).astype(image.pixels.dtype)
    return replace(image, pixels=pixels)
