"""The field of view: the part of an image that X-rays reach through the collimator and the round intensifier."""

import cv2
import numpy as np

# All [ours], tried on a mobile C-arm's round and octagonal images and on coronary angiograms.
_SMALL_SIDE = 256  # the outline is found on an image reduced to about this
_DARK_CORNER = 0.1  # of the median of what X-rays reach: with brighter corners an image is not collimated
_BRIGHT = 0.95  # quantile of the image that tells its brightness
_LEVEL = 0.02  # of the brightness: less is not reached by X-rays (glare outside the field stays below)
_STROKE = 5  # small pixels: burnt-in letters and lines are thinner
_PART = 0.03  # of the image: a smaller bright patch is writing, not field
_ON_CIRCLE = 1.5  # small pixels
_STOPS = 60  # places around the outline where its depth is measured
_BLUR_PX = 4  # a wider slope at the edge is a half-shadow, which belongs to the field
_ARCS = 0.3  # of the outline must lie on a circle before the field counts as round


def field_mask(pixels: np.ndarray) -> np.ndarray:
    """(H, W) bool, read-only, True inside the collimation; all True where there is none.

    `pixels` (H, W): of a `Radiograph`. Every collimation (round, octagonal, rectangular, blades within a round field)
    is convex, so the field is the convex hull of what is bright: dark anatomy and metal at its rim are bridged, in a
    round field by the circle. The edge is good to a hundredth of the field's radius, to a twentieth where it is
    bridged; half-shadowed rims belong to the field.
    """
    outline = _outline(pixels)
    mask = np.ones(pixels.shape, dtype=bool) if outline is None else _drawn(*outline, pixels.shape)
    mask.flags.writeable = False
    return mask


def _drawn(corners_px: np.ndarray, depth_px: float, shape: tuple[int, ...]) -> np.ndarray:
    """(H, W) bool: the polygon of (N, 2) corners without a seam of `depth_px`; the image's border has none."""
    mask = np.zeros(shape, dtype=np.uint8)
    corners = np.round(corners_px * 16).astype(np.int32)
    cv2.fillConvexPoly(mask, corners, 1, cv2.LINE_8, 4)
    stroke = round(2 * depth_px) - 1  # half of it lies outside, and pixels are lost from half a pixel on
    if stroke > 0:
        beyond = np.concatenate([corners_px < 0, corners_px > np.array(shape[::-1]) - 1], axis=1)
        free = ~np.logical_and(beyond, np.roll(beyond, -1, axis=0)).any(axis=-1)
        sides = np.stack([corners, np.roll(corners, -1, axis=0)], axis=1)[free]
        cv2.polylines(mask, list(sides), False, 0, stroke, cv2.LINE_8, 4)  # in less time than an erosion takes
    return mask.view(bool)


def _outline(pixels: np.ndarray) -> tuple[np.ndarray, float] | None:
    """(N, 2) corners of what light of the field reaches, px, and how far inside it the field's edge lies.

    None where the image is not collimated.
    """
    small = pixels
    while max(small.shape) > 2**0.5 * _SMALL_SIDE:  # halving twice takes a third of the time of quartering
        small = cv2.resize(small, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    height, width = small.shape
    outside = sorted(_corner_levels(small))[1]  # two: one dark corner is anatomy, one bright corner may be writing
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
    hull = _bridged_by_circle(_hull(edge), edge, small.shape)
    last = np.array([width - 1, height - 1])
    depth = _depth(small, hull, outside)
    scale = np.array([pixels.shape[1] / width, pixels.shape[0] / height])
    hull = np.where(hull <= 0, -0.5, np.where(hull >= last, last + 0.5, hull))
    return (hull + 0.5) * scale - 0.5, min(_BLUR_PX, depth * float(scale.mean()))


def _hull(points: np.ndarray) -> np.ndarray:
    return cv2.convexHull(points.astype(np.float32), clockwise=False)[:, 0].astype(np.float64)


def _depth(small: np.ndarray, hull: np.ndarray, outside: float) -> float:
    """How far inside the outline, which follows a low level, the field's edge falls to half; small pixels.

    The median over the outline, so that what darkens the rim here and there does not count.
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
    half = outside + 0.5 * (np.median(profile[:, steps > 3], axis=1) - outside)
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
    """The hull (N, 2); where it bridges a gap in the outline of a round field, with the circle's arc for a chord.

    The circle is the smallest that encloses the hull: blades and anatomy take from a round field, they add nothing.
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
            turn = np.linspace(first, last, 2 + int(radius * abs(last - first) / 4))
            arcs.append(centre + radius * np.stack([np.cos(turn), np.sin(turn)], axis=1))
    every = np.clip(np.concatenate(arcs), 0, np.array(shape[::-1]) - 1)
    return _hull(every)


def _is_gap(a: np.ndarray, b: np.ndarray, edge: np.ndarray) -> bool:
    """Whether the chord a-b crosses a bay of the outline; along the straight edge of a blade there are points."""
    length = np.linalg.norm(b - a)
    along = (b - a) / length
    s, across = (edge - a) @ along, (edge - a) @ np.array([-along[1], along[0]])
    near = s[(np.abs(across) < _ON_CIRCLE) & (s > 0) & (s < length)]
    return bool(len(near) < 0.5 * length)
