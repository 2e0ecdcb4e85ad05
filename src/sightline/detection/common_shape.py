"""What the shadows of all beads of an image have in common: a faint copy beside each, a blur in one direction, sides.

A bead's shadow is round, as is the shadow's mean over all directions. What the shadow has beyond its mean is compared
with what a copy of the mean, shifted by s, would add. All beads have the same s; what lies behind them differs.
"""

from dataclasses import dataclass, replace

import cv2
import numpy as np

from sightline.common.checks import Check
from sightline.common.fitting import MAD_TO_SD, MEDIAN_SD, distances, median
from sightline.imaging import Radiograph

_ANGLES, _STEP_PX = 32, 0.5  # of the polar grid about each bead
_REACH_PX = 8.0  # beyond a bead's rim, where no other bead may lie: the largest shift, and some background [ours]
_SHIFTS_PX = 2.0, 3.0, 4.5, 6.5  # of a copy: one between two of them matches the next [ours]
_MIN_BEADS = 8  # isolated ones; fewer do not give a standard error [ours]
_SURE = 3.0  # standard errors that are subtracted
_MIN_CONTRAST = 1e-3  # of log intensity [ours]
_HALVES = 0.25, 0.75  # of a bead's contrast: between them its rim is measured [ours]
_BLUR_PX2 = 3.2  # squared blur along one direction per unit of what copies 2 px to both sides would add [calc]
# Images of one exposure have up to 0.06 and 0.45 px [twin, ARCADIS: 52 images]. Copies of 10 % at 3.6 px have 0.34 px,
# and two exposures 2.2 px apart 0.85 [twin].
MAX_COPY_PX, MAX_BLUR_PX = 0.15, 0.7
# Beads are up to 2 % wider than high, or higher; with a spread of up to 4 %, other spots 12 % and more. Pixels that are
# not square leave rims of equal width, to 13 %; movement that makes spots longer makes these wider by 45 % and more
# [twin, gVirtualXray, ARCADIS].
MAX_ASPECT, _MAX_SPREAD, _MAX_SOFTER = 0.05, 0.07, 1.25


@dataclass(frozen=True)
class CommonShape:
    """What the shadows of an image have in common.

    `copy_share`, `copy_px` (u, v): strength and place of a copy beside each bead. `copy_moves_px`: how far it moves the
    centres, and `blur_px`: s.d. of a blur along `blur_deg` (clockwise from the rows); both less three standard errors.
    `aspect`: width of the shadows over their height; `aspect_spread`: median deviation of single ones, a share;
    `aspect_sd`: standard error. `soft`: width of the rims along the rows over that along the columns, each over the
    shadow's own.
    """

    copy_share: float
    copy_px: tuple[float, float]
    copy_moves_px: float
    blur_px: float
    blur_deg: float
    aspect: float
    aspect_spread: float
    aspect_sd: float
    soft: float

    def checks(self) -> tuple[Check, ...]:
        """Return the checks of a single exposure of something that kept still."""
        copied, blurred = self.copy_moves_px > MAX_COPY_PX, self.blur_px > MAX_BLUR_PX
        copy = (
            f"Each bead has a copy of {100 * self.copy_share:.0f} % of its strength, {np.hypot(*self.copy_px):.1f} px "
            "away: an earlier frame shines through. Switch averaging off, hold still, and take a single exposure."
        )
        blur = (
            f"All beads are blurred at {self.blur_deg:.0f}° to the rows: something moved during the exposure, or two "
            "exposures were averaged. Hold still, and take a single exposure."
        )
        return (
            Check("double image", not copied, self.copy_moves_px, MAX_COPY_PX, "px",
                  copy if copied else "No earlier frame shines through."),
            Check("movement blur", not blurred, self.blur_px, MAX_BLUR_PX, "px",
                  blur if blurred else "The beads are not blurred in one direction."),
        )  # fmt: skip

    @property
    def stretched(self) -> bool:
        """Whether the shadows are surely wider than high, or higher: metal beside a few beads changes theirs too."""
        return abs(self.aspect - 1) > max(MAX_ASPECT, _SURE * self.aspect_sd)

    @property
    def not_square(self) -> str | None:
        """What is wrong with pixels that are not square, and what to do; None where the beads do not show it."""
        moved = max(self.soft, 1 / self.soft) > _MAX_SOFTER or self.blur_px > MAX_BLUR_PX
        if not self.stretched or self.aspect_spread > _MAX_SPREAD or moved:
            return None
        return (
            f"the image's pixels are not square: its beads are {self.aspect:.2f} times as wide as high; export it "
            f"as the C-arm stores it, or resize it to {1 / self.aspect:.2f} of its width"
        )


def shape_checks(image: Radiograph, uv_px: np.ndarray, radius_px: np.ndarray | None) -> tuple[Check, ...]:
    """Return the checks of the beads at `uv_px` (N, 2), of radii (N,): copies and blur; none with too few beads."""
    shape = None if radius_px is None else common_shape(image, uv_px, radius_px)
    return () if shape is None else shape.checks()


def common_shape(image: Radiograph, uv_px: np.ndarray, radius_px: np.ndarray) -> CommonShape | None:
    """Return what the shadows at `uv_px` (N, 2), of radii (N,), have in common; None with too few isolated ones."""
    logs = logs_of_white(image)
    discs = _isolated(image, uv_px, radius_px)
    if len(discs) < _MIN_BEADS:
        return None
    shape = _common([_Shadow.of(*_polar(logs, disc, 1.0)) for disc in discs])
    if not shape.stretched:
        return shape
    square = _common([_Shadow.of(*_polar(logs, disc, shape.aspect)) for disc in discs])
    return replace(
        shape,
        copy_moves_px=min(shape.copy_moves_px, square.copy_moves_px),
        blur_px=min(shape.blur_px, square.blur_px),  # metal beside a few beads may show an aspect that is none
        soft=square.soft,
    )


def logs_of_white(image: Radiograph) -> np.ndarray:
    """Return the natural logarithm (H, W) float32 of the pixels over the white, at least that of 1e-4."""
    return np.log(np.maximum(image.pixels.astype(np.float32) / np.float32(image.white), 1e-4))


def _common(shadows: list["_Shadow"]) -> CommonShape:
    match, norm = np.array([shadow.copies for shadow in shadows]), np.array([shadow.copy_norms for shadow in shadows])
    norm = np.broadcast_to(norm[:, :, None], match.shape)
    share = match.sum(axis=0) / norm.sum(axis=0)
    error = np.sqrt(np.square(match - share * norm).sum(axis=0)) / norm.sum(axis=0)
    best = np.unravel_index(np.argmax(np.maximum(share, 0) ** 2 * norm.sum(axis=0)), share.shape)
    shift, angle = _SHIFTS_PX[best[0]], 2 * np.pi * best[1] / _ANGLES
    both = np.array([shadow.both_sides for shadow in shadows])
    along = int(np.argmax(np.median(both, axis=0)))
    blur, blur_sd = _median(both[:, along])
    aspects = np.array([shadow.aspect for shadow in shadows])
    aspect, aspect_sd = _median(aspects)
    return CommonShape(
        copy_share=float(share[best]),
        copy_px=(float(shift * np.cos(angle)), float(shift * np.sin(angle))),
        copy_moves_px=float(max(share[best] - _SURE * error[best], 0.0) * shift),
        blur_px=float(np.sqrt(_BLUR_PX2 * max(blur - _SURE * blur_sd, 0.0))),
        blur_deg=(360.0 * along / _ANGLES) % 180.0,
        aspect=aspect,
        soft=float(np.median([shadow.soft for shadow in shadows])),
        aspect_spread=median(np.abs(aspects / aspect - 1)),
        aspect_sd=aspect_sd / aspect,
    )


def _median(values: np.ndarray) -> tuple[float, float]:
    """Return the median of (N,) and its standard error, from the median deviation: a ball on a bone's edge can have any
    value."""
    middle = median(values)
    return middle, MEDIAN_SD * MAD_TO_SD * median(np.abs(values - middle)) / float(np.sqrt(len(values)))


def _isolated(image: Radiograph, uv_px: np.ndarray, radius_px: np.ndarray) -> np.ndarray:
    """Return u, v and radius (M, 3) of the shadows with nothing but background within _REACH_PX."""
    apart = distances(uv_px, uv_px) - radius_px - radius_px[:, None] + np.diag(np.full(len(uv_px), np.inf))
    depth = cv2.distanceTransform(np.pad(image.field_mask.view(np.uint8), 1), cv2.DIST_L2, 5)[1:-1, 1:-1]
    column, row = np.clip(np.rint(uv_px).astype(int), 0, np.array(image.shape[::-1]) - 1).T
    alone = (apart.min(axis=1, initial=np.inf) > _REACH_PX) & (depth[row, column] > radius_px + _REACH_PX + 2)
    return np.column_stack([uv_px, radius_px])[alone]


def _polar(logs: np.ndarray, disc: np.ndarray, aspect: float) -> tuple[np.ndarray, np.ndarray]:
    """Return radii (K,) and the log intensity (K, _ANGLES) about a shadow whose width is `aspect` times its height."""
    u, v, radius = disc
    r, angle = np.arange(_STEP_PX / 2, radius + _REACH_PX, _STEP_PX), 2 * np.pi * np.arange(_ANGLES) / _ANGLES
    x, y = u + aspect**0.5 * np.outer(r, np.cos(angle)), v + aspect**-0.5 * np.outer(r, np.sin(angle))
    return r, cv2.remap(logs, x.astype(np.float32), y.astype(np.float32), cv2.INTER_LINEAR).astype(np.float64)


@dataclass(frozen=True, eq=False)
class _Shadow:
    """One shadow. `copies` (S, _ANGLES): its match with a copy at each of _SHIFTS_PX in each direction, `copy_norms`
    (S,) that of such a copy with itself; `both_sides` (_ANGLES,): the part that copies 2 px to both sides explain."""

    copies: np.ndarray
    copy_norms: np.ndarray
    both_sides: np.ndarray
    aspect: float
    soft: float

    @staticmethod
    def of(r: np.ndarray, logs: np.ndarray) -> "_Shadow":
        mean = logs.mean(axis=1)
        background = mean[-4:].mean()
        contrast = mean[: max(len(r) - int(_REACH_PX / _STEP_PX), 4) // 2].mean() - background
        if abs(contrast) <= _MIN_CONTRAST:  # of spots that are not beads
            contrast = _MIN_CONTRAST
        disc, mean = (logs - background) / contrast, (mean - background) / contrast
        opposite = np.roll(disc, _ANGLES // 2, axis=1)
        angle = 2 * np.pi * np.arange(_ANGLES) / _ANGLES
        weight = np.sqrt(r)[:, None]
        # Of any shift of the centre, slope and curvature of the background nothing is left.
        shift_and_slope = np.linalg.qr(weight * np.stack([r, np.gradient(mean, r)], axis=1))[0]
        curvature = np.linalg.qr(weight * r[:, None] ** 2)[0]

        def without(known: np.ndarray, values: np.ndarray, times: int) -> np.ndarray:
            """Return values without `known` functions of r times waves of `times` periods."""
            wave = np.exp(1j * times * angle)
            along = known @ (known.T @ (values @ wave.conj())) * 2 / _ANGLES
            return values - (along[:, None] * wave).real

        def copied(shift_px: float) -> np.ndarray:
            return np.interp(
                np.sqrt(r[:, None] ** 2 + shift_px**2 - 2 * shift_px * r[:, None] * np.cos(angle)), r, mean
            )

        def match(values: np.ndarray, copy: np.ndarray) -> np.ndarray:
            """Return the product with a copy turned to each of the angles."""
            return np.fft.ifft((np.fft.fft(values) * np.fft.fft(copy).conj()).sum(axis=0)).real

        odd = without(shift_and_slope, weight * (disc - opposite) / 2, 1)
        even = weight * ((disc + opposite) / 2 - mean[:, None])
        copies = [without(shift_and_slope, weight * (copied(s) - copied(-s)) / 2, 1) for s in _SHIFTS_PX]
        both = (copied(2.0) + copied(-2.0)) / 2
        both = without(curvature, weight * (both - both.mean(axis=1, keepdims=True)), 2)
        low, high = _HALVES
        size = np.clip((disc - low) / (high - low), 0.0, 1.0).sum(axis=0)
        rim = (disc > low).sum(axis=0) - (disc > high).sum(axis=0)
        return _Shadow(
            np.array([match(odd, copy) for copy in copies]),
            np.array([np.square(copy).sum() for copy in copies]),
            match(even, both) / np.square(both).sum(),
            _sides(size),
            _sides(rim),
        )


def _sides(lengths: np.ndarray) -> float:
    """Return the ratio of lengths (_ANGLES,) along the rows to those along the columns."""
    angle = 2 * np.pi * np.arange(_ANGLES) / _ANGLES
    longer = 2 * float((lengths * np.cos(2 * angle)).mean() / max(lengths.mean(), 1.0))
    return max(1 + longer, 1e-3) / max(1 - longer, 1e-3)
