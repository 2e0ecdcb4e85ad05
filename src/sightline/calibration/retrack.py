"""Calibration of a sequence of images: each starts from the result of the previous one."""

from functools import partial

from sightline.calibration.bead_view import BeadView
from sightline.calibration.beads import match
from sightline.calibration.calibrate import calibrate, smooth_view
from sightline.calibration.joint import JointFit, fit_jointly_from
from sightline.checks import failed
from sightline.detection.results import Observations
from sightline.errors import UnusableInputError
from sightline.frame import Frame
from sightline.threads import one_blas_thread

MAX_CHANGED_SHARE = 0.1  # share of its beads in which an image may differ before the prior is learned again [ours]


@one_blas_thread
def recalibrate(observations: Observations, frame: Frame, last: BeadView) -> BeadView:
    """Return the view calibrated from one image's beads by the smooth method, starting from the previous image's view.

    The map's prior is that of `last`, and one Gauss-Newton step starts at its focal point. Where the beads are not
    nearly the same, or a check fails that passed before, the full `calibrate` is run instead.
    Raises the errors of `calibrate`, and UnusableInputError where `last` is of another method.
    """
    before = last.posterior
    if not isinstance(before, JointFit):
        raise UnusableInputError(
            "give a previous view of the smooth method; with other methods calibrate each image by itself"
        )
    both = set(observations.ids) & set(last.residuals.ids)
    if len(both) < (1 - MAX_CHANGED_SHARE) * max(len(observations.ids), len(last.residuals.ids)):
        return calibrate(observations, frame, last.name)
    view = smooth_view(match(observations, frame, last.name), partial(fit_jointly_from, before))
    suspicious = failed(view.checks) and not failed(last.checks)
    return calibrate(observations, frame, last.name) if suspicious else view
