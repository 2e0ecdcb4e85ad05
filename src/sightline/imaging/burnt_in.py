"""Find burnt-in annotations: letters, logos, arrows and lines that a C-arm writes into its images.

A mark has one exact value and ends from one pixel to the next. X-ray images do neither: quantum noise makes equal
neighbours rare, and the detector's blur spreads every edge over two or more pixels, even that of a saturated area or an
opaque ball.
"""

from collections.abc import Sequence

import cv2
import numpy as np

# All [ours], tried on the twin's images with and without marks and on those of a mobile C-arm.
_STEP = 0.04  # of the values' range: a fainter mark does not shift a bead's rim
_NOISE_STEP = 4.0  # times the 90 % quantile of differences between neighbours: 6.6 s.d. of noise
_SHARP = 0.35  # smallest share of the pixels beside a mark that differ by such a step
_WIDEST = 6.0  # px, half the width of a stroke
_SLENDER = 10.0  # area of a stroke over its squared half width: three times as long as wide; a disc has 3.1
_SMALLEST = 12  # px; saturated specks and dead pixels are smaller, letters larger
_SEEDS = 4  # smallest number of rows with a run of one value that begins and ends with a step
_VALUES = 6  # most values of an image's marks
_RIM = 0.03  # of the image's side, inside the field's edge: blanking ends as sharply as letters do
_AROUND = 5  # px, side of the square that dilates marks, whose edges may be smoothed
_FILLED = 2  # value of a component's pixels while it is looked at
_SAMPLE = 16  # sampling step, in rows and columns, of the differences between neighbours


def burnt_in(pixels: np.ndarray, white: float, field: np.ndarray) -> np.ndarray | None:
    """Return (H, W) bool, read-only, True on marks and two pixels around them; None where there are none.

    `pixels` (H, W) and `white`: of a `Radiograph`; `field` (H, W) bool: True inside the collimation.
    Finds marks of one exact value that lie in the field, at least in part. Does not find half-transparent marks, and
    marks blurred by lossy compression or a video chain.
    """
    least = _least_step(pixels, white)
    seeds = _seeds(pixels, field, least)
    values, counts = np.unique(pixels[seeds[:, 0], seeds[:, 1]], return_counts=True)
    commonest = np.argsort(-counts, kind="stable")[:_VALUES]
    marks = np.zeros(pixels.shape, bool)
    for value in values[commonest][counts[commonest] >= _SEEDS]:
        clipped = value >= white or value == pixels[field].min()
        marks |= _marks_of(pixels, field, float(value), seeds, least, clipped=bool(clipped))
    if not marks.any():
        return None
    mask = cv2.dilate(marks.view(np.uint8), np.ones((_AROUND, _AROUND), np.uint8)).view(bool)
    mask.flags.writeable = False
    return mask


def _least_step(pixels: np.ndarray, white: float) -> float:
    """Return the difference between neighbours that counts as a step."""
    span = white if pixels.dtype != np.float32 else float(pixels.max()) - float(pixels.min())
    here, beside = (pixels[::_SAMPLE, column::_SAMPLE].astype(np.float32) for column in (0, 1))
    differences = np.sort(np.abs(here[:, : beside.shape[1]] - beside), axis=None)
    return max(_STEP * span, _NOISE_STEP * float(differences[int(0.9 * (len(differences) - 1))]))


def _seeds(pixels: np.ndarray, field: np.ndarray, least: float) -> np.ndarray:
    """Return (N, 2) row and column of runs of one value, two pixels or more, that begin and end with the same step.

    Every second row is searched, well inside the field: letters are higher than two rows.
    """
    rows = pixels[::2]
    beyond = least if pixels.dtype == np.float32 else int(least)  # integers are compared with an integer faster
    steps = np.flatnonzero(cv2.absdiff(rows[:, 1:], rows[:, :-1]) > beyond)  # few; searching along one axis is faster
    row, before = np.divmod(steps, pixels.shape[1] - 1)
    first, last = before[:-1] + 1, before[1:]  # of the run between one step and the next
    run = (row[:-1] == row[1:]) & (last > first)
    v, first, last = 2 * row[:-1][run], first[run], last[run]
    value = pixels[v, first]
    alike = (pixels[v, last] == value) & (pixels[v, (first + last) // 2] == value)
    ends = (pixels[v, first - 1] > value) == (pixels[v, last + 1] > value)
    seeds = np.stack([v, first], axis=1)[alike & ends]
    return seeds[_well_inside(field, *seeds.T)]


def _well_inside(field: np.ndarray, v: np.ndarray, u: np.ndarray) -> np.ndarray:
    """Return (N,) bool: whether these pixels lie in the field and not on its rim."""
    height, width = field.shape
    rim = 1 + int(_RIM * min(height, width))
    inside = (v >= rim) & (v < height - rim) & (u >= rim) & (u < width - rim)
    near = [field[(v + y * rim) % height, (u + x * rim) % width] for y, x in ((-1, 0), (1, 0), (0, -1), (0, 1))]
    return inside & np.all(near, axis=0)


def _marks_of(
    pixels: np.ndarray, field: np.ndarray, value: float, seeds: np.ndarray, least: float, *, clipped: bool
) -> np.ndarray:
    """Return (H, W) bool: connected pixels of one value in the field that are marks; none without a seed in a mark.

    `clipped`: the value is the image's largest or smallest; then only strokes are marks.
    """
    alike = (pixels == value).view(np.uint8)

    def is_mark(part: np.ndarray, i: int, box: Sequence[int], size: int) -> bool:
        """Return whether the `size` pixels of `part` that are i are a mark; `box`: left, top, width, height."""
        left, top, width, height = box
        if size < _SMALLEST:
            return False
        inside = np.s_[top : top + height, left : left + width]
        if 2 * np.count_nonzero(field[inside] & (part[inside] == i)) <= size:
            return False
        about = np.s_[max(top - 1, 0) : top + height + 1, max(left - 1, 0) : left + width + 1]
        mark = (part[about] == i).view(np.uint8)
        return _is_sharp(mark, pixels[about], value, least) and (not clipped or _is_stroke(mark))

    # Most images have no mark. So only the components with a seed are filled at first: all of them take ten times as
    # long.
    filled, seeded = alike.copy(), False
    for v, u in seeds[alike[seeds[:, 0], seeds[:, 1]] > 0].tolist():
        if filled[v, u] == 1:
            size, _, _, box = cv2.floodFill(filled, None, (u, v), _FILLED, flags=8)
            seeded = is_mark(filled, _FILLED, box, size)
            if seeded:
                break
            cv2.floodFill(filled, None, (u, v), 0, flags=8)
    if not seeded:
        return np.zeros(pixels.shape, bool)
    count, part, stats, _ = cv2.connectedComponentsWithStats(alike, connectivity=8)
    keep = np.zeros(count, bool)
    for i in 1 + np.flatnonzero(stats[1:, cv2.CC_STAT_AREA] >= _SMALLEST):  # component 0: pixels with other values
        *box, size = stats[i].tolist()
        keep[i] = is_mark(part, int(i), box, size)
    return keep[part]


def _is_sharp(mark: np.ndarray, pixels: np.ndarray, value: float, least: float) -> bool:
    """Return whether enough pixels beside a mark differ by a step; a patch at an edge has a step on one side only."""
    beside = cv2.dilate(mark, cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))) > mark
    return float(np.mean(np.abs(pixels[beside].astype(np.float32) - value) > least)) > _SHARP


def _is_stroke(mark: np.ndarray) -> bool:
    """Return whether a mark is thin and long; clipped holes, balls and open beam may be as sharp, but are wide."""
    half = float(cv2.distanceTransform(np.pad(mark, 1), cv2.DIST_L2, 3).max())
    return half <= _WIDEST and int(np.count_nonzero(mark)) > _SLENDER * half**2
