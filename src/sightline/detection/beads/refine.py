"""Sub-pixel fits of beads: a blurred ball or disc on a smooth background."""

from copy import copy

import numpy as np

from sightline.common.fitting import median
from sightline.common.threads import in_parts
from sightline.detection.beads.bead import BEAD
from sightline.detection.beads.fit import PRIOR_SD, Filter, Optics, fit_part
from sightline.detection.beads.noise import LAGS, NoiseModel
from sightline.detection.beads.profile import profile_table
from sightline.detection.beads.sharpen import Sharpening, design, noise_blur_px

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
        self.log_image, self.usable = log_image, usable
        blur2 = noise_blur_px(noise) ** 2
        sharp = design(log_image, usable, noise)
        nothing = Sharpening(np.eye(len(sharp.taps))[0], 0.0, 1.0, noise.correlation)
        self._optics = Optics(
            np.array([noise.offset, noise.slope, float(log_image.max())]),
            _filter(sharp, blur2),
            _filter(nothing, blur2),
            profile_table(ball=True),
            profile_table(ball=False),
        )

    def within(self, usable: np.ndarray) -> "BeadFitter":
        """Return a fitter that uses only the pixels `usable` (H, W)."""
        other = copy(self)
        other.usable = usable
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
        in_parts(fit_part, self.log_image, self.usable, beads, which, self._optics, prior_sd, fitted)
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
