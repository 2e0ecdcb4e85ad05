"""Sub-pixel fits of beads: a blurred ball or disc on a smooth background, in a sharpened image.

Sharpening undoes most of the detector's blur. Quantum noise arises before the blur, so it becomes white.
"""

from copy import copy
from dataclasses import dataclass

import numpy as np

from sightline.common.fitting import median, quantiles
from sightline.common.kernels import kernel
from sightline.common.threads import in_parts
from sightline.detection.beads.bead import BEAD
from sightline.detection.beads.fit import LIGHT_STEPS, PRIOR_SD, Filter, FitImage, fit_part
from sightline.detection.beads.noise import AREA, BLOCK, LAGS, NoiseModel, all_usable, flatten
from sightline.detection.beads.shadow import profile_table
from sightline.detection.beads.window import TAPS, along_both_axes

_WIDE, _STEP = BLOCK + 2 * TAPS, 4 * BLOCK  # px: side of a block with the filter's margin; distance of blocks
AFTER_LAGS = 3  # px, of the noise correlation after sharpening
_LEFT_PX = 0.5  # sigma of the remaining blur: less would amplify electronic and rounding noise [calc]
_WHITE = 0.004  # assumed share of white noise along one axis, the regularisation of the filter [calc]
_MIN_BLOCKS = 16
_NOISY = 0.1  # smallest variance after sharpening, over the noise's: constant areas have less, by rounding [ours]
_MAX_BLUR_PX = 1.6  # more correlation comes from structure, or from a filter that cannot be undone [ours]


@dataclass(frozen=True, eq=False)
class Sharpening:
    """A symmetric filter with `taps` (TAPS + 1,) along both axes.

    It changes a blur of sigma s to sqrt(s² + `blur2_px2`) (negative), multiplies the noise's variance by `gain`, and
    leaves noise with `correlation` (AFTER_LAGS + 1,) along either axis.
    """

    taps: np.ndarray
    blur2_px2: float
    gain: float
    correlation: np.ndarray


def design(log_image: np.ndarray, mask: np.ndarray, noise: NoiseModel) -> Sharpening:
    """Return the sharpening for the image's noise; gain and correlation are measured in the image's quiet blocks."""
    blur = noise_blur_px(noise)
    if blur <= _LEFT_PX:
        taps, left = np.eye(TAPS + 1)[0], blur
    else:
        taps, left = _taps(blur), _LEFT_PX
    gamma = _correlations_after(log_image, mask, noise, taps)
    gamma = gamma[gamma[:, 0] > _NOISY]
    if len(gamma) < _MIN_BLOCKS:
        return Sharpening(taps, left**2 - blur**2, *_of_gaussian_noise(taps, blur))
    # Selecting the quiet blocks lowers the estimate by 8 %; residual structure makes up for it [twin].
    low, high = quantiles(gamma[:, 0], (0.1, 0.5))
    mean = _with_planes(gamma[(gamma[:, 0] >= low) & (gamma[:, 0] <= high)].mean(axis=0))
    return Sharpening(taps, left**2 - blur**2, float(mean[0]), np.clip(mean / mean[0], -0.5, 1.0))


def _with_planes(covariance: np.ndarray) -> np.ndarray:
    """Return covariances by lag, corrected for the planes subtracted from the blocks: three terms of slow noise."""
    whole = covariance
    for _ in range(4):
        slow = max(float(whole[0] + 2 * whole[1:].sum()), 0.0) ** 2 / float(whole[0])
        whole = covariance + 3 / BLOCK**2 * slow
    return whole


def noise_blur_px(noise: NoiseModel) -> float:
    """Return the sigma, px, of the Gaussian blur of formerly white noise, whose correlation is exp(-d² / 4 sigma²)."""
    first = float(np.clip(noise.correlation[1], 1e-3, np.exp(-0.25 / _MAX_BLUR_PX**2)))
    return 0.5 / float(np.sqrt(-np.log(first)))


def _of_gaussian_noise(taps: np.ndarray, blur: float) -> tuple[float, np.ndarray]:
    """Return gain and correlation for white noise blurred by `blur`, used where no block is quiet."""
    whole = np.concatenate([taps[:0:-1], taps])
    both = np.convolve(whole, whole)
    at = np.arange(len(both)) - len(both) // 2
    after = both @ np.exp(-(np.subtract.outer(at, np.arange(AFTER_LAGS + 1)) ** 2) / (4 * blur**2))
    return float(after[0] ** 2), after / after[0]


def _taps(blur: float) -> np.ndarray:
    """Return least-squares taps, with sum 1, that change a Gaussian of sigma `blur` to one of _LEFT_PX."""
    k = np.linspace(0, np.pi, 200)
    waves = np.cos(np.outer(k, np.arange(TAPS + 1))) * np.append(1.0, np.full(TAPS, 2.0))
    have, want = np.exp(-0.5 * (k * blur) ** 2), np.exp(-0.5 * (k * _LEFT_PX) ** 2)
    A = (waves * have[:, None] ** 2).T @ waves + _WHITE * waves.T @ waves + 1e4 * np.outer(waves[0], waves[0])
    return np.linalg.solve(A, waves.T @ (have * want) + 1e4 * waves[0])


def _correlations_after(image: np.ndarray, mask: np.ndarray, noise: NoiseModel, taps: np.ndarray) -> np.ndarray:
    """Return covariances (N, AFTER_LAGS + 1) by lag after sharpening, for every fourth block along either axis.

    In units of the noise's variance; 0 for blocks with an unusable pixel.
    """
    rows, columns = (max((side - _WIDE) // _STEP + 1, 0) for side in image.shape)
    covariances = np.zeros((rows * columns, AFTER_LAGS + 1))
    line = np.array([noise.offset, noise.slope, float(image.max())])
    in_parts(_correlations_part, image, mask, line, taps.astype(np.float32), covariances)
    return covariances


@kernel(nogil=True)
def _correlations_part(part, parts, image, mask, line, taps, covariances):  # noqa: PLR0917 - a kernel
    block, transposed, sums = np.empty(AREA, np.float32), np.empty(AREA, np.float32), np.empty((3, BLOCK), np.float32)
    columns, ceiling = (image.shape[1] - _WIDE) // _STEP + 1, line[2]
    for b in range(part, len(covariances), parts):
        top, left = (b // columns) * _STEP, (b % columns) * _STEP
        if not all_usable(image, mask, top, left, _WIDE, ceiling):
            continue
        sharp = along_both_axes(image[top : top + _WIDE, left : left + _WIDE].copy(), taps)
        for i in range(BLOCK):
            for j in range(BLOCK):
                block[BLOCK * i + j] = sharp[i, j]
        variance = np.exp(line[0] - line[1] * flatten(block, transposed, sums))
        for lag in range(AFTER_LAGS + 1):
            total = _products(block, BLOCK * lag, sums[0]) + _products(transposed, BLOCK * lag, sums[0])
            covariances[b, lag] = total / (2.0 * BLOCK * (BLOCK - lag)) / variance


@kernel()
def _products(values, lag, sums):
    """Return the sum of products of `values` (AREA,) `lag` apart, a multiple of BLOCK.

    Columns are summed side by side in `sums` (BLOCK,), which the compiler vectorises.
    """
    sums[:] = 0.0
    for first in range(0, AREA - lag, BLOCK):
        for j in range(BLOCK):
            sums[j] += values[first + lag + j] * values[first + j]
    total = 0.0
    for j in range(BLOCK):
        total += sums[j]
    return total


# Radius over the usual one from which, and up to which, a ball becomes a large one (5 instead of 3 mm). Balls of one
# size on two plates differ by 1.2, by the distances from the source [ours].
_LARGE_FROM, _LARGE_AT = 1.2, 1.4
_BLUR_PX = 1.0  # initial value: detector 0.9, focal spot and pixel [physics.md]


def start(uv_px: np.ndarray, radius_px: np.ndarray, contrast: np.ndarray) -> np.ndarray:
    """Return beads (N,) with the initial values of a fit; `contrast`: signed step of log intensity."""
    beads = np.zeros(len(uv_px), BEAD)
    beads["u_px"], beads["v_px"], beads["radius_px"], beads["contrast"] = *uv_px.T, radius_px, contrast
    beads["blur_px"] = np.minimum(_BLUR_PX, 0.4 * radius_px)
    if len(beads) > 0:
        larger = radius_px / median(radius_px)
        beads["large"] = np.clip((larger - _LARGE_FROM) / (_LARGE_AT - _LARGE_FROM), 0.0, 1.0)
    return beads


class BeadFitter:
    """Fits beads in one image by least squares, with weights and covariances from the image's correlated noise.

    `log_image` (H, W) float32; `usable` (H, W) bool: the pixels that a fit may use.
    """

    def __init__(self, log_image: np.ndarray, usable: np.ndarray, noise: NoiseModel) -> None:
        blur2 = noise_blur_px(noise) ** 2
        sharp = design(log_image, usable, noise)
        nothing = Sharpening(np.eye(len(sharp.taps))[0], 0.0, 1.0, noise.correlation)
        light = (np.arange(2 * LIGHT_STEPS) + 0.5) / LIGHT_STEPS
        self.scene = FitImage(
            log_image,
            usable,
            np.array([noise.offset, noise.slope, float(log_image.max())]),
            (light ** (0.5 * noise.slope - 1.0)).astype(np.float32),
            _filter(sharp, blur2),
            _filter(nothing, blur2),
            profile_table(ball=True),
            profile_table(ball=False),
        )

    def within(self, usable: np.ndarray) -> "BeadFitter":
        """Return a fitter that uses only the pixels `usable` (H, W)."""
        other = copy(self)
        other.scene = self.scene._replace(usable=usable)
        return other

    def __call__(
        self, beads: np.ndarray, which: np.ndarray | None = None, prior_sd: np.ndarray | None = None
    ) -> np.ndarray:
        """Fit `beads` (N,) from their values, or only `which` (M,); return the N or M results.

        `prior_sd` (2, N, BEAD_TERMS): as `fit.PRIOR_SD`, of each as a bead to fit and as a neighbour; without it
        ellipticities are about zero, whatever the beads say.

        Dark spots that reach into each other's windows are fitted jointly; pixels of other spots are left out.
        """
        which = np.arange(len(beads)) if which is None else which
        if prior_sd is None:
            prior_sd, beads = np.repeat(PRIOR_SD[:, None], len(beads), axis=1), beads.copy()
            beads["axial"] = beads["diagonal"] = 0.0
        fitted = np.empty(len(which), BEAD)
        in_parts(fit_part, self.scene, beads, which, prior_sd, fitted)
        return fitted


def _filter(sharp: Sharpening, blur2: float) -> Filter:
    """Return a filter in the form that kernels need; `blur2`: squared blur of the image, px²."""
    taps, correlation = sharp.taps.astype(np.float32), sharp.correlation.astype(np.float32)
    blurs = float(sharp.blur2_px2), float(blur2 + sharp.blur2_px2)
    return Filter(taps, float(sharp.gain), *blurs, correlation, by_distance(sharp.correlation))


def by_distance(correlation: np.ndarray) -> np.ndarray:
    """Return (LAGS + 1,) float32: the correlations of all neighbours, summed by their distance in whole px.

    A neighbour between two distances counts for both, in shares that are linear in the squared distance.
    """
    lags = np.arange(LAGS + 1)
    padded = np.zeros(LAGS + 1)
    padded[: len(correlation)] = correlation
    along, times = np.meshgrid(lags, lags), np.where(lags > 0, 2.0, 1.0)  # a lag to either side
    together = np.outer(padded * times, padded * times)
    return np.array(
        [(together * np.interp(along[0] ** 2 + along[1] ** 2, lags**2, unit)).sum() for unit in np.eye(LAGS + 1)],
        dtype=np.float32,
    )
