"""Candidates: band-pass extrema whose rim lies on a circle."""

from dataclasses import dataclass
from threading import local

import cv2
import numpy as np

from sightline.common.kernels import kernel
from sightline.common.threads import at_once
from sightline.detection.beads.bead import centres
from sightline.detection.beads.noise import NoiseModel
from sightline.detection.beads.rim import EXTREMUM, FAINTEST, MIN_STEP_SNR, broad_noise, judged

# Extrema are searched for at half resolution, where a disc of 2 px with the usual blur is still well sampled. The bands
# respond most to discs of 2.2, 3.8, 7.6, 15 and 30 px radius: each of 2-25 px is within a factor of sqrt 2 [calc].
_OCTAVES = 4
# Discs of 42-240 px radius are searched for only to learn that the image has too fine pixels (scale.py).
_FURTHER_OCTAVES = 2
_HALF = 2
_BAND_RADIUS = 1.9  # disc to which a band of two Gaussians of sigma 1 and 2 responds most [calc]
_FINEST_RADIUS = 1.1  # the same for sigma 0.5 and 1, on the half-size image with its own blur [calc]
_MIN_SNR = 4.0  # smallest response of a spot over the s.d. of the band's noise [ours]
_BAND_NOISE = 0.2  # s.d. of a band's response, over the noise of a broad mean and the band's radius [calc]
_BAND_GAIN = 0.2  # smallest response to a disc of contrast 1 between two bands [calc: 0.25 at a band's own radius]
_BALL_RIM_PX = 0.75  # from a ball's steepest slope to its rim, where it is thin [twin: 0.6-0.8]
# A ball's shadow is deeper in its middle than the step at its rim, by the square of this over its radius, px
# [twin: 4.8-5.5].
_DEEPER_PX, _DEEPEST = 5.2, 2.5
# Limits of how much a washer lacks in its middle, over its step: 0.77-1.06 [twin]; balls have 0.1 or less, a hole among
# holes more.
_HOLLOW = 0.6, 1.25
_AROUND = np.array([(v, u) for v in (-1, 0, 1) for u in (-1, 0, 1) if u or v])  # row and column of the neighbours
_CELL = 32.0  # px; duplicates are searched for in adjacent cells, which reach further than half a radius
_MAX_EXTREMA = 2**16  # of a band; only the part of the buffer that is filled takes memory
# Smoothed images of up to so many px are kept for the next image: the system hands out new memory page by page, which
# takes as long as the blur [ours].
_KEPT_PX = 2**21
_kept = local()


@dataclass(frozen=True, eq=False)
class Candidates:
    """Bead candidates, best first: `uv_px` (N, 2), to about 0.3 px; `radius_px` (N,), to about 5 %.

    `response` (N,): signed contrast of log intensity, to about a fifth; `washer` (N,) bool: dark, with a bright middle;
    `round` (N,) bool: False for a spot with a rim that is not round; it is reported as rejected.
    `sizes` (M, 2): radii and responses of all round spots, of any size; the same spot may be there twice.
    """

    uv_px: np.ndarray
    radius_px: np.ndarray
    response: np.ndarray
    washer: np.ndarray
    round: np.ndarray
    sizes: np.ndarray

    def __len__(self) -> int:
        return len(self.response)


def find_candidates(log_image: np.ndarray, mask: np.ndarray, noise: NoiseModel) -> Candidates:
    """Return round spots inside `mask` of a log image (H, W) float32, one per place and sign.

    The log image is filled outside the mask. Extrema without a rim, hundreds in any image, are dropped without a
    report.
    """
    line = np.array([noise.offset + 2 * np.log(noise.broad), noise.slope], np.float32)
    half = cv2.resize(log_image, None, fx=1 / _HALF, fy=1 / _HALF, interpolation=cv2.INTER_AREA)
    smooth, first, second, fine = _smoothed(log_image.shape, half.shape)
    first = cv2.GaussianBlur(half, (7, 7), 1.0, dst=first)
    coarser, base, finest = at_once(
        lambda: _bands(first, second, mask, line),
        lambda: cv2.GaussianBlur(log_image, (5, 5), 0.8, dst=smooth),
        lambda: _extrema(cv2.GaussianBlur(half, (3, 3), 0.5, dst=fine), first, mask, _HALF, _FINEST_RADIUS, line),
    )
    bands = [finest, *coarser]
    every = judged(base, np.concatenate(bands), line)
    sizes = np.stack([every["radius_px"], every["contrast"]], axis=1)[every["score"] > 0]
    spots = every[: sum(map(len, bands[:-_FURTHER_OCTAVES]))]
    spots = np.concatenate([spots, judged(base, _washers_around(spots), line)])
    spots = spots[spots["radius_px"] > 0]
    spots = spots[np.argsort(-spots["score"], kind="stable")]
    spots = spots[distinct(spots)]
    dark, is_round = spots["contrast"] < 0, spots["score"] > 0
    washer = dark & (spots["hollow"] > _HOLLOW[0]) & (spots["hollow"] < _HOLLOW[1]) & is_round
    ball, keep = dark & ~washer, ~_middles(spots, washer)
    radius = spots["radius_px"] + np.where(ball, _BALL_RIM_PX, 0.0)
    deeper = np.minimum(1.0 + (_DEEPER_PX / radius) ** 2, _DEEPEST)
    strength = np.where(is_round, spots["contrast"] * radius, 0.0)
    deeper[~ball | (strength.sum() > 0)] = 1.0  # between the holes of a plate, dark spots are not balls
    values = centres(spots), radius, deeper * spots["contrast"], washer, is_round
    return Candidates(*(value[keep] for value in values), sizes=sizes)


def _smoothed(shape: tuple[int, ...], half: tuple[int, ...]) -> list[np.ndarray]:
    """Return unset images, float32: one of `shape` and three of `half` its size; the same to the next call here.

    Each thread has its own.
    """
    kept = getattr(_kept, "images", None)
    if kept is None or kept[0].shape != shape:
        kept = [np.empty(size, np.float32) for size in (shape, half, half, half)]
        _kept.images = kept if kept[0].size <= _KEPT_PX else None
    return kept


def _bands(first: np.ndarray, second: np.ndarray, mask: np.ndarray, line: np.ndarray) -> list[np.ndarray]:
    """Return the extrema (N,) of each band but the finest; `first`: the half-size image with a blur of 1 px.

    `second`: an image of that size, to be overwritten.
    """
    bands = []
    for octave in range(_OCTAVES + _FURTHER_OCTAVES):
        second = cv2.GaussianBlur(first, (11, 11), 3**0.5, dst=second if octave == 0 else None)
        bands.append(_extrema(first, second, mask, _HALF << octave, _BAND_RADIUS, line))
        first = np.ascontiguousarray(second[::2, ::2])
    return bands


def _washers_around(spots: np.ndarray) -> np.ndarray:
    """Return extrema for washers around every round bright spot, whose own response may hide the washer's.

    The initial radius is large enough that the middle of the washer, half as wide, is not taken for its inside.
    """
    holes = spots[(spots["score"] > 0) & (spots["contrast"] > 0)]
    washers = np.zeros(len(holes), EXTREMUM)
    washers["u_px"], washers["v_px"] = holes["u_px"], holes["v_px"]
    washers["radius_px"], washers["contrast"] = 2.8 * holes["radius_px"], -holes["contrast"]
    return washers


def _middles(spots: np.ndarray, washer: np.ndarray) -> np.ndarray:
    """Return (N,) bool: which spots are the bright middles of washers."""
    inside = np.zeros(len(spots), bool)
    for outer in spots[washer]:
        near = np.hypot(spots["u_px"] - outer["u_px"], spots["v_px"] - outer["v_px"]) < 0.4 * outer["radius_px"]
        inside |= near & (spots["radius_px"] < outer["radius_px"]) & (spots["contrast"] > 0)
    return inside


def _extrema(fine, coarse, mask, step: int, radius: float, line) -> np.ndarray:  # noqa: PLR0917
    """Return the local extrema (N,) of a pyramid band, fine - coarse, with `step` image px per pixel.

    The band responds most to discs of `radius` of its pixels.
    """
    rows = np.empty(_MAX_EXTREMA, EXTREMUM)
    if min(fine.shape) < 5:
        return rows[:0]
    return rows[: _band(fine, coarse, mask, step, radius * step, line, rows)]


@kernel(nogil=True)
def _band(fine, coarse, mask, step, radius, line, rows) -> int:  # noqa: PLR0917
    """Fill `rows` with the extrema of a band; return their number."""
    height, width = fine.shape
    reach = 0 if step > _HALF else 1 if radius < _BAND_RADIUS * step else 2
    faintest = np.float32(_BAND_GAIN * FAINTEST)
    extremal, differences = np.zeros((width + 7) // 8 * 8, np.bool_), np.empty((3, width), np.float32)
    eights = extremal.view(np.uint64)  # few are extremal: eight others are passed over at once
    _subtract(fine[0], coarse[0], differences[0])
    _subtract(fine[1], coarse[1], differences[1])
    n = 0
    for y in range(1, height - 1):
        before, here, after = differences[(y - 1) % 3], differences[y % 3], differences[(y + 1) % 3]
        _subtract(fine[y + 1], coarse[y + 1], after)
        _mark_extremal(before, here, after, faintest, extremal)
        for k in range(len(eights)):
            for x in range(8 * k, 8 * k + 8 if eights[k] else 0):
                if not extremal[x] or not mask[y * step, x * step]:
                    continue
                value, noise = here[x], broad_noise(coarse[y, x], line) / radius
                if abs(value) < _MIN_SNR * _BAND_NOISE * noise or n == _MAX_EXTREMA:
                    continue
                if reach and not _has_sides(fine, y, x, reach, value > 0, max(FAINTEST, MIN_STEP_SNR * noise)):
                    continue
                left, right, above, below = here[x - 1], here[x + 1], before[x], after[x]
                bend_u, bend_v = left - 2 * value + right, above - 2 * value + below
                u = x + (0.5 * (left - right) / bend_u if abs(bend_u) > 1e-9 else 0.0)
                v = y + (0.5 * (above - below) / bend_v if abs(bend_v) > 1e-9 else 0.0)
                # Pixel 0 of the half-size image is centred between pixels 0 and 1 of the image.
                rows[n].u_px, rows[n].v_px = u * step + 0.5 * (_HALF - 1), v * step + 0.5 * (_HALF - 1)
                rows[n].radius_px, rows[n].contrast = radius, value
                n += 1
    return n


@kernel()
def _subtract(fine, coarse, difference):
    for x in range(len(difference)):
        difference[x] = fine[x] - coarse[x]


@kernel()
def _mark_extremal(before, here, after, least, extremal):
    """Mark the extrema of the row `here`, between the rows beside it, that are `least` or more from zero.

    Without branches, so that it is vectorised.
    """
    for x in range(1, len(here) - 1):
        above = max(before[x - 1], before[x], before[x + 1], here[x - 1])
        above = max(above, here[x + 1], after[x - 1], after[x], after[x + 1])
        below = min(before[x - 1], before[x], before[x + 1], here[x - 1])
        below = min(below, here[x + 1], after[x - 1], after[x], after[x + 1])
        extremal[x] = (here[x] >= max(above, least)) | (here[x] <= min(below, -least))


@kernel()
def _has_sides(fine, y, x, reach, bright, least) -> bool:  # noqa: PLR0917
    """Return whether values fall towards at least 5 of 8 places around an extremum, on average by half of `least`.

    A quick test, which leaves few of the many extrema of noise and texture in the finest bands. The places lie `reach`
    pixels away along the diagonals, one more along the axes; the fall begins at the extremum for a reach of 1, and at
    the pixel beside it for 2.
    """
    height, width = fine.shape
    if not (3 <= y < height - 3 and 3 <= x < width - 3):
        return True
    falls = np.empty(8, np.float32)
    sign, mean, down = np.float32(1.0 if bright else -1.0), np.float32(0.0), 0
    for k in range(8):
        v, u = _AROUND[k, 0], _AROUND[k, 1]
        far = reach + 1 if u == 0 or v == 0 else reach
        inner = fine[y + v, x + u] if reach > 1 else fine[y, x]
        falls[k] = sign * (inner - fine[y + far * v, x + far * u])
        mean += falls[k] / np.float32(8.0)
    if mean < 0.5 * least:
        return False
    for k in range(8):
        down += falls[k] > 0.3 * mean
    return down >= 5


def distinct(spots: np.ndarray) -> np.ndarray:
    """Return (N,) bool: candidates or beads, best first, that do not duplicate a better one.

    A duplicate has the same sign, and its centre lies within half the larger radius of the other's.
    """
    keep, uv = np.ones(len(spots), bool), centres(spots)
    if len(spots):
        columns, lines = (np.maximum(uv.max(axis=0), 0) / _CELL).astype(int) + 2
        radius, dark = spots["radius_px"].copy(), spots["contrast"] < 0
        _mark_duplicates(uv, radius, dark, keep, np.full((lines, columns), -1), np.full(len(spots), -1))
    return keep


@kernel()
def _mark_duplicates(uv, radius, dark, keep, head, following):  # noqa: PLR0917 - a kernel
    """Clear `keep` of duplicates. `head` of each cell and `following` of each row link the kept rows of a cell."""
    lines, columns = head.shape
    for i in range(len(uv)):
        row, column = int(max(uv[i, 1], 0.0) / _CELL), int(max(uv[i, 0], 0.0) / _CELL)
        for y in range(max(row - 1, 0), min(row + 2, lines)):
            for x in range(max(column - 1, 0), min(column + 2, columns)):
                j = head[y, x]
                while j >= 0 and keep[i]:
                    apart = (uv[j, 0] - uv[i, 0]) ** 2 + (uv[j, 1] - uv[i, 1]) ** 2
                    keep[i] = apart > (0.5 * max(radius[i], radius[j])) ** 2 or dark[i] != dark[j]
                    j = following[j]
        if keep[i]:
            following[i] = head[row, column]
            head[row, column] = i
