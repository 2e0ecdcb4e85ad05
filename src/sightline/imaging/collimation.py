"""The field of view: the part of an image that X-rays reach through collimator and intensifier."""

import cv2
import numpy as np

# All [ours], tried on a mobile C-arm's round and octagonal images and on coronary angiograms.
_SMALL_SIDE = 256  # px, of the reduced image in which the outline is found
_DARK_CORNER = 0.1  # of the field's median: with brighter corners an image is not collimated
_BRIGHT = 0.95  # quantile of the image taken as its brightness
_LEVEL = 0.02  # of the brightness: threshold of the field (glare outside the field stays below)
_STROKE = 5  # px of the reduced image: burnt-in letters and lines are thinner
_PART = 0.03  # of the image: a smaller bright area is writing, not field
_ON_CIRCLE = 1.5  # px of the reduced image, from the circle
_STOPS = 60  # points on the outline where its depth is measured
_BLUR_PX = 4  # a wider slope at the edge is a penumbra, which belongs to the field
_ARCS = 0.3  # share of a round field's outline that lies on the circle
# Of a surround, which a program fills with one grey level.
_CORNER = 8  # px, side of the square at an image's corner that is constant; also the step of samples
_CONSTANT = 0.3  # of the median difference of neighbours in the middle: the noise of a video, or of compression
_LEFT = 0.1  # of the convex hull of the rest: clipped air, which is bright, surrounds beads
_SMALLEST = 12  # px; a smaller part of the rest in a bright surround is noise; in a dark one parts may be writing
_BLOCK = 8  # px, side of a block of JPEG, in which an edge changes all levels
# Of the levels' range within a block of an edge, between two neighbours: a blur of 0.9 px leaves 0.44 [calc].
_SHARP = 0.6
_LAYERS = 3  # bars of a video, the border of its window, and blanking


def field_mask(pixels: np.ndarray) -> np.ndarray:
    """Return (H, W) bool, read-only, True inside the collimation; all True where there is none.

    `pixels` (H, W): of a `Radiograph`. Every collimation (round, octagonal, rectangular, blades within a round field)
    is convex, so the field is the convex hull of the bright pixels. Dark anatomy and metal at its rim are bridged, in a
    round field by the circle's arc. The edge is accurate to 1 % of the field's radius, to 5 % where it is bridged;
    penumbra belongs to the field. A surround of one grey level, dark or bright, lies outside: bars of a video, a
    window's border, a mask.
    """
    mask = np.ones(pixels.shape, dtype=bool)
    part, inside = pixels, mask  # both smaller with each layer of surrounds
    for _ in range(_LAYERS):
        surround = _surround(part)
        outline = _outline(part if surround is None else np.where(surround, min(part.min(), 0), part), surround)
        if outline is None:
            break
        inside[:] = _drawn(*outline, part.shape)
        if surround is not None:
            inside &= ~surround
        left, top, width, height = cv2.boundingRect(inside.view(np.uint8))
        part, inside = (whole[top : top + height, left : left + width] for whole in (part, inside))
        if min(height, width) <= 2 * _CORNER or not inside[[2, 2, -3, -3], [2, -3, 2, -3]].all():
            break  # there is no layer inside a field that is not a rectangle
    mask.flags.writeable = False
    return mask


def _surround(pixels: np.ndarray) -> np.ndarray | None:
    """Return (H, W) bool: what is filled with one level from the corners; None without, and where that is dark.

    Everything outside a convex field is connected to a corner. In the dark, `_outline` finds the field.
    """
    height, width = pixels.shape
    middle = pixels[height // 4 : -height // 4 : _CORNER, width // 4 : -width // 4].astype(np.float32)
    tolerance = _CONSTANT * float(np.median(np.abs(middle[:, 1:] - middle[:, :-1])))
    dark = _LEVEL * float(np.quantile(pixels[::_CORNER, ::_CORNER], _BRIGHT))
    surround = np.zeros(pixels.shape, dtype=bool)
    for u, v in ((0, 0), (0, height - 1), (width - 1, 0), (width - 1, height - 1)):
        around = pixels[max(v - _CORNER, 0) : v + _CORNER, max(u - _CORNER, 0) : u + _CORNER].astype(np.float32)
        level = float(np.median(around))
        if level > dark and not surround[v, u] and np.abs(around - level).max() <= tolerance:
            surround |= _filled_from(pixels, level, tolerance, (u, v))
    return surround if surround.any() else None


def _filled_from(pixels: np.ndarray, level: float, tolerance: float, corner: tuple[int, int]) -> np.ndarray:
    """Return (H, W) bool: what is filled with `level` around a corner (u, v); all False where it is image content."""
    near = cv2.inRange(pixels, level - tolerance, level + tolerance)
    cv2.floodFill(near, None, corner, 1, flags=8)
    filled = cv2.morphologyEx((near == 1).view(np.uint8), cv2.MORPH_OPEN, np.ones((_STROKE, _STROKE), np.uint8))
    others = pixels[::_CORNER, ::_CORNER][filled[::_CORNER, ::_CORNER] == 0]
    least = _SMALLEST if others.size and level > np.median(others) else _PART * pixels.size
    rest = cv2.findContours(1 - filled, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)[0]
    rest = [part for part in rest if cv2.contourArea(part) >= least]
    hull = np.zeros(pixels.shape, np.uint8)
    if rest:
        cv2.fillConvexPoly(hull, cv2.convexHull(np.concatenate(rest)), 1)
    size = np.count_nonzero(hull)
    outside = size > 0 and np.count_nonzero(np.logical_and(filled, hull)) <= _LEFT * size
    return filled.view(bool) & (outside and (level < pixels.max() or _ends_sharply(pixels, filled)))


def _ends_sharply(pixels: np.ndarray, filled: np.ndarray) -> bool:
    """Return whether what is `filled` ends from one pixel to the next; clipped air beside a bone does not."""
    jump = np.zeros_like(pixels)
    cv2.absdiff(pixels[:, 1:], pixels[:, :-1], jump[:, 1:])
    jump[1:] = cv2.max(jump[1:], cv2.absdiff(pixels[1:], pixels[:-1]))
    near = np.ones((2 * _BLOCK + 1,) * 2, np.uint8)
    edge = cv2.dilate(filled, np.ones((3, 3), np.uint8)) > filled
    steps, lowest = cv2.dilate(jump, near)[edge], cv2.erode(pixels, near)[edge]
    return bool(np.median(steps / np.maximum(float(pixels.max()) - lowest, 1e-9)) > _SHARP)


def _drawn(corners_px: np.ndarray, depth_px: float, shape: tuple[int, ...]) -> np.ndarray:
    """Return (H, W) bool: the polygon of (N, 2) corners, eroded by `depth_px` except at the image's border."""
    mask = np.zeros(shape, dtype=np.uint8)
    corners = np.round(corners_px * 16).astype(np.int32)
    cv2.fillConvexPoly(mask, corners, 1, cv2.LINE_8, 4)
    stroke = round(2 * depth_px) - 1  # half of it lies outside, and a pixel is lost from half a pixel on
    if stroke > 0:
        beyond = np.concatenate([corners_px < 0, corners_px > np.array(shape[::-1]) - 1], axis=1)
        free = ~np.logical_and(beyond, np.roll(beyond, -1, axis=0)).any(axis=-1)
        sides = np.stack([corners, np.roll(corners, -1, axis=0)], axis=1)[free]
        cv2.polylines(mask, list(sides), False, 0, stroke, cv2.LINE_8, 4)  # faster than an erosion
    return mask.view(bool)


def _outline(pixels: np.ndarray, surround: np.ndarray | None = None) -> tuple[np.ndarray, float] | None:
    """Return the corners (N, 2), px, of the illuminated area, and the depth of the field's edge inside it.

    `surround` (H, W) bool: known to lie outside, and filled with the lowest level. None where the image is not
    collimated.
    """
    small = pixels
    while max(small.shape) > 2**0.5 * _SMALL_SIDE:  # halving twice takes a third of the time of one reduction by four
        small = cv2.resize(small, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    height, width = small.shape
    # Second lowest: one dark corner is anatomy, one bright corner may be writing.
    outside = sorted(_corner_levels(small))[1] if surround is None else float(min(pixels.min(), 0))
    sample = np.sort(small[::4, ::4], axis=None)
    level = outside + _LEVEL * (float(sample[int(_BRIGHT * (len(sample) - 1))]) - outside)
    reached = sample[np.searchsorted(sample, level, side="right") :]
    if not reached.size or outside >= _DARK_CORNER * reached[len(reached) // 2]:
        return None
    lit = (small > level).astype(np.uint8)
    lit = cv2.morphologyEx(lit, cv2.MORPH_OPEN, np.ones((_STROKE, _STROKE), np.uint8))
    parts = [c for c in cv2.findContours(lit, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)[0] if len(c) >= 3]
    parts = [c for c in parts if cv2.contourArea(c) >= _PART * small.size]
    if not parts:
        return None
    edge = np.concatenate(parts)[:, 0].astype(np.float64)
    hull = _bridged_by_circle(_convex_hull(edge), edge, small.shape)
    last = np.array([width - 1, height - 1])
    depth = _depth(small, hull, outside)
    scale = np.array([pixels.shape[1] / width, pixels.shape[0] / height])
    hull = np.where(hull <= 0, -0.5, np.where(hull >= last, last + 0.5, hull))
    return (hull + 0.5) * scale - 0.5, min(_BLUR_PX, depth * float(scale.mean()))


def _convex_hull(points: np.ndarray) -> np.ndarray:
    return cv2.convexHull(points.astype(np.float32), clockwise=False)[:, 0].astype(np.float64)


def _depth(small: np.ndarray, hull: np.ndarray, outside: float) -> float:
    """Return the depth inside the outline, which follows a low level, at which the edge reaches half its height.

    In px of the reduced image; the median over the outline, so that local shadows on the rim do not count.
    """
    closed = np.concatenate([hull, hull[:1]])
    way = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(closed, axis=0).T))])
    stops = (np.arange(_STOPS) + 0.5) * way[-1] / _STOPS
    side = np.searchsorted(way, stops) - 1
    along = (closed[1:] - hull) / np.diff(way)[:, None]
    at = hull[side] + (stops - way[side])[:, None] * along[side]
    inward = np.stack([-along[side, 1], along[side, 0]], axis=1)
    free = ((at > 1) & (at < np.array(small.shape[::-1]) - 2)).all(axis=1)
    if not free.any():
        return 0.0
    steps = np.arange(-2.0, 7.0)
    where = (at[free, None] + steps[:, None] * inward[free, None]).astype(np.float32)
    profile = cv2.remap(small.astype(np.float32), where[..., 0], where[..., 1], cv2.INTER_LINEAR)
    half = outside + 0.5 * (np.sort(profile[:, steps > 3], axis=1)[:, 1] - outside)  # the median of three steps
    row = np.arange(len(profile))
    first = np.maximum(np.argmax(profile >= half[:, None], axis=1), 1)
    before, after = profile[row, first - 1], profile[row, first]
    return max(float(np.median(steps[first] - (after - half) / np.maximum(after - before, 1e-9))), 0.0)


def _corner_levels(small: np.ndarray) -> list[float]:
    side = max(2, min(small.shape) // 40)
    corners = [np.sort(small[rows, columns], axis=None) for rows in _ends(side) for columns in _ends(side)]
    return [float(values[len(values) // 2]) for values in corners]


def _ends(side: int) -> tuple[slice, slice]:
    return slice(None, side), slice(-side, None)


def _bridged_by_circle(hull: np.ndarray, edge: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Return the convex hull (N, 2), with arcs of the circle where it bridges gaps in the outline of a round field.

    The circle is the smallest that encloses the hull: blades and anatomy only remove parts of a round field.
    """
    (x, y), radius = cv2.minEnclosingCircle(hull.astype(np.float32))
    centre = np.array([x, y])
    inner = ((edge > 0) & (edge < np.array(shape[::-1]) - 1)).all(axis=1)
    off_circle = radius - np.hypot(*(edge - centre).T)
    if np.mean(off_circle[inner] < _ON_CIRCLE) < _ARCS:
        return hull
    arcs = [hull]
    following = np.roll(hull, -1, axis=0)
    on_circle = np.abs(radius - np.hypot(*(hull - centre).T)) < _ON_CIRCLE
    wide = np.hypot(*(following - hull).T) > 4 * _STROKE
    for i in np.flatnonzero(wide & on_circle & np.roll(on_circle, -1)):
        a, b = hull[i], following[i]
        if _is_gap(a, b, edge):
            first, last = np.unwrap([np.arctan2(y, x) for x, y in (a - centre, b - centre)])
            angle = np.linspace(first, last, 2 + int(radius * abs(last - first) / 4))
            arcs.append(centre + radius * np.stack([np.cos(angle), np.sin(angle)], axis=1))
    every = np.clip(np.concatenate(arcs), 0, np.array(shape[::-1]) - 1)
    return _convex_hull(every)


def _is_gap(a: np.ndarray, b: np.ndarray, edge: np.ndarray) -> bool:
    """Return whether the chord a-b crosses a gap of the outline; a blade's straight edge has points along it."""
    length = np.linalg.norm(b - a)
    along = (b - a) / length
    s, across = (edge - a) @ along, (edge - a) @ np.array([-along[1], along[0]])
    near = s[(np.abs(across) < _ON_CIRCLE) & (s > 0) & (s < length)]
    return bool(len(near) < 0.5 * length)
