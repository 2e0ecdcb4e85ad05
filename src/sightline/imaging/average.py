"""Average several images of one scene, if nothing moved between them."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from sightline.errors import ImageError, MovedRefusedError
from sightline.imaging.radiograph import Radiograph

STILL_PX = 0.1  # the error of a centred ball [physics.md, Picks]: averaging adds no more
_BLOCK = 64  # px, side of the blocks compared one by one: a leg may move while the frame does not
_SMOOTH = 1.5  # px, sigma of the filter before gradients, which noise would increase
_CERTAIN = 5.0  # s.d.; a smaller movement is not significant
_CORRELATED = 28.0  # variance of a sum of smoothed pixels, over that of independent ones: 4 pi 1.5² [calc]
_CHANGED = 2.0  # times the usual mean square difference of a block: 9 s.d. above it [calc]
_SEARCH = 24  # px around a changed block's place in which it is searched for
_FOUND = 0.5  # smallest correlation of a block found again


@dataclass(frozen=True)
class ImageMovement:
    """The largest movement between two images: `shift_px` of the block at `uv_px`, or of the whole image (None).

    `shift_px` is None where something changed and is not found again within 24 px.
    """

    shift_px: float | None
    uv_px: tuple[float, float] | None = None

    @property
    def still(self) -> bool:
        """Whether the movement is at most STILL_PX."""
        return self.shift_px is not None and self.shift_px <= STILL_PX

    def __str__(self) -> str:
        by = "changed" if self.shift_px is None else f"moved by {self.shift_px:.2f} px"
        return by if self.uv_px is None else f"{by} about u {self.uv_px[0]:.0f}, v {self.uv_px[1]:.0f} px"


def movement(first: Radiograph, second: Radiograph) -> ImageMovement:
    """Return the movement of the second image against the first, as a whole or at one block. Raises ImageError."""
    if first.shape != second.shape:
        raise ImageError(f"images of {first.shape} and {second.shape} pixels cannot be compared; take both alike")
    inside = cv2.erode((first.field_mask & second.field_mask).view(np.uint8), np.ones((9, 9), np.uint8)).view(bool)
    # The square root makes the variance of quantum noise the same everywhere.
    a, b = (cv2.GaussianBlur(np.sqrt(i.pixels).astype(np.float32), (0, 0), _SMOOTH) for i in (first, second))
    if inside.any():
        b *= np.float32(np.median(a[inside]) / max(float(np.median(b[inside])), 1e-6))  # exposures may differ
    mean, difference = 0.5 * (a + b), b - a
    gv, gu = np.gradient(mean)
    products = (gu * gu, gu * gv, gv * gv, gu * difference, gv * difference, difference**2, np.ones_like(a))
    sums = np.stack([_sums(np.where(inside, product, 0)) for product in products])
    blocks = np.argwhere(sums[6] > 0.5 * _BLOCK**2)
    if not len(blocks):
        return ImageMovement(0.0)
    sums = sums[:, *blocks.T]
    squares = sums[5] / sums[6]
    usual = float(np.median(squares))
    changed = squares > _CHANGED * usual
    if changed.any():
        return _found_again(a, b, blocks[changed][np.argsort(-squares[changed])])
    (whole,) = _shifts(sums.sum(axis=1, keepdims=True), usual)
    if whole > STILL_PX:
        return ImageMovement(float(whole))
    each = _shifts(sums, usual)
    worst = int(np.argmax(each))
    return ImageMovement(float(each[worst]), _middle(blocks[worst]))


def _shifts(sums: np.ndarray, square: float) -> np.ndarray:
    """Return the least-squares shifts (N,), px, of blocks with these sums (7, N); 0 where not significant."""
    uu, uv, vv, du, dv, _, _ = sums
    determinant = np.maximum(uu * vv - uv * uv, 1e-12)
    shift = np.hypot(vv * du - uv * dv, uu * dv - uv * du) / determinant
    sd = np.sqrt(_CORRELATED * square * (uu + vv) / determinant)
    return np.where(shift > _CERTAIN * sd, shift, 0.0)


def _found_again(a: np.ndarray, b: np.ndarray, blocks: np.ndarray) -> ImageMovement:
    """Return the largest shift of the most changed blocks, found by correlation."""
    best = ImageMovement(None, _middle(blocks[0]))
    for block in blocks[:12]:
        top, left = (int(n) * _BLOCK for n in block)
        y, x = max(top - _SEARCH, 0), max(left - _SEARCH, 0)
        around = b[y : top + _BLOCK + _SEARCH, x : left + _BLOCK + _SEARCH]
        match = cv2.matchTemplate(around, a[top : top + _BLOCK, left : left + _BLOCK], cv2.TM_CCOEFF_NORMED)
        _, score, _, (u, v) = cv2.minMaxLoc(match)
        if score > _FOUND:
            shift = float(np.hypot(u + _subpixel(match[v], u) + x - left, v + _subpixel(match[:, u], v) + y - top))
            if best.shift_px is None or shift > best.shift_px:
                best = ImageMovement(shift, _middle(block))
    return best if best.shift_px is None or best.shift_px > STILL_PX else ImageMovement(None, best.uv_px)


def _subpixel(values: np.ndarray, at: int) -> float:
    """Return the sub-pixel offset of a maximum, from a parabola through three values."""
    if not 0 < at < len(values) - 1:
        return 0.0
    before, middle, after = (float(x) for x in values[at - 1 : at + 2])
    bend = before - 2 * middle + after
    return 0.5 * (before - after) / bend if bend < 0 else 0.0


def _middle(block: np.ndarray) -> tuple[float, float]:
    return (float(block[1]) + 0.5) * _BLOCK, (float(block[0]) + 0.5) * _BLOCK


def _sums(values: np.ndarray) -> np.ndarray:
    """Return sums over blocks; incomplete blocks at the right and the bottom are left out."""
    rows, columns = (side // _BLOCK for side in values.shape)
    return values[: rows * _BLOCK, : columns * _BLOCK].reshape(rows, _BLOCK, columns, _BLOCK).sum(axis=(1, 3))


def average(images: Sequence[Radiograph]) -> Radiograph:
    """Return the mean image, scaled to 16 bits. Raises MovedRefusedError, which says by how much; ImageError."""
    if not images:
        raise ImageError("there is no image to average")
    first = images[0]
    total = np.zeros(first.shape, np.float64)
    for k, image in enumerate(images):
        if image.white != first.white or image.pixels.dtype != first.pixels.dtype:
            raise ImageError("images of different depth cannot be averaged; take all of them the same way")
        moved = movement(first, image) if k else ImageMovement(0.0)
        if not moved.still:
            raise MovedRefusedError(
                f"image {k + 1} {moved} against the first (at most {STILL_PX:g} px); hold still and take them again, "
                "or take a single image"
            )
        total += image.pixels
    mean, lossy = total / len(images), any(image.lossy for image in images)
    if first.pixels.dtype == np.float32:
        return Radiograph(mean.astype(np.float32), first.white, first.tags, lossy)
    return Radiograph(np.rint(mean * (65535.0 / first.white)).astype(np.uint16), 65535.0, first.tags, lossy)
