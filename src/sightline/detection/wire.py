"""Find the guide wire in an image: centre line and tip, sub-pixel, with variances from the image's noise."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import cv2
import numpy as np
from scipy.ndimage import binary_dilation, gaussian_filter

from sightline.common.fitting import MAD_TO_SD
from sightline.detection.beads.noise import NoiseModel, estimate_noise
from sightline.detection.detector import MAX_SD_PX
from sightline.detection.log_image import field_inset, in_discs, log_image
from sightline.detection.results import Detections
from sightline.detection.wire_model import BEND, ImagePath, SteelWire, WireFit, fit_across, fit_tip
from sightline.detection.wire_search import CORRIDOR_MM, search
from sightline.errors import UnusableInputError, WireRefusedError
from sightline.imaging import Radiograph

POINT_DIAMETERS = 1.5  # [ours] length of a trocar point over the wire's diameter, where none is stated: a usual one
# Length of the pieces, radii; each gives one point of the centre line: along a longer one the background bends. Those
# of drills thicker than _THICK_MM are half as long: beside a nail little of them is seen [ours].
_PIECE, _THICK_MM = 3.5, 2.8
_BLUR_PX = 1.2  # initial value: detector 1.0, focal spot and pixel [physics.md]
_ROUND_BEAD_PX = 2.5  # around a bead: its rim and the blur of that
_LAGS = 14  # px; longest correlation of the residuals: trabeculae are 8 px wide [twin]
_BESIDE_PX = float(_LAGS)  # width of background to either side, as far as residuals correlate
# An outlier has so many s.d. of smoothed residuals, which few have by chance; the s.d. is at least that of the model
# without noise, a share of the light, so that at high dose not all are outliers [ours].
_OUTLIER, _MODEL_LIGHT = 4.5, 0.01
# Shares that must be usable [ours]: of a piece and of each of its rims, and of the pixels around the tip. What covers
# more shifts the fit by its own edges.
_MIN_VISIBLE, _MIN_TIP_VISIBLE = 0.6, 0.3
_RIM_PX = 3.0  # to either side of a rim, the zone that determines the centre
# Outlier limits, s.d. from the line and then from the curve through the other pieces. Another object overlies such a
# piece. The line's limit is coarse, for a wire may bend; the curve's is stricter than the check shot's 4 [ours].
_FAR_OFF_LINE, _FAR_OFF = 4.0, 3.5
# Model errors: s.d. without any noise, from curved backgrounds and glare, px [twin].
_MODEL_ACROSS_PX, _MODEL_TIP_PX = 0.05, 0.4
_MIN_PIECES = 6  # [ours] and at least _MIN_MEASURED of all: of fewer, a wrong one looks like a bent wire
# Of the pieces; beads and bone edges leave 12 to 14 of 25 in good images, and those state their error [twin].
_MIN_MEASURED = 0.4
_MIN_CONTRAST = 0.15  # log light; wires have 0.4 and more [twin]
_MAX_MOVES = 8  # of the window that follows the tip
_MIN_SINE = 0.3  # of the angle between wire and rays: seen end-on, a wire has no direction [ours]
_MAX_TIP_MISFIT = 4.0  # of the tip's light over that of the wire; wrong tips had 5 and more, others rarely 4 [twin]
_TIP_BEHIND = 5.0  # [ours] radii of the wire behind its point that are fitted, for its light; beyond it, _BESIDE_PX
_MIN_SHOWN_PX = 50  # [ours] length of the expected wire inside the field: a shorter stump gives no direction
_MAX_OVERLAP = 0.04  # relative error of a piece's width; of a single wire 0.02, rarely 0.04 [twin]
_MAX_WIDTH_ERROR = 0.25  # relative; refuses a wire of 3.2 mm for one of 2.5 mm, the next sizes [calc]

_FEW_PIECES = (
    "only {} pieces of the wire can be measured, the others are hidden or too faint; take other metal out of the beam, "
    "or expose more"
)


class ProjectedWire(Protocol):
    """Expected projection of a wire: points (M, 2) px in order, from outside to beyond the planned tip."""

    @property
    def uv_px(self) -> np.ndarray:
        """(M, 2), IDCS."""
        ...

    @property
    def along_mm(self) -> np.ndarray:
        """(M,) positions along the wire in space."""
        ...

    @property
    def px_per_mm(self) -> np.ndarray:
        """(M,) scale of the image across the wire at the wire's depth."""
        ...

    @property
    def sine(self) -> np.ndarray:
        """(M,) of the angle between wire and rays."""
        ...

    @property
    def beads_px(self) -> np.ndarray:
        """(K, 3) centre and radius of shadows of the frame's beads, whether or not detection finds them."""
        ...


@dataclass(frozen=True, eq=False)
class WireShadow:
    """A wire found in one image, IDCS.

    `uv_px` (N, 2): points of its centre line from outside towards the tip; `along` (N, 2): unit tangents there;
    `variance_px2` (N,): across the tangent; along it, a point carries no information. `tip_uv_px` (2,),
    `tip_variance_px2`: along the wire. `point_mm`: assumed length of the tip's cone,
    0 for a plain end. `width_mm`: measured. `contrast`: change of log light in the middle, negative. `hidden`: share of
    the length that other objects overlie.
    """

    uv_px: np.ndarray
    along: np.ndarray
    variance_px2: np.ndarray
    tip_uv_px: np.ndarray
    tip_variance_px2: float
    point_mm: float
    width_mm: float
    contrast: float
    hidden: float


def find_wire(  # noqa: PLR0917
    image: Radiograph,
    expected: ProjectedWire,
    diameter_mm: float,
    beads: Detections | None = None,
    point_mm: float | None = None,
    others: Sequence[ProjectedWire] = (),
    corridor_mm: float = CORRIDOR_MM,
    covered_px: Sequence[np.ndarray] = (),
) -> WireShadow:
    """Return the wire within `corridor_mm` and 5° of its expected place.

    `beads` that were detected and the expected ones are left out, because detection misses a bead that a wire touches;
    where they hide the tip, the expected ones are fitted with it.
    `point_mm`: length of the conical (trocar) point, by default 1.5 diameters; 0: a plain end. `others`: where other
    wires are expected that may be in the image too: they are told from this one by their places and left out, and this
    one must have its own width over half of its length. `covered_px`: polygons (M, 2) in which other metal lies over
    the wire; they are left out. Raises UnusableInputError, and WireRefusedError where there is no wire, it is too faint
    or hidden, two lines compete, another wire may be meant or lies over it, the tip is not visible, or the width
    differs.
    """
    point = POINT_DIAMETERS * diameter_mm if point_mm is None else point_mm
    path, scale, stretch, sine = _prepared(expected, diameter_mm, point)
    mask = field_inset(image)
    logs = log_image(image, mask)
    noise = estimate_noise(logs, mask)
    if noise is None:
        raise WireRefusedError("the image has no area in which its noise can be measured; give a larger image")
    usable = mask & (image.pixels < image.white) & ~_in_polygons(mask.shape, covered_px)
    usable &= ~_in_beads(mask.shape, _unknown(beads, expected.beads_px))
    under_beads = _in_beads(mask.shape, expected.beads_px) & usable
    usable &= ~under_beads
    shown = _shown(path, mask)
    path, scale, stretch, sine = ImagePath.through(path.uv_px[shown]), scale[shown], stretch[shown], sine[shown]
    radii = scale * diameter_mm / 2
    coarse = search(logs, usable, path, radii, scale, [other.uv_px for other in others], corridor_mm)
    radius = float(np.median(radii))
    beside = ~_in_bands(mask.shape, coarse.others, radius + 2 * _RIM_PX)
    usable, under_beads = usable & beside, under_beads & beside
    here = int(np.clip(coarse.expected_tip_s_px, 0, len(scale) - 1))
    wire = SteelWire(diameter_mm, point, float(sine[here]), float(stretch[here]))
    end = coarse.tip_s_px - wire.point_px - radius
    strip = _Strip.about(logs, usable, noise, coarse.path, (wire, radii))
    pieces = strip.pieces(end)
    usable, path = usable & ~strip.outliers(pieces), _through(coarse.path, pieces)
    strip = _Strip.about(logs, usable, noise, path, (wire, radii))
    pieces = strip.pieces(end)
    if others:
        pieces = _alone(pieces, strip)
    looked_at = max(int((end - _covered_px(strip.path, covered_px)) / strip.piece_px), 1)
    width_mm = _width_mm(pieces, looked_at, float(np.median(scale)), diameter_mm)
    over = _beads_over(strip, expected.beads_px, coarse.tip_s_px)
    whole = _Strip.about(logs, usable | under_beads, noise, path, (wire, radii)) if len(over) else strip
    tip = _tip(_End(strip, pieces), (strip, whole), over, coarse.tip_s_px)
    return _measured(strip, pieces, tip, width_mm, max(1 - len(pieces) / looked_at, 0.0))


@dataclass(frozen=True, eq=False)
class _Piece:
    """A piece of wire centred at s: the indices of its pixels in the strip, and the fit."""

    s_px: float
    pixels: np.ndarray
    fit: WireFit


@dataclass(frozen=True, eq=False)
class _Strip:
    """The pixels along a path: rows and columns (N,), s and x, light, and the s.d. of its noise.

    `radii_px` (M,): of the wire, expected at s = 0, 1, ...; they change where it runs towards the detector.
    """

    path: ImagePath
    wire: SteelWire
    radii_px: np.ndarray
    usable: np.ndarray
    row: np.ndarray
    column: np.ndarray
    s: np.ndarray
    x: np.ndarray
    light: np.ndarray
    noise: np.ndarray

    @staticmethod
    def about(
        logs: np.ndarray, usable: np.ndarray, noise: NoiseModel, path: ImagePath, wire: tuple[SteelWire, np.ndarray]
    ) -> "_Strip":
        """Return the strip that covers a wire and its background; `wire` with its expected radii (M,), px."""
        radius = float(np.median(wire[1]))
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

    @property
    def radius_px(self) -> float:
        """Expected radius of the wire, median along it."""
        return float(np.median(self.radii_px))

    def radius_at(self, s_px: float) -> float:
        """Return the expected radius of the wire at s."""
        return float(np.interp(s_px, np.arange(len(self.radii_px)), self.radii_px))

    @property
    def piece_px(self) -> float:
        """Length of a piece."""
        return _PIECE * self.radius_px * (0.5 if self.wire.diameter_mm > _THICK_MM else 1.0)

    def within(self, first: float, last: float) -> np.ndarray:
        """Return the indices of pixels with s from `first` to `last`."""
        return np.flatnonzero((self.s >= first) & (self.s < last))

    def pieces(self, end: float) -> list[_Piece]:
        """Return the pieces from the path's beginning to `end` that can be measured and lie on one curve."""
        step, area = self.piece_px, 2 * self.piece_px * (self.radius_px + _BESIDE_PX)
        measured = []
        for first in np.arange(0.0, end - step, step):
            pixels = self.within(first, first + step)
            s, x = self.s[pixels], self.x[pixels]
            rims = [np.count_nonzero(np.abs(x - side * self.radius_px) < _RIM_PX) for side in (-1, 1)]
            if len(pixels) < _MIN_VISIBLE * area or min(rims) < _MIN_VISIBLE * 2 * _RIM_PX * step:
                continue
            fit = fit_across(s, x, self.light[pixels], self.noise[pixels], (0.0, self.radius_px, _BLUR_PX), self.wire)
            sd = float(np.linalg.norm(fit.influence[0]))
            if (
                fit.converged
                and sd < MAX_SD_PX
                and abs(fit.values[0]) < self.radius_px
                and fit.contrast < -_MIN_CONTRAST
            ):
                measured.append(_Piece(first + step / 2, pixels, fit))
        return _on_a_curve(measured)

    def shows(self, s_px: float, x_px: float) -> bool:
        """Return whether the pixel at s and x is usable."""
        nearest = np.hypot(self.s - s_px, self.x - x_px).min()
        return bool(nearest < 1.0)

    def residuals(self, pieces: list[_Piece]) -> np.ndarray:
        """Return the light minus the model (N,), over its noise; NaN outside the pieces."""
        residuals = np.full(len(self.s), np.nan)
        for piece in pieces:
            residuals[piece.pixels] = (self.light[piece.pixels] - piece.fit.model) / self.noise[piece.pixels]
        return residuals

    def image(self, values: np.ndarray) -> np.ndarray:
        """Return values (N,) at their pixels in the smallest image that contains the strip; 0 elsewhere."""
        pixels = np.zeros((int(np.ptp(self.row)) + 1, int(np.ptp(self.column)) + 1))
        pixels[self.row - self.row.min(), self.column - self.column.min()] = values
        return pixels

    def outliers(self, pieces: list[_Piece]) -> np.ndarray:
        """Return the pixels (H, W) bool that the model does not explain, such as a part of a bead or another wire."""
        smooth = self.smoothed(self.residuals(pieces))
        known = np.isfinite(smooth)
        if not known.any():
            return np.zeros(self.usable.shape, dtype=bool)
        spread = self.spread(smooth)
        unexplained = np.zeros(self.usable.shape, dtype=bool)
        far = known & (np.abs(smooth) > _OUTLIER * spread)
        unexplained[self.row[far], self.column[far]] = True
        return binary_dilation(unexplained, iterations=2)

    def smoothed(self, rest: np.ndarray) -> np.ndarray:
        """Return residuals (N,) averaged over neighbours; NaN where there are none."""
        known = np.isfinite(rest)
        total, share = (
            gaussian_filter(self.image(a), 1.5) for a in (np.where(known, rest, 0.0), known.astype(np.float64))
        )
        mean = (total / np.maximum(share, 0.2))[self.row - self.row.min(), self.column - self.column.min()]
        return np.where(known, mean, np.nan)

    def spread(self, smooth: np.ndarray) -> float:
        """Return the usual size of smoothed residuals (N,) of the wire's pieces."""
        usual = MAD_TO_SD * float(np.nanmedian(np.abs(smooth)))
        return max(usual, _MODEL_LIGHT * float(np.median(self.light / self.noise)))

    def correlation(self, pieces: list[_Piece]) -> np.ndarray:
        """Return the covariance (2 L + 1, 2 L + 1) of the residuals by lag: noise, and structure beside the wire."""
        rest = self.residuals(pieces)
        known = np.isfinite(rest)
        values, seen = self.image(np.where(known, rest, 0.0)), self.image(known.astype(np.float64))
        return _products_by_lag(values) / np.maximum(_products_by_lag(seen), 1.0)

    def variance(self, pixels: np.ndarray, influence: np.ndarray, correlation: np.ndarray) -> float:
        """Return the variance of a parameter with `influence` of the light of `pixels`, in units of its noise."""
        row, column = self.row[pixels], self.column[pixels]
        field = np.zeros((int(np.ptp(row)) + 1, int(np.ptp(column)) + 1))
        field[row - row.min(), column - column.min()] = influence
        return float((_products_by_lag(field) * correlation).sum())


def _measured(
    strip: _Strip, pieces: list[_Piece], tip: tuple[float, float, float], width_mm: float, hidden: float
) -> WireShadow:
    """Return the wire of pieces with its `tip`: s, x, and the variance of s."""
    correlation = strip.correlation(pieces)
    tip_s, tip_x, tip_variance = tip
    on, along, normal = strip.path.at(np.array([piece.s_px for piece in pieces]))
    tip_on, _, tip_normal = strip.path.at(np.array([tip_s]))
    variance = [strip.variance(piece.pixels, piece.fit.influence[0], correlation) for piece in pieces]
    return WireShadow(
        uv_px=on + np.array([piece.fit.values[0] for piece in pieces])[:, None] * normal,
        along=along,
        variance_px2=np.array(variance) + _MODEL_ACROSS_PX**2,
        tip_uv_px=(tip_on + tip_x * tip_normal)[0],
        tip_variance_px2=tip_variance,
        point_mm=strip.wire.point_mm,
        width_mm=width_mm,
        contrast=float(np.median([piece.fit.contrast for piece in pieces])),
        hidden=hidden,
    )


def _products_by_lag(values: np.ndarray) -> np.ndarray:
    """Return the sums (2 L + 1, 2 L + 1) of products of pixels that are -L to L rows and columns apart."""
    shape = [length + _LAGS for length in values.shape]
    products = np.fft.irfft2(np.abs(np.fft.rfft2(values, shape)) ** 2, shape)
    lags = np.arange(-_LAGS, _LAGS + 1)
    return products[np.ix_(lags, lags)]


def _on_a_curve(pieces: list[_Piece]) -> list[_Piece]:
    """Return the pieces that lie on one curve of degree BEND, judged by their own scatter."""
    kept = _near_one_line(pieces)
    while len(kept) > _MIN_PIECES:
        off = _left_out_residuals(kept)
        spread = max(MAD_TO_SD * float(np.median(np.abs(off))), _MODEL_ACROSS_PX)
        worst = int(np.abs(off).argmax())
        if abs(off[worst]) < _FAR_OFF * spread:
            break
        kept = kept[:worst] + kept[worst + 1 :]
    return kept


def _alone(pieces: list[_Piece], strip: _Strip) -> list[_Piece]:
    """Return the pieces of the expected radius: over the others another wire lies.

    Raises WireRefusedError where these are less than half.
    """
    alone = [piece for piece in pieces if abs(piece.fit.values[1] / strip.radius_at(piece.s_px) - 1) < _MAX_OVERLAP]
    if len(alone) < len(pieces) / 2:
        raise WireRefusedError(
            f"only {len(alone)} of {len(pieces)} pieces of the line are as wide as the wire, so another wire may lie "
            "over it; take the image from a direction that shows the wires apart"
        )
    return alone


def _near_one_line(pieces: list[_Piece]) -> list[_Piece]:
    """Return the pieces near the line through two of them with the smallest median deviation.

    Several wrong pieces at one end would bend a curve fitted to all and so stay undetected. A bend of the whole wire
    increases the median too.
    """
    if len(pieces) <= _MIN_PIECES:
        return pieces
    s, x = np.array([(piece.s_px, piece.fit.values[0]) for piece in pieces]).T
    first, second = np.triu_indices(len(pieces), 1)
    slope = (x[second] - x[first]) / (s[second] - s[first])
    off = np.abs(x - x[first, None] - slope[:, None] * (s - s[first, None]))
    median = np.median(off, axis=1)
    best = int(median.argmin())
    near = off[best] < _FAR_OFF_LINE * max(MAD_TO_SD * float(median[best]), _MODEL_ACROSS_PX)
    return [piece for piece, kept in zip(pieces, near, strict=True) if kept]


def _left_out_residuals(pieces: list[_Piece]) -> np.ndarray:
    """Return each piece's distance (N,), px, from the curve through all others: residual over 1 minus leverage."""
    s, x = np.array([(piece.s_px, piece.fit.values[0]) for piece in pieces]).T
    design = np.polynomial.polynomial.polyvander((s - s.mean()) / np.ptp(s), BEND)
    hat = design @ np.linalg.pinv(design)
    return (x - hat @ x) / (1.0 - np.diag(hat))


def _through(path: ImagePath, pieces: list[_Piece]) -> ImagePath:
    """Return the path moved onto the pieces, extrapolated straight beyond them. Raises WireRefusedError."""
    if len(pieces) < _MIN_PIECES:
        raise WireRefusedError(_FEW_PIECES.format(len(pieces)))
    s, x = np.array([(piece.s_px, piece.fit.values[0]) for piece in pieces]).T
    curve, last = np.polynomial.Polynomial.fit(s, x, BEND), s[-1]
    offset = curve(np.minimum(path.s_px, last)) + curve.deriv()(last) * np.maximum(path.s_px - last, 0.0)
    return path.moved(offset)


class _End:
    """The end of a wire whose pieces in a strip are measured."""

    def __init__(self, strip: _Strip, pieces: list[_Piece]) -> None:
        self.wider, self.blur = np.median(
            [(p.fit.values[1] / strip.radius_at(p.s_px), p.fit.values[2]) for p in pieces[-6:]], axis=0
        )
        self.spread, self.correlation = strip.spread(strip.smoothed(strip.residuals(pieces))), strip.correlation(pieces)

    def tip(self, strip: _Strip, beads: np.ndarray, starts: Sequence[float]) -> tuple[float, float, float] | None:
        """Return s and x of the tip, and the variance of s; None where it is not seen.

        `strip` with the pixels under `beads` (K, 3: s, x, radius), which are fitted too. The error of the model grows
        with the light that it leaves unexplained, beside that along the wire. Of the fits from several starts that
        with the least unexplained light counts.
        """
        fits = [fit for start in starts if (fit := self._from(strip, beads, start)) is not None]
        if not fits:
            return None
        _, s, x, variance = min(fits)
        return s, x, variance

    def _from(self, strip: _Strip, beads: np.ndarray, near_px: float) -> tuple[float, float, float, float] | None:
        """Return the unexplained light, s and x of the tip and the variance of s."""
        point_px = strip.wire.point_px
        for _ in range(_MAX_MOVES):
            radius = self.wider * strip.radius_at(near_px)
            pixels = strip.within(near_px - point_px - _TIP_BEHIND * radius, near_px + _BESIDE_PX)
            s, x, light, noise = (a[pixels] for a in (strip.s, strip.x, strip.light, strip.noise))
            about = np.count_nonzero((np.abs(s - near_px) < radius) & (np.abs(x) < radius))
            if about < _MIN_TIP_VISIBLE * 4 * radius**2:
                return None
            fit = fit_tip(s, x, light, noise, (near_px, 0.0), strip.wire, (radius, self.blur), beads)
            moved, near_px = float(fit.values[0]) - near_px, float(fit.values[0])
            if fit.converged and abs(moved) < 1.0:
                rest = np.full(len(strip.s), np.nan)
                rest[pixels] = (light - fit.model) / noise
                shown = (np.abs(x) < 1.5 * radius) & (s > near_px - point_px - 2 * radius) & (s < near_px + radius)
                misfit = float(np.sqrt(np.mean(strip.smoothed(rest)[pixels][shown] ** 2))) / self.spread
                if misfit > _MAX_TIP_MISFIT or not strip.shows(near_px, float(fit.values[1])):
                    return None
                variance = strip.variance(pixels, fit.influence[0], self.correlation) + float(fit.by_prior[0])
                variance += (_MODEL_TIP_PX * max(misfit, 1.0)) ** 2
                return misfit, near_px, float(fit.values[1]), variance
        return None


def _tip(end: _End, strips: tuple[_Strip, _Strip], over: np.ndarray, near_px: float) -> tuple[float, float, float]:
    """Return s and x of the tip near s = `near_px`, and the variance of s: beside the beads `over` it (K, 3), or else
    with them; `strips`: without and with the pixels under them. Raises WireRefusedError."""
    tip = end.tip(strips[0], np.zeros((0, 3)), [near_px])
    if tip is None and len(over):
        s, _, reach = over[np.abs(over[:, 0] - near_px).argmin()]
        tip = end.tip(strips[1], over, [near_px, s - reach, s, s + reach])
    if tip is None:
        raise WireRefusedError(
            "the wire's tip is hidden by a bead or other metal, or cannot be distinguished from its background; move "
            "the C-arm a little and take the image again"
        )
    return tip


def _beads_over(strip: _Strip, beads_px: np.ndarray, tip_s_px: float) -> np.ndarray:
    """Return s, x and radius (K, 3) of the known beads near a wire's tip that lie over its fitted strip."""
    s, x = strip.path.places(beads_px[:, :2])
    radius = beads_px[:, 2]
    behind = tip_s_px - strip.wire.point_px - (_TIP_BEHIND + 2) * strip.radius_at(tip_s_px)
    near = (s + 2 * radius > behind) & (s - 3 * radius < tip_s_px + _BESIDE_PX)
    return np.stack([s, x, radius], axis=-1)[near & (np.abs(x) < strip.radius_px + _BESIDE_PX + radius)]


def _width_mm(pieces: list[_Piece], looked_at: int, px_per_mm: float, diameter_mm: float) -> float:
    """Return the measured width. Raises WireRefusedError with too few pieces of those `looked_at`, or another width."""
    if len(pieces) < max(_MIN_PIECES, _MIN_MEASURED * looked_at):
        raise WireRefusedError(_FEW_PIECES.format(f"{len(pieces)} of {looked_at}"))
    width_mm = 2 * float(np.median([piece.fit.values[1] for piece in pieces])) / px_per_mm
    if abs(width_mm / diameter_mm - 1) > _MAX_WIDTH_ERROR:
        raise WireRefusedError(
            f"the line found is {width_mm:.1f} mm wide, the wire {diameter_mm:.1f} mm: it is something else, or "
            "another wire is in; give the right diameter"
        )
    return width_mm


def _unknown(beads: Detections | None, known_px: np.ndarray) -> np.ndarray:
    """Return the discs (N, 3) of detected beads whose centre lies in none of the known ones (K, 3)."""
    if beads is None:
        return np.zeros((0, 3))
    found = np.column_stack([beads.uv_px, beads.radius_px])
    apart = np.linalg.norm(found[:, None, :2] - known_px[:, :2], axis=-1)
    return found[~(apart < known_px[:, 2]).any(axis=1)]


def _in_beads(shape: tuple[int, ...], discs: np.ndarray) -> np.ndarray:
    """Return (H, W) bool: which pixels lie in discs (N, 3) or their blurred rims."""
    return in_discs(shape, discs + np.array([0.0, 0.0, _ROUND_BEAD_PX]))


def _prepared(
    expected: ProjectedWire, diameter_mm: float, point_mm: float
) -> tuple[ImagePath, *tuple[np.ndarray, ...]]:
    """Return the expected path in steps of a pixel, with the scales across and along the wire, px/mm, and the sine."""
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
    if sine.min() < _MIN_SINE:
        raise WireRefusedError("the wire would be seen nearly end on; take the image from another direction")
    rough = ImagePath.through(uv)
    s = np.arange(0.0, rough.s_px[-1])
    stretch = np.gradient(rough.s_px) / np.gradient(along)
    fine = ImagePath.through(np.stack([np.interp(s, rough.s_px, column) for column in uv.T], axis=-1))
    return fine, *(np.interp(s, rough.s_px, a) for a in (scale, stretch, sine))


def _covered_px(path: ImagePath, polygons_px: Sequence[np.ndarray]) -> float:
    """Return the length of a path inside polygons (M, 2), px; its points are a pixel apart."""
    return float(
        sum(
            cv2.pointPolygonTest(polygon.astype(np.float32), (float(u), float(v)), False) >= 0
            for polygon in polygons_px
            for u, v in path.uv_px
        )
    )


def _in_bands(shape: tuple[int, ...], lines_uv_px: Sequence[np.ndarray], half_px: float) -> np.ndarray:
    """Return (H, W) bool: which pixels lie in bands of half a width about lines (M, 2) each."""
    inside = np.zeros(shape, np.uint8)
    for line in lines_uv_px:
        cv2.polylines(inside, [np.rint(line).astype(np.int32)], False, 1, max(round(2 * half_px), 1))
    return inside > 0


def _in_polygons(shape: tuple[int, ...], polygons_px: Sequence[np.ndarray]) -> np.ndarray:
    """Return (H, W) bool: which pixels lie inside polygons (M, 2) each."""
    inside = np.zeros(shape, np.uint8)
    for polygon in polygons_px:
        cv2.fillPoly(inside, [np.rint(polygon).astype(np.int32)], 1)
    return inside > 0


def _shown(path: ImagePath, mask: np.ndarray) -> slice:
    """Return the longest part of a path within the mask. Raises WireRefusedError where it is too short."""
    at = np.rint(path.uv_px).astype(int)
    inside = np.all((at >= 0) & (at < np.array(mask.shape[::-1])), axis=-1)
    u, v = np.where(inside[:, None], at, 0).T
    inside = inside & mask[v, u]
    runs = np.flatnonzero(np.diff(np.concatenate([[False], inside, [False]]).astype(int)))
    first, last = max(runs.reshape(-1, 2).tolist(), key=lambda run: run[1] - run[0], default=(0, 0))
    if last - first < _MIN_SHOWN_PX:
        raise WireRefusedError(
            "the planned wire lies outside the image's field; check that the image belongs to this plan"
        )
    return slice(first, last)
