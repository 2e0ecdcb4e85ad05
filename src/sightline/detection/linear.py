"""Fits of tracked beads that are linear about a fit in an earlier image of the sequence.

A fit of `fit.py` spends its time on the shadow's profile, its derivatives and the normal equations. They stay the same
while a bead stays within a fraction of its blur. The parameters in another image then follow from its pixels by one
product and one triangular system. The pixels are read in the windows alone, and as light: no log image is needed.

Such an estimate is as accurate as that of a fit, whose weights and derivatives follow the noise of its own image. The
two differ by a third of the noise at the lowest dose, by a seventh at medium dose [twin].
"""

from dataclasses import dataclass
from typing import Self

import numpy as np

from sightline.detection.columns import (
    AXIAL,
    CENTRE_COVARIANCE,
    CHI2,
    CONTRAST,
    CUU,
    CVV,
    DIAGONAL,
    EXCESS,
    FITTED,
    RADIUS,
    STATUS,
)
from sightline.detection.fit import PRIOR_PIXELS, PRIOR_SD, SUSPICIOUS_EXCESS
from sightline.detection.linear_kernels import Windows, keep_part, step_part
from sightline.detection.log_image import darkest
from sightline.detection.refine import BeadFitter
from sightline.imaging import Radiograph
from sightline.threads import in_parts

# A common movement of all beads by d changes their linear fits by 0.1 d² / px [twin]; a tenth of the s.d. is allowed.
_BEND, _ALLOWED_SD = 0.1, 0.1
_OF_NOISE = 2.0  # so much further may noise move a single bead [ours]
_AGREES_SD = 0.25  # largest difference from the fit in the fit's own image; usually 0.03 [twin]


@dataclass(frozen=True, eq=False)
class LinearFits:
    """Fits of beads, linear about `fitted` (M, COUNT), the fits in an earlier image.

    `which` (M,): rows of the beads among all; `linear` (M,) bool: the others must be fitted in full. `squares` (M,):
    sum of squared residuals in the earlier image.
    """

    which: np.ndarray
    fitted: np.ndarray
    linear: np.ndarray
    squares: np.ndarray
    mask: np.ndarray
    kept: Windows
    fit: BeadFitter

    @classmethod
    def about(
        cls,
        fit: BeadFitter,
        image: Radiograph,
        rows: np.ndarray,
        which: np.ndarray,
        fitted: np.ndarray,
        *,
        mask: np.ndarray,
    ) -> Self:
        """Return the linear fits about `fitted`, the result of `fit(rows, which)` in `image`.

        `mask` (H, W): the field, without burnt-in annotations.
        """
        spots, known = rows.copy(), rows.copy()
        known[which] = np.where(fitted[:, [STATUS]] == FITTED, fitted, rows[which])
        spots[:, [AXIAL, DIAGONAL]] = 0.0
        prior_sd = np.repeat(PRIOR_SD[:, None], len(rows), axis=1)
        kept = Windows.empty(rows[which, RADIUS])
        in_parts(keep_part, fit.log_image, fit.usable, mask, spots, known, which, *fit.optics, prior_sd, kept)
        start = cls(which, fitted, np.ones(len(which), dtype=bool), np.ones(len(which)), mask, kept, fit)
        again = start._stepped(image)
        off2 = ((again[:, :2] - fitted[:, :2]) ** 2).sum(axis=1)
        linear = _sound(again) & (fitted[:, STATUS] == FITTED)
        linear &= off2 < _AGREES_SD**2 * (fitted[:, CUU] + fitted[:, CVV])
        return cls(which, fitted, linear, np.where(linear, again[:, CHI2], 1.0), mask, kept, fit)

    def __call__(self, image: Radiograph) -> tuple[np.ndarray, np.ndarray]:
        """Return the fits (M, COUNT) in another image of the sequence, and which of them hold, (M,) bool.

        The covariances are those of the earlier image, scaled by the residuals as those of a fit are.
        """
        out = self._stepped(image)
        out[:, CENTRE_COVARIANCE] *= ((PRIOR_PIXELS + out[:, CHI2]) / (PRIOR_PIXELS + self.squares))[:, None]
        out[:, CHI2] *= self.fitted[:, CHI2] / self.squares
        return out, self.linear & _sound(out)

    def _stepped(self, image: Radiograph) -> np.ndarray:
        """Return `__call__`, with the covariances of the fit and the whole sum of squares as CHI2."""
        out, pixels = self.fitted.copy(), image.pixels
        levels = np.float32(darkest(image)), np.float32(np.exp(self.fit.brightest))
        reach, dark = _OF_NOISE * reach_px(self.fitted), self.fitted[:, CONTRAST] < 0
        in_parts(step_part, pixels, self.mask, *levels, reach, dark, *self.fit.optics[1:], self.kept, out)
        return out


def reach_px(rows: np.ndarray) -> np.ndarray:
    """Return the common movement (N,), px, up to which linear fits of beads `rows` (N, COUNT) hold."""
    return (_ALLOWED_SD / _BEND) ** 0.5 * np.maximum(0.5 * (rows[:, CUU] + rows[:, CVV]), 0.0) ** 0.25


def _sound(rows: np.ndarray) -> np.ndarray:
    """Return (N,) bool: which rows are near fits, with a residual for which a fit would not look for metal."""
    return (rows[:, STATUS] == FITTED) & (rows[:, EXCESS] <= SUSPICIOUS_EXCESS)
