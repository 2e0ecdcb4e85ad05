"""Edges of a metal tube and of a hole through it, sub-pixel: the known shape of the metal is shifted to fit profiles.

The light beyond an edge follows from the length in metal, so that an edge is where the metal begins, wherever the light
falls most steeply.
"""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from scipy.ndimage import gaussian_filter, gaussian_filter1d, map_coordinates

from sightline.common.fitting import MAD_TO_SD
from sightline.errors import UnusableInputError, WireRefusedError
from sightline.imaging import Radiograph

# Attenuation at 40, 50 and 60 keV, 1/mm, and the energies' shares behind 20 cm of tissue, as in wire_model.py
# [physics.md, C-arm; calc].
PER_MM = {"steel": (3.03, 1.60, 1.01), "titanium": (0.941, 0.527, 0.328)}
_SHARE = np.array([0.22, 0.39, 0.39])
_BLURS_PX = (0.6, 0.8, 1.0, 1.25, 1.6, 2.0, 2.5)  # s.d. of detector and focal spot that are tried
_STEP_PX = 0.5  # of samples along a profile
# S.d. of errors that the points of one edge share, from blur, scatter and spectrum that differ from the model, px
# [twin; rims: 50 nails whose rays another projector cast].
OUTLINE_COMMON_PX, RIM_COMMON_PX = 0.15, 0.15
_MODEL_PX = 0.1  # s.d. of each point without noise: structure beside the edge [twin]
# Variance of a fit over that of independent samples, 0.5 px apart: of an outline's piece, and of a rim's point [twin].
_CORRELATED, _CORRELATED_RIM = 4.0, 20.0
_OUTLINE_WINDOW = 8.0  # px: what is fitted to either side
# How far a stroke may be off: px, and where no edge is there, diameters of the tube, as a hand aims at a whole image on
# a screen, whose pixels are several of the image's. Beyond half of it begins the other edge [ours].
_OUTLINE_REACH_PX, _OUTLINE_REACH = 8.0, 0.35
_PIECE_PX = 16.0  # length of edge for each point
_MIN_PIECES = 5
_DRAW = "draw it along the edge, nearer than a third of the nail's width"
_FAR_OFF = 4.0  # s.d. from the parabola through an outline's points
_CLEAR_PX = 2.0  # from an edge to light that it does not shape
# Fall of the light across an outline, over its mean and over the s.d. on either side, medians of all pieces: nails in
# 50 images 0.41 and 11.8 or more, images without an edge 0.03 and 1.1 or less [twin].
_MIN_FALL, _MIN_FALL_SD = 0.1, 4.0
_RIM_WINDOW_PX = 6.0
_PROFILE_PX = np.arange(-9.0, 9.0 + _STEP_PX / 2, _STEP_PX)  # across a rim
_CONTRAST = (0.4, 2.0)  # of a rim's point, over the median of all
_MAX_SHIFT_PX = 5.0
_TANGENTIAL_PX = (-1.0, 0.0, 1.0)  # profiles beside each other that are averaged


@dataclass(frozen=True, eq=False)
class MetalEdge:
    """Points of one edge: `uv_px` (N, 2), `variance_px2` (N,) across it; `common_px`: s.d. of what all points share.

    `misfit`: of the light across it, in squared stored values.
    """

    uv_px: np.ndarray
    variance_px2: np.ndarray
    common_px: float
    misfit: float


@dataclass(frozen=True)
class MetalTube:
    """A tube as an image shows it: outer diameter and bore, px; scale, mm/px; `hardness` as for `transmission`."""

    diameter_px: float
    bore_px: float
    mm_per_px: float
    material: str
    hardness: float


class RimsExpected(Protocol):
    """Points of rims in an image, and the lengths in metal around them."""

    @property
    def uv_px(self) -> np.ndarray:
        """(N, 2)."""
        ...

    @property
    def normal(self) -> np.ndarray:
        """(N, 2) unit vectors, towards metal."""
        ...

    @property
    def metal_mm(self) -> np.ndarray:
        """(H, W) on a grid."""
        ...

    @property
    def corner_px(self) -> np.ndarray:
        """(2,) first pixel of the grid."""
        ...


def transmission(metal_mm: np.ndarray, material: str, hardness: float) -> np.ndarray:
    """Return the share (...) of the primary light behind lengths (...) of metal, "titanium" or "steel".

    `hardness`: attenuation over that of PER_MM; smaller for a higher tube voltage. Raises UnusableInputError.
    """
    if material not in PER_MM:
        raise UnusableInputError(f"there is no metal {material!r}; there are: {', '.join(PER_MM)}")
    share_left = np.zeros(np.shape(metal_mm))
    for per_mm, share in zip(PER_MM[material], _SHARE, strict=True):
        share_left += share * np.exp(-hardness * per_mm * metal_mm)
    return share_left


def find_outline(image: Radiograph, stroke_px: np.ndarray, inside_px: np.ndarray, tube: MetalTube) -> MetalEdge:
    """Return the edge of a tube along a stroke of two clicks (2, 2), at most a third of the tube's diameter away; the
    tube lies towards `inside_px` (2,).

    An edge within 8 px takes precedence. Raises UnusableInputError; WireRefusedError where there is no edge.
    """
    try:
        return _outline_within(_OUTLINE_REACH_PX, image, stroke_px, inside_px, tube)
    except WireRefusedError:
        wide = _OUTLINE_REACH * tube.diameter_px
        if wide <= _OUTLINE_REACH_PX:
            raise
        return _outline_within(wide, image, stroke_px, inside_px, tube)


def _outline_within(
    reach_px: float, image: Radiograph, stroke_px: np.ndarray, inside_px: np.ndarray, tube: MetalTube
) -> MetalEdge:
    first, last = np.asarray(stroke_px, dtype=np.float64)
    length = float(np.linalg.norm(last - first))
    pieces = int(length / _PIECE_PX)
    if not np.isfinite(length) or pieces < _MIN_PIECES:
        raise UnusableInputError(
            f"a stroke along the nail is {length:.0f} px long (at least {_MIN_PIECES * _PIECE_PX:.0f} px are needed); "
            "draw it longer"
        )
    along = (last - first) / length
    normal = np.array([-along[1], along[0]])
    normal *= np.sign((np.asarray(inside_px) - first) @ normal)
    s = (np.arange(pieces) + 0.5) * length / pieces
    reach = reach_px + _OUTLINE_WINDOW + 2.0
    t = np.arange(-reach, reach + _STEP_PX / 2, _STEP_PX)
    beside = np.arange(-_PIECE_PX / 2 + 0.5, _PIECE_PX / 2)
    at = first + (s[:, None] + beside)[:, :, None, None] * along + t[:, None] * normal
    profiles = _light(image, at).mean(axis=1)
    offset, variance, misfit = min(
        (_outline_offsets(profiles, t, tube, blur) for blur in _BLURS_PX), key=lambda fit: fit[2]
    )
    _refuse_no_fall(profiles, t, offset)
    kept, spread = np.isfinite(offset), _MODEL_PX
    for _ in range(3):
        if kept.sum() < _MIN_PIECES:
            raise WireRefusedError(f"no edge of a nail lies along a stroke; {_DRAW}")
        rest = offset - np.polynomial.Polynomial.fit(s[kept], offset[kept], 2)(s)
        spread = max(MAD_TO_SD * float(np.median(np.abs(rest[kept]))), _MODEL_PX)
        kept = np.isfinite(offset) & (np.abs(rest) < _FAR_OFF * spread)
    variance = np.maximum(variance, spread**2)[kept]
    uv = first + s[kept, None] * along + offset[kept, None] * normal
    return MetalEdge(uv, variance, OUTLINE_COMMON_PX, misfit)


def _refuse_no_fall(profiles: np.ndarray, t: np.ndarray, offset: np.ndarray) -> None:
    """Raise WireRefusedError where the light does not fall across the edge found in profiles (P, T), at `offset` (P,):
    something fits best in noise, too."""
    known = np.isfinite(offset)
    away = t - offset[known, None]
    sides = [
        np.where((sign * away > _CLEAR_PX) & (sign * away < _OUTLINE_WINDOW), profiles[known], np.nan)
        for sign in (-1, 1)
    ]
    if not known.any():
        raise WireRefusedError(f"no edge of a nail lies along a stroke; {_DRAW}")
    outside, inside = (np.nanmean(side, axis=1) for side in sides)
    level, sd = (outside + inside) / 2, np.hypot(*(np.nanstd(side, axis=1) for side in sides)) / np.sqrt(2)
    fall = float(np.median((outside - inside) / np.maximum(level, 1e-9)))
    clear = float(np.median((outside - inside) / np.maximum(sd, 1e-9)))
    if fall < _MIN_FALL or clear < _MIN_FALL_SD:
        raise WireRefusedError(
            f"no edge of a nail lies along a stroke: across it the light falls by {max(fall, 0.0):.0%}, "
            f"{max(clear, 0.0):.1f} times its scatter (at least {_MIN_FALL:.0%} and {_MIN_FALL_SD:g} times are "
            f"needed); {_DRAW}"
        )


def find_rims(  # noqa: PLR0917
    image: Radiograph,
    expected: RimsExpected,
    grid_px: float,
    material: str,
    hardness: float,
    blur_px: float | None = None,
) -> "RimsFound":
    """Return the expected rims where the image shows them, at most 5 px away; points that it does not show are NaN.

    The expected light is blurred in the plane of the image: near the corners of a lens both rims shape each profile.
    `grid_px`: step of the expected grid; `hardness` as for `transmission`. `blur_px`: s.d. of the image's blur; by
    default the one of seven that fits best.
    """
    uv, normal, blurs = expected.uv_px, expected.normal, _BLURS_PX if blur_px is None else (blur_px,)
    if not len(uv):
        return RimsFound(uv, np.zeros(0), np.inf)
    tangent = np.stack([-normal[:, 1], normal[:, 0]], axis=-1)
    beside = np.array(_TANGENTIAL_PX)[:, None, None, None] * tangent[:, None]
    at = uv[:, None] + _PROFILE_PX[:, None] * normal[:, None] + beside
    seen = _light(image, at).mean(axis=0)
    sharp = transmission(expected.metal_mm, material, hardness)
    on_grid = np.moveaxis((at - expected.corner_px) / grid_px, -1, 0)[::-1]

    blurred = (gaussian_filter(sharp, blur / grid_px, mode="nearest") for blur in blurs)
    models = [map_coordinates(model, on_grid, order=1, mode="nearest").mean(axis=0) for model in blurred]
    shift, variance, misfit = _rim_shifts(seen, np.stack(models))
    best = int(misfit.argmin())
    return RimsFound(uv + shift[best][:, None] * normal, variance[best], float(misfit[best]))


@dataclass(frozen=True, eq=False)
class RimsFound:
    """`uv_px` (N, 2), NaN where not seen; `variance_px2` (N,) across the rim; `misfit` as of a `MetalEdge`."""

    uv_px: np.ndarray
    variance_px2: np.ndarray
    misfit: float

    def edge(self, chosen: np.ndarray) -> MetalEdge:
        """Return the points that are `chosen` (N,) and seen."""
        kept = chosen & np.isfinite(self.uv_px[:, 0])
        return MetalEdge(self.uv_px[kept], self.variance_px2[kept], RIM_COMMON_PX, self.misfit)


def agreement(image: Radiograph, uv_px: np.ndarray, metal_mm: np.ndarray, material: str, hardness: float) -> np.ndarray:
    """Return the correlation (K,) of the light at pixels (..., 2) with that behind lengths in metal (K, ...)."""
    seen = _light(image, uv_px).ravel()
    model = transmission(metal_mm, material, hardness).reshape(len(metal_mm), -1)
    seen, model = seen - seen.mean(), model - model.mean(axis=1, keepdims=True)
    return model @ seen / np.maximum(np.linalg.norm(model, axis=1) * np.linalg.norm(seen), 1e-12)


def _light(image: Radiograph, uv_px: np.ndarray) -> np.ndarray:
    """Return the stored values (...) at pixels (..., 2), bilinear; the border repeats."""
    low = np.clip(np.floor(uv_px.reshape(-1, 2).min(axis=0)).astype(int) - 1, 0, None)
    high = np.ceil(uv_px.reshape(-1, 2).max(axis=0)).astype(int) + 2
    part = image.pixels[low[1] : high[1], low[0] : high[0]].astype(np.float64)
    if min(part.shape) < 2:
        raise UnusableInputError("a click lies outside the image; click the nail again")
    at = np.moveaxis(uv_px - low, -1, 0)[::-1]
    return map_coordinates(part, at, order=1, mode="nearest")


def _outline_offsets(
    profiles: np.ndarray, t: np.ndarray, tube: MetalTube, blur_px: float
) -> tuple[np.ndarray, np.ndarray, float]:
    """Return offsets (P,) of the edge in profiles (P, T), NaN where there is none, their variance, and a cost."""
    half = round(_OUTLINE_WINDOW / _STEP_PX)
    u = _STEP_PX * np.arange(-half, half + 1)
    fine = np.arange(-_OUTLINE_WINDOW - 8.0, _OUTLINE_WINDOW + 8.0, 0.1)
    inside = np.clip(fine, 0.0, None)
    chord = 2 * np.sqrt(np.maximum(inside * (tube.diameter_px - inside), 0.0))
    deep = np.clip(inside - (tube.diameter_px - tube.bore_px) / 2, 0.0, None)
    chord -= 2 * np.sqrt(np.maximum(deep * (tube.bore_px - deep), 0.0))
    blurred = gaussian_filter1d(transmission(chord * tube.mm_per_px, tube.material, tube.hardness), blur_px / 0.1)
    model, slope = (np.interp(u, fine, column) for column in (blurred, np.gradient(blurred, 0.1)))
    basis = np.stack([np.ones_like(u), model, u * model], axis=-1)
    away = np.eye(len(u)) - basis @ np.linalg.pinv(basis)
    starts = np.arange(len(t) - len(u) + 1)
    windows = profiles[:, starts[:, None] + np.arange(len(u))]
    cost = ((windows @ away) ** 2).sum(axis=-1)
    light = windows @ np.linalg.pinv(basis)[1]
    falls = light > 0.3 * np.median(light.max(axis=1))
    best = np.where(falls, cost, np.inf).argmin(axis=1)
    known = np.isfinite(np.where(falls, cost, np.inf).min(axis=1))
    middle = t[starts + half][best]
    full = np.column_stack([basis, -slope])
    solver = np.linalg.pinv(full)

    def fitted(offset: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        own = np.stack([np.interp(o + u, t, row) for o, row in zip(offset, profiles, strict=True)])
        return own, own @ solver.T

    offset = middle
    for _ in range(3):
        _, fit = fitted(offset)
        offset = offset + np.clip(fit[:, 3] / _not_zero(fit[:, 1]), -1.0, 1.0)
    own, fit = fitted(offset)
    rest = ((own - fit @ full.T) ** 2).sum(axis=1)
    variance = _CORRELATED * rest / (len(u) - 4) * (solver[3] ** 2).sum() / _not_zero(fit[:, 1]) ** 2
    known &= np.abs(offset - middle) < 2.0
    typical = float(np.median(rest[known])) if known.any() else np.inf
    return np.where(known, offset, np.nan), variance + _MODEL_PX**2, typical


def _not_zero(values: np.ndarray) -> np.ndarray:
    return np.where(np.abs(values) > 1e-9, values, 1e-9)


def _rim_shifts(seen: np.ndarray, models: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return shifts (B, N) of profiles (N, M) of light against those of B models (B, N, M), NaN where they disagree,
    variances (B, N), and costs (B,)."""
    window = np.flatnonzero(np.abs(_PROFILE_PX) <= _RIM_WINDOW_PX)
    seen, around = seen[:, window], np.arange(window[0] - 1, window[-1] + 2)

    def fitted(shift: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        steps = np.floor(-shift / _STEP_PX)
        share = -shift / _STEP_PX - steps
        at = around + steps.astype(int)[..., None]
        low, high = (
            np.take_along_axis(models, np.clip(at + values, 0, models.shape[-1] - 1), axis=-1) for values in (0, 1)
        )
        moved = low + share[..., None] * (high - low)
        slope = (moved[..., 2:] - moved[..., :-2]) / (2 * _STEP_PX)
        basis = np.stack([np.ones_like(slope), moved[..., 1:-1], -slope], axis=-1)
        turned = np.swapaxes(basis, -1, -2)
        inverse = np.linalg.inv(turned @ basis + 1e-9 * np.eye(3))
        return basis, inverse, (inverse @ (turned @ seen[..., None]))[..., 0]

    shift = np.zeros(models.shape[:2])
    for _ in range(3):
        fit = fitted(shift)[2]
        shift = shift + np.clip(fit[..., 2] / _not_zero(fit[..., 1]), -1.5, 1.5)
    basis, inverse, fit = fitted(shift)
    light = fit[..., 1]
    rest = ((seen - (basis @ fit[..., None])[..., 0]) ** 2).sum(axis=-1)
    usual, typical = (np.median(values, axis=-1, keepdims=True) for values in (light, rest))
    noise = np.maximum(rest, typical) / (len(window) - 3)  # a rest below the usual one is chance
    variance = _CORRELATED_RIM * noise * inverse[..., 2, 2] / _not_zero(light) ** 2 + _MODEL_PX**2
    shown = (light > _CONTRAST[0] * usual) & (light < _CONTRAST[1] * usual) & (np.abs(shift) < _MAX_SHIFT_PX)
    return np.where(shown, shift, np.nan), variance, typical[:, 0]
