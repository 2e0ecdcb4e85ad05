"""What covers a bead: metal and other beads, whose pixels a fit leaves out."""

import cv2
import numpy as np

from sightline.common.fitting import distances
from sightline.detection.beads import refine, window
from sightline.detection.beads.bead import centres

# Deepest overlaps, in units of the smaller radius, at which two shadows can be separated: by their own rims, and where
# other beads say what shape they have [twin].
DEEPEST, DEEPEST_OF_KNOWN_SHAPE = 1.4, 1.9
# Pixels within this margin of an overlap are left out: two balls stop less light than the product of single shadows
# predicts. The margin lowers chi-square / 2 of overlapping beads from 6-10 to 0.8-1.2. In overlaps above 1.2 radii one
# of 70 beads was wrong by 6 s.d. at 1.75 px, none at 2 px; 2.5 px leave fewer of them enough pixels [twin].
_MARGIN_PX = 2.0
_MIN_RIM_SHARE = 0.3  # of the rim, not covered by metal or other beads [ours]
_MOST_HIDDEN = 0.5  # share of its rim up to which what covers a bead does not matter, however deep the overlap [twin]


def without_overlaps(
    fit: refine.BeadFitter, rows: np.ndarray, which: np.ndarray, deepest: float = DEEPEST
) -> tuple[np.ndarray, np.ndarray]:
    """Return the usable pixels (H, W) outside metal and overlaps of the beads `which` (M,) of `rows`.

    And (M,) bool: whether enough of each bead is left. `deepest`: overlap beyond which it is not.
    """
    usable = fit.usable.copy()
    enough = [_clear_covered(fit, rows, i, usable) < deepest for i in which]
    return usable, np.array(enough, dtype=bool)


def _clear_covered(fit: refine.BeadFitter, rows: np.ndarray, i: int, usable: np.ndarray) -> float:
    """Clear metal around bead `i` and its overlaps in `usable`; return its deepest overlap with a bead that hides more
    than half of its rim.

    Infinite where too little of the bead is left.
    """
    u, v, radius = (float(rows[i][name]) for name in ("u_px", "v_px", "radius_px"))
    reach = radius + window.BEYOND
    apart = distances(centres(rows[i : i + 1]), centres(rows))[0]
    near = np.flatnonzero(apart < 1.5 * reach + 4.0 + rows["radius_px"])  # the window's corners too
    near = near[np.argsort(apart[near])]  # itself first
    half = int(reach) + 1
    left, top = int(u + 0.5) - half, int(v + 0.5) - half
    level = window.log_level(fit.log_image, fit.usable, u, v, radius, reach)
    light = window.window_light(fit.log_image, left, top, half, level)
    state = window.pixel_states(fit.log_image, fit.usable, rows, near, left, top, 2 * half + 1, np.inf)
    outside = state == window.HIDDEN
    window.hide_metal(state, rows, near, left, top, light)
    state[_hull_of_metal((state == window.HIDDEN) & ~outside)] = window.HIDDEN
    metal = (state == window.HIDDEN) & ~outside
    hidden = cv2.dilate(metal.view(np.uint8), np.ones((3, 3), np.uint8)) > 0
    y, x = np.arange(len(state))[:, None] + top, np.arange(len(state)) + left
    from_centre = np.hypot(x - u, y - v)
    overlap = overlap_of(apart[near[1:]], radius, rows["radius_px"][near[1:]])
    for j in near[1:][overlap > 0]:
        from_other = np.hypot(x - rows[j]["u_px"], y - rows[j]["v_px"])
        hidden |= (from_centre < radius + _MARGIN_PX) & (from_other < rows[j]["radius_px"] + _MARGIN_PX)
    height, width = usable.shape
    seen = slice(max(-top, 0), max(height - top, 0)), slice(max(-left, 0), max(width - left, 0))
    there = slice(max(top, 0), top + len(state)), slice(max(left, 0), left + len(state))
    usable[there] &= ~hidden[seen]
    rim = window.visible_rim(state, rows, near, left, top)
    share = hidden_share(apart[near[1:]], radius, rows["radius_px"][near[1:]])
    if rim <= _MIN_RIM_SHARE or share.max(initial=0.0) == 1.0:  # of a rim that is hidden all round, the foot is left
        return np.inf
    return overlap[share > _MOST_HIDDEN].max(initial=0.0)


def _hull_of_metal(metal: np.ndarray) -> np.ndarray:
    """Return the convex hull (H, W) of what `hide_metal` found, without the margin that `metal` (H, W) has.

    Metal under a bead is not visible: a wire seen on two sides of a bead continues between them.
    """
    side = 2 * window.METAL + 1
    found = cv2.erode(metal.view(np.uint8), cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side)))
    points = cv2.findNonZero(found)
    if points is not None:
        cv2.fillConvexPoly(found, cv2.convexHull(points), 1)
    return found > 0


def hidden_share(apart: np.ndarray, radius: np.ndarray | float, other: np.ndarray) -> np.ndarray:
    """Return the share of a disc's rim that other discs `apart` from it cover, with their margin."""
    cosine = (radius**2 + apart**2 - (other + _MARGIN_PX) ** 2) / (2 * radius * np.maximum(apart, 1e-9))
    return np.arccos(np.clip(cosine, -1.0, 1.0)) / np.pi


def overlap_of(apart: np.ndarray, radius: np.ndarray | float, other: np.ndarray) -> np.ndarray:
    """Return the overlap of discs in units of the smaller radius: 0 where they touch, 2 where one is in the other."""
    return (radius + other - apart) / np.minimum(radius, other)
