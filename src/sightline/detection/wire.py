"""The guide wire in an image: its centre line and its tip, sub-pixel, with covariances from the image's own noise."""

from dataclasses import dataclass
from typing import Protocol

import cv2
import numpy as np
from scipy.ndimage import binary_dilation, gaussian_filter

from sightline.detection.log_image import field_inset, log_image
from sightline.detection.noise import NoiseModel, estimate_noise
from sightline.detection.wire_model import BEND, ImagePath, SteelWire, WireFit, fit_across, fit_tip
from sightline.detection.wire_search import search
from sightline.errors import UnusableInputError, WireRefusedError
from sightline.imaging import Radiograph

POINT_DIAMETERS = 1.5  # length of a trocar point over the wire's diameter [ours]
_PIECE = 3.5  # radii of wire that one point of the centre line is fitted to [ours]
_BESIDE_PX = 14.0  # of background to either side [ours]
_BLUR_PX = 1.2  # where fits start: detector 1.0, focal spot and pixel [physics.md]
_ROUND_BEAD_PX = 2.5  # about a bead: its rim and the blur of that
_LAGS = 14  # px; what lies further apart is not correlated: trabeculae are 8 px wide [twin]
_ODD = 4.5  # s.d. of smoothed residuals: what the wire and its background do not explain [ours]
_SEEN = 0.6  # share of a piece, and of each of its rims, that nothing may cover [ours]
_RIM_PX = 3.0  # to either side of a rim, where a centre is told from
_MODEL_LIGHT = 0.01  # of the light: what the model leaves where there is no noise [ours]
# Standard deviations from the line, and then from the curve, through the others: something else overlies the piece. The
# line is coarse, for a wire may bend; the curve is stricter than the check shot, which a wrong piece fails at 4 [ours].
_FAR_OFF_LINE, _FAR_OFF = 4.0, 3.5
_NOISIEST_PX = 1.0  # a piece less certain than this says nothing [ours]
# What the noise does not tell: backgrounds that bend, glare; s.d. without any noise, px [twin].
_MODEL_ACROSS_PX, _MODEL_TIP_PX = 0.05, 0.4
_FEWEST_PIECES = 6  # and at least half of those looked at [ours]
_FAINTEST = 0.15  # log light; wires have 0.4 and more [twin]
_FOLLOWED = 8  # times the tip's window is moved after it
_MOST_OBLIQUE = 0.3  # sine of the least angle of wire and rays: seen end on, a wire has no direction [ours]
_TIP_SEEN = 0.3  # share of the pixels about the tip that must be usable [ours]
_TIP_BEHIND, _TIP_BEYOND = 5.0, 3.0  # radii about the tip that are fitted [ours]
_OTHER_WIDTH = 0.25  # share by which the width may differ: 3.2 mm for 2.5 mm would pass no more [ours]


class ProjectedWire(Protocol):
    """Where a wire should be: points (M, 2) px in order, from outside to beyond the planned tip."""

    @property
    def uv_px(self) -> np.ndarray:
        """(M, 2), IDCS."""
        ...

    @property
    def along_mm(self) -> np.ndarray:
        """(M,) places along the wire in space."""
        ...

    @property
    def px_per_mm(self) -> np.ndarray:
        """(M,) scale of the image across the wire at the wire's depth."""
        ...

    @property
    def sine(self) -> np.ndarray:
        """(M,) of the angle between wire and rays."""
        ...


@dataclass(frozen=True, eq=False)
class WireShadow:
    """A wire found in one image, IDCS.

    `uv_px` (N, 2): points of its centre line from outside towards the tip; `along` (N, 2): unit tangents there;
    `variance_px2` (N,): across the tangent; along it a point says nothing. `tip_uv_px` (2,), `tip_along` (2,) the unit
    tangent towards it, `tip_variance_px2`: along the tangent. `point_mm`: length of the tip's cone that was assumed, 0
    for a plain end. `width_mm`: measured. `contrast`: change of log light in the middle, negative. `hidden`: share of
    its length where something else overlies it.
    """

    uv_px: np.ndarray
    along: np.ndarray
    variance_px2: np.ndarray
    tip_uv_px: np.ndarray
    tip_along: np.ndarray
    tip_variance_px2: float
    point_mm: float
    width_mm: float
    contrast: float
    hidden: float


def find_wire(  # noqa: PLR0917
    image: Radiograph,
    expected: ProjectedWire,
    diameter_mm: float,
    bead_uv_px: np.ndarray,
    bead_radius_px: np.ndarray,
    point_mm: float | None = None,
) -> WireShadow:
    """The wire within 8 mm and 5° of where it is expected.

    `bead_uv_px` (K, 2), `bead_radius_px` (K,): the frame's beads, found or known, which are left out. `point_mm`:
    length of the conical (trocar) point, 1.5 diameters unless given; 0: a plain end. Raises UnusableInputError, and
    WireRefusedError: no wire there, too faint or hidden, two that compete, a tip that is not seen, another width.
    """
    point = POINT_DIAMETERS * diameter_mm if point_mm is None else point_mm
    path, scale, stretch, sine = _prepared(expected, diameter_mm, point)
    mask = field_inset(image)
    logs = log_image(image, mask)
    noise = estimate_noise(logs, mask)
    if noise is None:
        raise WireRefusedError("the image has no area in which its noise can be measured; give a larger image")
    usable = _without(mask, bead_uv_px, bead_radius_px + _ROUND_BEAD_PX)
    usable &= image.pixels < image.white
    shown = _shown(path, mask)
    path, scale, stretch, sine = ImagePath.through(path.uv_px[shown]), scale[shown], stretch[shown], sine[shown]
    found = search(logs, usable, path, scale * diameter_mm / 2, scale)
    radius = float(np.median(scale)) * diameter_mm / 2
    here = int(np.clip(found.expected_tip_s_px, 0, len(scale) - 1))
    point_px = point * float(stretch[here])
    end = found.tip_s_px - point_px - radius
    wire = SteelWire(diameter_mm, point, float(sine[here]), float(stretch[here]))
    strip = _Strip.about(logs, usable, noise, found.path, (wire, radius))
    pieces = strip.pieces(end)
    strip = _Strip.about(logs, usable & ~strip.odd(pieces), noise, _through(found.path, pieces), (wire, radius))
    pieces = strip.pieces(end)
    looked_at = max(int(end / (_PIECE * radius)), 1)
    if len(pieces) < max(_FEWEST_PIECES, looked_at / 2):
        raise WireRefusedError(
            f"only {len(pieces)} of {looked_at} pieces of the wire can be measured, the others are hidden or too "
            "faint; take other metal out of the beam, or expose more"
        )
    width_mm = 2 * float(np.median([piece.fit.values[1] for piece in pieces])) / float(np.median(scale))
    if abs(width_mm / diameter_mm - 1) > _OTHER_WIDTH:
        raise WireRefusedError(
            f"the line found is {width_mm:.1f} mm wide, the wire {diameter_mm:.1f} mm: it is something else, or "
            "another wire is in; give the right diameter"
        )
    correlation = strip.correlation(pieces)
    tip_s, tip_x, tip_variance = _tip(strip, pieces, found.tip_s_px, point_px, correlation)
    on, along, normal = strip.path.at(np.array([piece.s_px for piece in pieces]))
    tip_on, tip_along, tip_normal = strip.path.at(np.array([tip_s]))
    return WireShadow(
        uv_px=on + np.array([piece.fit.values[0] for piece in pieces])[:, None] * normal,
        along=along,
        variance_px2=np.array([strip.variance(piece.pixels, piece.fit.influence[0], correlation) for piece in pieces])
        + _MODEL_ACROSS_PX**2,
        tip_uv_px=(tip_on + tip_x * tip_normal)[0],
        tip_along=tip_along[0],
        tip_variance_px2=tip_variance + _MODEL_TIP_PX**2,
        point_mm=point,
        width_mm=width_mm,
        contrast=float(np.median([piece.fit.contrast for piece in pieces])),
        hidden=1 - len(pieces) / looked_at,
    )


@dataclass(frozen=True, eq=False)
class _Piece:
    """A piece of wire about s: which pixels of the strip it was fitted to, and the fit."""

    s_px: float
    pixels: np.ndarray
    fit: WireFit


@dataclass(frozen=True, eq=False)
class _Strip:
    """The pixels beside a path: their rows and columns (N,), s and x, light, and the s.d. of its noise.

    `radius_px`: of the wire, as expected."""

    path: ImagePath
    wire: SteelWire
    radius_px: float
    usable: np.ndarray
    row: np.ndarray
    column: np.ndarray
    s: np.ndarray
    x: np.ndarray
    light: np.ndarray
    noise: np.ndarray

    @staticmethod
    def about(
        logs: np.ndarray, usable: np.ndarray, noise: NoiseModel, path: ImagePath, wire: tuple[SteelWire, float]
    ) -> "_Strip":
        """As wide as the wire, of a radius in px, and its background."""
        radius = wire[1]
        near = np.zeros(logs.shape, dtype=bool)
        reach = radius + _BESIDE_PX
        for u, v in path.uv_px[:: max(int(radius / 2), 1)]:
            near[
                max(int(v - 1.5 * reach), 0) : int(v + 1.5 * reach), max(int(u - 1.5 * reach), 0) : int(u + 1.5 * reach)
            ] = True
        row, column = np.nonzero(near & usable)
        s, x = path.places(np.stack([column, row], axis=-1).astype(np.float64))
        kept = np.abs(x) < reach
        row, column, s, x = row[kept], column[kept], s[kept], x[kept]
        smooth = gaussian_filter(logs, 2.0)[row, column].astype(np.float64)
        level = float(np.median(smooth))
        light = np.exp(logs[row, column].astype(np.float64) - level)
        return _Strip(
            path, *wire, usable, row, column, s, x, light, np.exp(smooth - level) * np.sqrt(noise.variance(smooth))
        )

    def within(self, first: float, last: float) -> np.ndarray:
        """Pixels with s from `first` to `last`."""
        return np.flatnonzero((self.s >= first) & (self.s < last))

    def pieces(self, end: float) -> list[_Piece]:
        """The pieces from the path's beginning to `end` that can be measured and lie on one curve."""
        step, area = _PIECE * self.radius_px, 2 * _PIECE * self.radius_px * (self.radius_px + _BESIDE_PX)
        out = []
        for first in np.arange(0.0, end - step, step):
            pixels = self.within(first, first + step)
            s, x = self.s[pixels], self.x[pixels]
            rims = [np.count_nonzero(np.abs(x - side * self.radius_px) < _RIM_PX) for side in (-1, 1)]
            if len(pixels) < _SEEN * area or min(rims) < _SEEN * 2 * _RIM_PX * step:
                continue
            fit = fit_across(s, x, self.light[pixels], self.noise[pixels], (0.0, self.radius_px, _BLUR_PX), self.wire)
            sd = float(np.linalg.norm(fit.influence[0]))
            if fit.settled and sd < _NOISIEST_PX and abs(fit.values[0]) < self.radius_px and fit.contrast < -_FAINTEST:
                out.append(_Piece(first + step / 2, pixels, fit))
        return _on_a_curve(out)

    def residuals(self, pieces: list[_Piece]) -> np.ndarray:
        """(N,) light beyond the model over its noise; NaN where no piece is."""
        out = np.full(len(self.s), np.nan)
        for piece in pieces:
            out[piece.pixels] = (self.light[piece.pixels] - piece.fit.model) / self.noise[piece.pixels]
        return out

    def image(self, values: np.ndarray) -> np.ndarray:
        """Values (N,) at their pixels, in the smallest image that holds the strip; 0 elsewhere."""
        out = np.zeros((int(np.ptp(self.row)) + 1, int(np.ptp(self.column)) + 1))
        out[self.row - self.row.min(), self.column - self.column.min()] = values
        return out

    def odd(self, pieces: list[_Piece]) -> np.ndarray:
        """(H, W) pixels that neither wire nor background explain: part of a bead, another wire."""
        rest = self.residuals(pieces)
        known = np.isfinite(rest)
        total, share = (
            gaussian_filter(self.image(a), 1.5) for a in (np.where(known, rest, 0.0), known.astype(np.float64))
        )
        smooth = (total / np.maximum(share, 0.2))[self.row - self.row.min(), self.column - self.column.min()]
        if not known.any():
            return np.zeros(self.usable.shape, dtype=bool)
        spread = 1.4826 * float(np.median(np.abs(smooth[known])))
        spread = max(spread, _MODEL_LIGHT * float(np.median(self.light / self.noise)))
        out = np.zeros(self.usable.shape, dtype=bool)
        far = known & (np.abs(smooth) > _ODD * spread)
        out[self.row[far], self.column[far]] = True
        return binary_dilation(out, iterations=2)

    def correlation(self, pieces: list[_Piece]) -> np.ndarray:
        """(2 L + 1, 2 L + 1) covariance of the residuals by lag: noise, and structure beside the wire."""
        rest = self.residuals(pieces)
        known = np.isfinite(rest)
        values, seen = self.image(np.where(known, rest, 0.0)), self.image(known.astype(np.float64))
        return _products_by_lag(values) / np.maximum(_products_by_lag(seen), 1.0)

    def variance(self, pixels: np.ndarray, influence: np.ndarray, correlation: np.ndarray) -> float:
        """Variance of what depends by `influence` on the light of pixels, in units of its noise."""
        row, column = self.row[pixels], self.column[pixels]
        field = np.zeros((int(np.ptp(row)) + 1, int(np.ptp(column)) + 1))
        field[row - row.min(), column - column.min()] = influence
        return float((_products_by_lag(field) * correlation).sum())


def _products_by_lag(values: np.ndarray) -> np.ndarray:
    """(2 L + 1, 2 L + 1): sums of the products of pixels that lie -L to L rows and columns apart."""
    shape = [length + _LAGS for length in values.shape]
    products = np.fft.irfft2(np.abs(np.fft.rfft2(values, shape)) ** 2, shape)
    lags = np.arange(-_LAGS, _LAGS + 1)
    return products[np.ix_(lags, lags)]


def _on_a_curve(pieces: list[_Piece]) -> list[_Piece]:
    """The pieces that lie on one curve of degree BEND, by their own scatter."""
    kept = _near_one_line(pieces)
    while len(kept) > _FEWEST_PIECES:
        off = _off_the_others(kept)
        spread = max(1.4826 * float(np.median(np.abs(off))), _MODEL_ACROSS_PX)
        worst = int(np.abs(off).argmax())
        if abs(off[worst]) < _FAR_OFF * spread:
            break
        kept = kept[:worst] + kept[worst + 1 :]
    return kept


def _near_one_line(pieces: list[_Piece]) -> list[_Piece]:
    """The pieces near the line through two of them that leaves the least median: several wrong pieces at one end would
    bend a curve fitted to all of them, and hide there. A bend of the whole wire widens the median too."""
    if len(pieces) <= _FEWEST_PIECES:
        return pieces
    s, x = np.array([(piece.s_px, piece.fit.values[0]) for piece in pieces]).T
    first, second = np.triu_indices(len(pieces), 1)
    slope = (x[second] - x[first]) / (s[second] - s[first])
    off = np.abs(x - x[first, None] - slope[:, None] * (s - s[first, None]))
    median = np.median(off, axis=1)
    best = int(median.argmin())
    near = off[best] < _FAR_OFF_LINE * max(1.4826 * float(median[best]), _MODEL_ACROSS_PX)
    return [piece for piece, kept in zip(pieces, near, strict=True) if kept]


def _off_the_others(pieces: list[_Piece]) -> np.ndarray:
    """(N,) px: each piece from the curve through all others (residuals over one less their leverage)."""
    s, x = np.array([(piece.s_px, piece.fit.values[0]) for piece in pieces]).T
    design = np.polynomial.polynomial.polyvander((s - s.mean()) / np.ptp(s), BEND)
    hat = design @ np.linalg.pinv(design)
    return (x - hat @ x) / (1.0 - np.diag(hat))


def _curve(pieces: list[_Piece]) -> np.polynomial.Polynomial:
    """Offset over s."""
    s, x = np.array([(piece.s_px, piece.fit.values[0]) for piece in pieces]).T
    return np.polynomial.Polynomial.fit(s, x, BEND)


def _through(path: ImagePath, pieces: list[_Piece]) -> ImagePath:
    """The path, moved onto the pieces; beyond them straight on."""
    if len(pieces) < _FEWEST_PIECES:
        raise WireRefusedError(
            f"only {len(pieces)} pieces of the wire can be measured, the others are hidden or too faint; "
            "take other metal out of the beam, or expose more"
        )
    curve, last = _curve(pieces), pieces[-1].s_px
    offset = curve(np.minimum(path.s_px, last)) + curve.deriv()(last) * np.maximum(path.s_px - last, 0.0)
    return path.moved(offset)


def _tip(
    strip: _Strip, pieces: list[_Piece], near_px: float, point_px: float, correlation: np.ndarray
) -> tuple[float, float, float]:
    """s and x of the tip, and the variance of s. Raises WireRefusedError."""
    radius, blur = (float(np.median([piece.fit.values[k] for piece in pieces[-6:]])) for k in (1, 2))
    for _ in range(_FOLLOWED):
        pixels = strip.within(near_px - point_px - _TIP_BEHIND * radius, near_px + _TIP_BEYOND * radius)
        s, x, light, noise = (a[pixels] for a in (strip.s, strip.x, strip.light, strip.noise))
        about = np.count_nonzero((np.abs(s - near_px) < radius) & (np.abs(x) < radius))
        if about < _TIP_SEEN * 4 * radius**2:
            break
        fit = fit_tip(s, x, light, noise, (near_px, 0.0), strip.wire, (radius, blur))
        moved, near_px = float(fit.values[0]) - near_px, float(fit.values[0])
        if fit.settled and abs(moved) < 1.0:
            variance = strip.variance(pixels, fit.influence[0], correlation)
            return near_px, float(fit.values[1]), variance
    raise WireRefusedError(
        "the wire's tip is hidden by a bead or other metal, or cannot be told from what lies behind it; move the "
        "C-arm a little and take the image again"
    )


def _prepared(
    expected: ProjectedWire, diameter_mm: float, point_mm: float
) -> tuple[ImagePath, *tuple[np.ndarray, ...]]:
    """The expected path in steps of a pixel; on it the scale across and along the wire, px/mm, and the sine."""
    uv = np.asarray(expected.uv_px, dtype=np.float64)
    along, scale, sine = (
        np.asarray(a, dtype=np.float64) for a in (expected.along_mm, expected.px_per_mm, expected.sine)
    )
    if uv.ndim != 2 or uv.shape[1] != 2 or len(uv) < 2 or not along.shape == scale.shape == sine.shape == (len(uv),):
        raise UnusableInputError(
            "an expected wire needs points (M, 2) with a place, a scale and a sine (M,) each, M from 2"
        )
    if not (np.isfinite(uv).all() and (np.diff(along) > 0).all() and (scale > 0).all()):
        raise UnusableInputError("an expected wire's points must be finite, in order, and its scales positive")
    if not (np.isfinite(diameter_mm) and diameter_mm > 0 and np.isfinite(point_mm) and point_mm >= 0):
        raise UnusableInputError("a wire's diameter must be positive, and the length of its point not negative")
    if sine.min() < _MOST_OBLIQUE:
        raise WireRefusedError("the wire would be seen nearly end on; take the image from another direction")
    rough = ImagePath.through(uv)
    s = np.arange(0.0, rough.s_px[-1])
    stretch = np.gradient(rough.s_px) / np.gradient(along)
    fine = ImagePath.through(np.stack([np.interp(s, rough.s_px, column) for column in uv.T], axis=-1))
    return fine, *(np.interp(s, rough.s_px, a) for a in (scale, stretch, sine))


def _without(mask: np.ndarray, uv_px: np.ndarray, radius_px: np.ndarray) -> np.ndarray:
    """The mask without discs (K, 2) of radii (K,)."""
    covered = np.zeros(mask.shape, np.uint8)
    for (u, v), radius in zip(uv_px, radius_px, strict=True):
        cv2.circle(covered, (round(16 * u), round(16 * v)), round(16 * radius), 1, -1, cv2.LINE_8, 4)
    return mask & (covered == 0)


def _shown(path: ImagePath, mask: np.ndarray) -> slice:
    """The part of a path within the mask. Raises WireRefusedError where there is none to speak of."""
    at = np.rint(path.uv_px).astype(int)
    inside = np.all((at >= 0) & (at < np.array(mask.shape[::-1])), axis=-1)
    u, v = np.where(inside[:, None], at, 0).T
    inside = inside & mask[v, u]
    runs = np.flatnonzero(np.diff(np.concatenate([[False], inside, [False]]).astype(int)))
    if (
        len(runs) == 0
        or (longest := int(np.diff(runs)[::2].argmax()), runs[2 * longest + 1] - runs[2 * longest] < 50)[1]
    ):
        raise WireRefusedError(
            "the planned wire lies outside the image's field; check that the image belongs to this plan"
        )
    return slice(int(runs[2 * longest]), int(runs[2 * longest + 1]))
