"""Calibration of a sequence of images: each starts from what the last one left."""

from functools import partial

from sightline.calibration.bead_view import BeadView
from sightline.calibration.beads import match
from sightline.calibration.calibrate import calibrate, smooth_view
from sightline.calibration.joint import JointFit, fit_jointly_from
from sightline.checks import failed
from sightline.detection.results import Observations
from sightline.errors import UnusableInputError
from sightline.frame import Frame

MAX_CHANGED_SHARE = 0.1  # share of its beads in which an image may differ before the prior is learnt anew [ours]


def recalibrate(observations: Observations, frame: Frame, last: BeadView) -> BeadView:
    """The view that the beads of one image determine, by the smooth method, from that of an image shortly before.

    The prior of the map stays as it was learnt then, and one step leads from its focal point. Where the beads are not
    nearly the same ones, or contradict each other or their noise so, the whole of `calibrate` is done.
    Raises what `calibrate` raises, UnusableInputError where `last` is of another method.
    """
    before = last.posterior
    if not isinstance(before, JointFit):
        raise UnusableInputError("only the smooth method goes on from a view before; calibrate each image by itself")
    both = set(observations.ids) & set(last.residuals.ids)
    if len(both) < (1 - MAX_CHANGED_SHARE) * max(len(observations.ids), len(last.residuals.ids)):
        return calibrate(observations, frame, last.name)
    view = smooth_view(match(observations, frame, last.name), partial(fit_jointly_from, before))
    suspicious = failed(view.checks) and not failed(last.checks)
    return calibrate(observations, frame, last.name) if suspicious else view
