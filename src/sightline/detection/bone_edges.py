"""Edges of bones, sub-pixel: where the lines of sight begin to pass through bone, near a drawn curve.

Beside a line of sight that touches a smooth surface, the length in bone grows with the square root of the distance from
the edge. The logarithm of the image falls in the same way, over a background that is straight within some pixels;
behind the cortex a second root begins. So the edge is where the first root begins. The image is steepest further
inside, by its blur. The mean profile along the curve shows where the root begins. Each sector of the curve shows how
far it is from the mean.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import gaussian_filter1d, map_coordinates, uniform_filter1d

from sightline.common.fitting import MAD_TO_SD
from sightline.detection.log_image import field_inset
from sightline.errors import UnusableInputError
from sightline.imaging import Radiograph

REACH_PX = 12.0  # how far from a drawn curve the edge is searched
# S.d. by which a bone's outline is not of its shape, over its radius: a head blends into the neck by 0.1 to 0.3 mm of
# 20 to 25, a shaft's borders are so far from straight [twin].
UNEVEN = 0.008
_WINDOW_PX, _STEP_PX = 14.0, 0.5  # what is fitted to either side of the edge; step of samples
_PIECE_PX, _MIN_PIECES = 6.0, 20  # length of the curve for each profile, shorter for so many of them
_STEP_WIDTH_PX = 5.0  # on either side, of the means whose difference shows where an edge may be
_CLIP = 2.5  # typical differences: beads and wires do not count more
_OTHER_PX = 5.0  # distance from which an edge beside it is another one
_DIP = 0.7  # of the support between two edges, over that of the weaker one
_MIN_SUPPORT = 0.45  # mean difference along the curve, in typical ones [twin]
_MAX_SECOND = 0.75  # support of another edge over that of the best, where they are apart [twin]
_BLURS_PX = (1.0, 1.5, 2.0, 2.5, 3.0, 4.0, 5.0)  # s.d. of detector, focal spot and surface that are tried
_SHELLS_PX = (4.0, 5.0, 6.0, 7.0, 8.0, 9.0, 10.0, 12.0, 15.0)  # widths of the cortex as the image shows it
_SECTORS = 24  # parts of the curve, whose scatter about a smooth curve is the noise
_MIN_SECTORS = 12
_CONTRAST = (0.3, 3.0)  # of a sector, over that of the mean profile
_FAR_OFF = 3.0  # s.d. of the sectors from the smooth curve through them
_LEFT_OUT = 6  # arcs of the jackknife, one of which is left out each time
_ROUNDS = 4
_BEGIN_PX = 7.0  # largest distance of the root's beginning from where the image is steepest
# S.d. of errors that all points of an edge share, over the blur: of where the root begins in the mean profile [twin].
_COMMON = 0.26
_MAX_FALLS = 2.5  # ratio of both borders' falls of brightness; a block's edge falls more than a bone's [twin]
_MIN_BEGIN_PX = 0.75  # by which a round bone begins outside of the clearest fall, unlike the step of a block [twin]


@dataclass(frozen=True, eq=False)
class BoneEdge:
    """An edge near a drawn curve: K places `at` (K,) among the curve's points, the edge's distance from them inwards,
    `offset_px` (K,), and its covariance `covariance_px2` (K, K).

    `begin_px`: how far inwards of the clearest fall of brightness the edge lies; below zero where it begins outside of
    it, as of a round bone. `fall`: of the logarithm of the image across the edge.
    """

    at: np.ndarray
    offset_px: np.ndarray
    covariance_px2: np.ndarray
    begin_px: float
    fall: float


class NoBoneEdgeError(UnusableInputError):
    """The image shows no edge near the curve, or two."""


def find_bone_edge(
    image: Radiograph, uv_px: np.ndarray, inward: np.ndarray, shape: np.ndarray, smooth: np.ndarray
) -> BoneEdge:
    """Return the edge near a curve through N points `uv_px` (N, 2), about a pixel apart, with bone towards `inward`
    (N, 2), at most 12 px away.

    `shape` (N, k): how the drawing may be wrong, as offsets of the points for k unit errors, each at most one; `smooth`
    (N, m): other forms that the offsets of a true edge may have. Raises NoBoneEdgeError.
    """
    pitch = float(np.median(np.linalg.norm(np.diff(uv_px, axis=0), axis=1)))
    every = max(min(round(_PIECE_PX / pitch), len(uv_px) // _MIN_PIECES), 1)
    rows = np.arange(len(uv_px) // every * every).reshape(-1, every)
    t = np.arange(-REACH_PX - _WINDOW_PX - 4, REACH_PX + _WINDOW_PX + 4 + _STEP_PX / 2, _STEP_PX)
    profiles = _logs(image, uv_px[rows][:, :, None] + t[:, None] * inward[rows][:, :, None]).mean(axis=1)
    seen = np.isfinite(profiles).all(axis=1)
    profiles, middle = profiles[seen], rows[seen, every // 2]
    if len(middle) < len(rows) / 2:
        raise NoBoneEdgeError("the field does not reach around most of it; draw it where the image shows it")
    forms = np.column_stack([shape, smooth])[middle]
    offset = _position(profiles, t, shape[middle])
    edge = _refined(profiles, t, offset, forms, middle, middle * _SECTORS // len(uv_px))
    drawn = shape[edge.at]
    return replace(edge, covariance_px2=edge.covariance_px2 + drawn @ _jackknife(drawn, edge.offset_px) @ drawn.T)


def points_of_border(ends: np.ndarray, other: np.ndarray, least_px: float) -> tuple[np.ndarray, ...]:
    """Return points (N, 2), px, about a pixel apart on a border drawn from end to end (2, 2), the unit vector (2,) from
    it towards the `other` border, and the points' places (N,) along it, from -1 to 1.

    Raises NoBoneEdgeError where it is shorter than `least_px`.
    """
    way = ends[1] - ends[0]
    length = float(np.linalg.norm(way))
    if length < least_px:
        raise NoBoneEdgeError(f"a border is {length:.0f} px long (at least {least_px:.0f} px are needed)")
    inward = np.array([-way[1], way[0]]) / length
    inward *= np.sign(inward @ (other.mean(axis=0) - ends.mean(axis=0)))
    along = np.linspace(-1.0, 1.0, int(length) + 1)
    return ends.mean(axis=0) + along[:, None] * way / 2, inward, along


def common_begin(first: BoneEdge, second: BoneEdge) -> float:
    """Return where the edges at both borders of a bone begin, px from their clearest falls.

    Raises NoBoneEdgeError where they are not those of one round bone.
    """
    falls = sorted((first.fall, second.fall))
    if falls[1] > _MAX_FALLS * falls[0]:
        raise NoBoneEdgeError(
            f"the brightness falls {falls[1] / falls[0]:.1f} times as much at one border as at the other (at most "
            f"{_MAX_FALLS:g} times), so one is not the bone's; draw the borders beside another part, or keep them"
        )
    if max(first.begin_px, second.begin_px) > -_MIN_BEGIN_PX:
        raise NoBoneEdgeError(
            "the edge near a border does not begin like that of a round bone; it may be a block's or a plate's; draw "
            "the borders beside another part, or keep them"
        )
    return (first.begin_px + second.begin_px) / 2


def _logs(image: Radiograph, uv_px: np.ndarray) -> np.ndarray:
    """Return the logarithm of the image (...) at pixels (..., 2), bilinear; NaN outside the field."""
    at = np.moveaxis(uv_px, -1, 0)[::-1]
    low = np.clip(np.floor(at.reshape(2, -1).min(axis=1)).astype(int) - 1, 0, None)
    high = np.ceil(at.reshape(2, -1).max(axis=1)).astype(int) + 2
    part = slice(low[0], max(high[0], 0)), slice(low[1], max(high[1], 0))
    logs = np.where(field_inset(image)[part], np.log(np.maximum(image.pixels[part], 0.5)), np.nan)
    if min(logs.shape) < 2:
        raise NoBoneEdgeError("it lies outside the image; draw it where the image shows it")
    moved = at - low.reshape(2, *(1,) * (at.ndim - 1))
    return map_coordinates(logs.astype(np.float64), moved, order=1, mode="constant", cval=np.nan)


def _position(profiles: np.ndarray, t: np.ndarray, shape: np.ndarray) -> np.ndarray:
    """Return the offsets (P,) of the whole curve, moved as it may be drawn wrongly, that most of the profiles support.

    Raises NoBoneEdgeError where too few do, or about as many another position.
    """
    width = round(_STEP_WIDTH_PX / _STEP_PX)
    mean = uniform_filter1d(profiles, width, axis=1)
    darker = np.roll(mean, width // 2 + 1, axis=1) - np.roll(mean, -width // 2, axis=1)
    gain = np.clip(darker / max(MAD_TO_SD * float(np.median(np.abs(darker))), 1e-9), -_CLIP, _CLIP)
    steps = np.arange(-REACH_PX, REACH_PX + 0.5)
    grid = np.stack(np.meshgrid(*[steps] * shape.shape[1], indexing="ij"), axis=-1).reshape(-1, shape.shape[1])
    moved = grid @ shape.T
    moved = moved[np.abs(moved).max(axis=1) <= REACH_PX]
    support = _mean_at(gain, (moved - t[0]) / _STEP_PX)
    best = int(support.argmax())
    if support[best] < _MIN_SUPPORT:
        raise NoBoneEdgeError(f"no edge of a bone is clear within {REACH_PX:.0f} px of it; draw it nearer, or keep it")
    for side in (-1.0, 1.0):
        room = REACH_PX - side * float(moved[best].mean())
        if room <= _OTHER_PX:
            continue
        along = _mean_at(gain, (moved[best] + side * np.arange(0.0, room)[:, None] - t[0]) / _STEP_PX)
        far = along[int(_OTHER_PX) :].argmax() + int(_OTHER_PX)
        if along[far] > _MAX_SECOND * support[best] and along[:far].min() < _DIP * along[far]:
            raise NoBoneEdgeError("two edges near it are about equally clear; draw it nearer to one, or keep it")
    return moved[best]


def _mean_at(gain: np.ndarray, index: np.ndarray) -> np.ndarray:
    """Return the means (H,) of a gain (P, T) at places (H, P) in its rows."""
    return gain[np.arange(len(gain)), np.round(index).astype(int)].mean(axis=1)


def _refined(  # noqa: PLR0917
    profiles: np.ndarray, t: np.ndarray, offset: np.ndarray, forms: np.ndarray, middle: np.ndarray, sector: np.ndarray
) -> BoneEdge:
    """Return the edge in sectors, from the offsets (P,) of the whole curve."""
    u = np.arange(-_WINDOW_PX, _WINDOW_PX + _STEP_PX / 2, _STEP_PX)
    straight = np.column_stack([np.ones_like(u), u])
    level = np.eye(len(u)) - straight @ np.linalg.pinv(straight)
    each = [np.flatnonzero(sector == k) for k in range(_SECTORS)]
    each = [rows for rows in each if len(rows)]
    form = np.array([forms[rows].mean(axis=0) for rows in each])
    kept = np.ones(len(each), dtype=bool)
    usual, now, by_form = np.zeros(len(u)), np.zeros(len(each)), np.zeros(forms.shape[1])
    for _ in range(_ROUNDS):
        own = np.stack([np.interp(o + u, t, row) for o, row in zip(offset, profiles, strict=True)]) @ level
        parts = np.array([np.median(own[rows], axis=0) for rows in each])
        usual = np.median(parts[kept], axis=0)
        solver = np.linalg.pinv(np.column_stack([straight, usual, -np.gradient(usual, _STEP_PX)]))
        fit = parts @ solver.T
        shown = (fit[:, 2] > _CONTRAST[0]) & (fit[:, 2] < _CONTRAST[1])
        step = np.where(shown, fit[:, 3] / np.where(shown, fit[:, 2], 1.0), 0.0)
        now = np.array([offset[rows].mean() for rows in each]) + np.clip(step, -2.0, 2.0)
        by_form, kept = _smooth(form, now, shown)
        offset = np.clip(forms @ by_form, -REACH_PX - 4, REACH_PX + 4)
    begin, blur = _beginning(usual, u)
    scatter = float(((now - form @ by_form)[kept] ** 2).sum() / (kept.sum() - form.shape[1]))
    at = np.array([int(np.median(middle[rows])) for rows in each])[kept]
    covariance = scatter * np.eye(len(at)) + (_COMMON * blur) ** 2
    return BoneEdge(at, now[kept] + begin, covariance, begin, float(np.ptp(usual)))


def _jackknife(shape: np.ndarray, offset_px: np.ndarray) -> np.ndarray:
    """Return the covariance (k, k) of a shape's coefficients from fits that each leave out one arc of an edge.

    It is the error of the shape as a model: a bone is not quite round or straight.
    """
    arc = np.arange(len(offset_px)) * _LEFT_OUT // len(offset_px)
    fits = [np.linalg.lstsq(shape[arc != k], offset_px[arc != k], rcond=None)[0] for k in range(_LEFT_OUT)]
    return (_LEFT_OUT - 1) * np.cov(np.array(fits).T, bias=True)


def _smooth(form: np.ndarray, values: np.ndarray, shown: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the robust fit (m,) of forms (K, m) to values (K,), and which of those `shown` (K,) it keeps.

    Raises NoBoneEdgeError.
    """
    if shown.sum() >= _MIN_SECTORS:
        fit, weight, away, spread = np.zeros(form.shape[1]), shown.astype(float), np.abs(values), np.inf
        for _ in range(20):
            root = np.sqrt(weight)
            fit = np.linalg.lstsq(form * root[:, None], values * root, rcond=None)[0]
            away = np.abs(values - form @ fit)
            spread = max(MAD_TO_SD * float(np.median(away[shown])), 0.15)
            weight = shown / (1.0 + (away / spread) ** 2) ** 2
        kept = shown & (away < _FAR_OFF * spread)
        if kept.sum() >= _MIN_SECTORS:
            return np.linalg.lstsq(form[kept], values[kept], rcond=None)[0], kept
    raise NoBoneEdgeError("an edge is clear over too little of it; draw it where it is, or keep it")


def _beginning(usual: np.ndarray, u: np.ndarray) -> tuple[float, float]:
    """Return where the root begins in a mean profile (T,), px from its middle, and the s.d. of the blur."""
    fine = np.arange(-_WINDOW_PX - 24, _WINDOW_PX + 24, 0.1)
    begins = np.arange(-_BEGIN_PX, _BEGIN_PX + 0.01, 0.25)
    best = np.inf, 0.0, 0.0
    for blur in _BLURS_PX:
        first = gaussian_filter1d(np.sqrt(np.clip(fine, 0.0, None)), blur / 0.1)
        for shell in _SHELLS_PX:
            second = np.interp(fine - shell, fine, first)
            roots = [np.interp(u - begins[:, None], fine, form) for form in (first, second)]
            basis = np.stack([np.broadcast_to(form, roots[0].shape) for form in (np.ones_like(u), u, *roots)], axis=-1)
            q, r = np.linalg.qr(basis)
            rest = usual @ usual - ((usual @ q) ** 2).sum(axis=1)
            darker = np.linalg.solve(r[:, 2:, 2:] + 1e-9 * np.eye(2), (usual @ q)[:, 2:, None])[:, 0, 0] < 0.0
            rest = np.where(darker, rest, np.inf)
            if rest.min() < best[0]:
                best = float(rest.min()), float(begins[rest.argmin()]), blur
    if abs(best[1]) >= _BEGIN_PX or not np.isfinite(best[0]):
        raise NoBoneEdgeError("the image does not show where the bone begins there; draw it where it does, or keep it")
    return best[1], best[2]
