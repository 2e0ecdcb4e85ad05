"""Outlying beads: each is tested against the prediction of the others; the worst are left out one at a time."""

import numpy as np

from sightline.calibration.plates.beads import Beads
from sightline.calibration.plates.joint import JointFit, fit_jointly
from sightline.calibration.residuals import Residuals
from sightline.errors import CalibrationRefusedError
from sightline.fitting.kriging import LeftOut
from sightline.fitting.robust import variance_ratio

# Once in 10,000 views a correct bead is rejected: chi-square, two degrees of freedom, over all beads of a view [ours].
FALSE_ALARM = 1e-4
# More outliers than this, or than this share, mean a wrong frame, image or labelling [ours].
MAX_WRONG = 6
MAX_WRONG_SHARE = 0.1


def fit_robustly(beads: Beads) -> tuple[JointFit, Residuals]:
    """Return the joint fit without outlying beads, and the residuals of all. Raises CalibrationRefusedError."""
    used = np.ones(len(beads), dtype=bool)
    limit = max(1, min(MAX_WRONG, int(MAX_WRONG_SHARE * len(beads))))
    while True:
        fit = fit_jointly(beads.where(used))
        others = fit.solution.left_out()
        square = others.m2
        # If all residuals are too large, the stated noise is too small: the chi-square check reports that.
        common = max(1.0, variance_ratio(square))
        worst = int(np.argmax(square))
        if square[worst] <= -2 * np.log(FALSE_ALARM / len(square)) * common:
            return fit, _residuals(fit, beads, used, others)
        if (~used).sum() == limit:
            wrong = [i for i, u in zip(beads.ids, used, strict=True) if not u]
            raise CalibrationRefusedError(
                f"more than {limit} beads contradict the others ({', '.join(wrong)} and {fit.beads.ids[worst]} first); "
                "check that frame, view and labels are right and that the frame is undamaged, then acquire another "
                "image"
            )
        used[np.flatnonzero(used)[worst]] = False


def _residuals(fit: JointFit, beads: Beads, used: np.ndarray, others: LeftOut) -> Residuals:
    """Return the residuals of every bead given; a bead that was left out is predicted by all that were used."""
    residual = fit.map.to_plane(beads.uv_px) - fit.pencil.project(beads.xyz_mm)
    loo, sigma = residual.copy(), np.zeros(len(beads))
    loo[used], sigma[used] = -others.residual, np.sqrt(np.maximum(others.m2, 0.0))
    if not used.all():
        sigma[~used] = fit.prediction_sigma(beads.where(~used))
    return Residuals(beads.ids, beads.uv_px, residual, loo, np.ones(len(beads), dtype=bool), sigma, used)
