"""What is known of the camera before a cloud of balls is labelled, and the evidence for a labelling."""

import numpy as np
from scipy.special import gammaln

from sightline.detection.labelling.pinhole import PARAMETERS, Fit, Prior

PRINCIPAL_SD = 0.1  # of the principal point about the image's middle, over the longer side: cropped images [ours]
LOG_SCALES = 3.0  # range of the log scale: 0.5 to 10 px/mm [ours]


def prior_of(focal_px: tuple[float, float], image_shape: tuple[int, int]) -> Prior:
    """Return the priors for focal lengths from low to high (95 %) and an image of (H, W) pixels.

    >>> prior_of((5000.0, 5400.0), (1024, 1024)).principal_px
    array([511.5, 511.5])
    """
    low, high = np.log(focal_px)
    height, width = image_shape
    middle = np.array([width - 1.0, height - 1.0]) / 2
    return Prior((low + high) / 2, max((high - low) / 4, 1e-3), middle, PRINCIPAL_SD * max(width, height))


def log_evidence(one: Fit, prior: Prior, matched: int, balls: int, detections: int) -> float:
    """Return minus the log of the chance that false detections alone match a cloud as well as this fit does.

    `prior`: of `prior_of`. The chance is the union bound over all labellings of `matched` of the balls: their number
    over the likelihood ratio of the fit (marginal over the camera, by Laplace's method) to detections spread evenly
    over the image, both hands.
    """
    area_px2 = float(np.prod(2.0 * prior.principal_px + 1.0))  # of the image, whose middle it is
    labellings = (
        gammaln(balls + 1) - gammaln(matched + 1) - gammaln(balls - matched + 1)
        + gammaln(detections + 1) - gammaln(detections - matched + 1) + np.log(2)
    )  # fmt: skip
    _, log_det = np.linalg.slogdet(one.precision)
    log_prior = -np.log(8 * np.pi**2 * area_px2 * LOG_SCALES)
    log_prior -= np.log(prior.log_focal_sd * prior.principal_sd_px**2) + 1.5 * np.log(2 * np.pi)
    occam = log_prior + PARAMETERS / 2 * np.log(2 * np.pi) - log_det / 2
    return matched * np.log(area_px2 / (2 * np.pi)) - one.half_log_det - one.chi2 / 2 + occam - labellings
