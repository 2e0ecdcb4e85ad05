"""Sub-pixel fits of beads: a blurred ball or disc on a smooth background."""

from copy import copy

import numpy as np

from sightline.detection.beads.columns import AXIAL, BLUR, CONTRAST, COUNT, DIAGONAL, LARGE, RADIUS
from sightline.detection.beads.fit import PRIOR_SD, fit_part
from sightline.detection.beads.noise import LAGS, NoiseModel
from sightline.detection.beads.profile import profile_table
from sightline.detection.beads.sharpen import Sharpening, design, noise_blur_px
from sightline.fitting.robust import median
from sightline.threads import in_parts

# Radius over the usual one from which, and up to which, a ball becomes a large one (5 instead of 3 mm). Balls of one
# size on two plates differ by 1.2, by the distances from the source [ours].
_LARGE_FROM, _LARGE_AT = 1.2, 1.4
_BLUR_PX = 1.0  # initial value: detector 0.9, focal spot and pixel [physics.md]


def start(uv_px: np.ndarray, radius_px: np.ndarray, response: np.ndarray) -> np.ndarray:
    """Return initial rows (N, COUNT) of `columns` for a fit; `response`: signed step of log intensity."""
    rows = np.zeros((len(uv_px), COUNT))
    rows[:, :2], rows[:, RADIUS], rows[:, CONTRAST] = uv_px, radius_px, response
    rows[:, BLUR] = np.minimum(_BLUR_PX, 0.4 * radius_px)
    if len(rows) > 0:
        larger = radius_px / median(radius_px)
        rows[:, LARGE] = np.clip((larger - _LARGE_FROM) / (_LARGE_AT - _LARGE_FROM), 0.0, 1.0)
    return rows


class BeadFitter:
    """Fits beads in one image by least squares, with weights and covariances from the image's correlated noise.

    `log_image` (H, W) float32; `usable` (H, W) bool.
    """

    def __init__(self, log_image: np.ndarray, usable: np.ndarray, noise: NoiseModel) -> None:
        self._image, self._usable = log_image, usable
        self._line = np.array([noise.offset, noise.slope, float(log_image.max())])
        blur2 = noise_blur_px(noise) ** 2
        sharp = design(log_image, usable, noise)
        nothing = Sharpening(np.eye(len(sharp.taps))[0], 0.0, 1.0, noise.correlation)
        self._sharpening, self._plain = _plain_numbers(sharp, blur2), _plain_numbers(nothing, blur2)
        self._tables = profile_table(ball=True), profile_table(ball=False)

    @property
    def log_image(self) -> np.ndarray:
        """(H, W) float32."""
        return self._image

    @property
    def usable(self) -> np.ndarray:
        """(H, W) bool: the pixels that a fit may use."""
        return self._usable

    def within(self, usable: np.ndarray) -> "BeadFitter":
        """Return a fitter that uses only the pixels `usable` (H, W)."""
        other = copy(self)
        other._usable = usable
        return other

    def __call__(
        self, rows: np.ndarray, which: np.ndarray | None = None, prior_sd: np.ndarray | None = None
    ) -> np.ndarray:
        """Fit `rows` (N, COUNT) of `columns` from their values, or only rows `which` (M,); return (N or M, COUNT).

        `prior_sd` (2, N, BEAD_TERMS): as `fit.PRIOR_SD`, of each row as a bead to fit and as a neighbour; without it
        ellipticities are about zero, whatever the rows say.

        Dark spots that reach into each other's windows are fitted jointly; pixels of other spots are left out.
        """
        which = np.arange(len(rows)) if which is None else which
        if prior_sd is None:
            prior_sd, rows = np.repeat(PRIOR_SD[:, None], len(rows), axis=1), rows.copy()
            rows[:, [AXIAL, DIAGONAL]] = 0.0
        out = np.empty((len(which), COUNT))
        in_parts(
            fit_part,
            self._image,
            self._usable,
            rows,
            which,
            self._line,
            self._sharpening,
            self._plain,
            prior_sd,
            self._tables,
            out,
        )
        return out


def _plain_numbers(sharp: Sharpening, blur2: float) -> tuple[np.ndarray, float, float, float, np.ndarray, np.ndarray]:
    """Return taps, gain, change of the squared blur, squared blur common to background and shadow, and correlations."""
    taps, correlation = sharp.taps.astype(np.float32), sharp.correlation.astype(np.float32)
    blurs = float(sharp.blur2_px2), float(blur2 + sharp.blur2_px2)
    return taps, float(sharp.gain), *blurs, correlation, _by_distance(sharp.correlation)


def _by_distance(correlation: np.ndarray) -> np.ndarray:
    """Return (LAGS + 1,) float32: the correlations of all neighbours, summed by their distance in whole px.

    A neighbour between two distances counts for both, in shares that are linear in the squared distance.
    """
    lags = np.arange(LAGS + 1)
    one = np.zeros(LAGS + 1)
    one[: len(correlation)] = correlation
    along, times = np.meshgrid(lags, lags), np.where(lags > 0, 2.0, 1.0)  # a lag to either side
    together = np.outer(one * times, one * times)
    return np.array(
        [(together * np.interp(along[0] ** 2 + along[1] ** 2, lags**2, unit)).sum() for unit in np.eye(LAGS + 1)],
        dtype=np.float32,
    )
