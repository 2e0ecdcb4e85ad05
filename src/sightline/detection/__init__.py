"""Detection, measurement and labelling of beads."""

from sightline.detection.again import look_again
from sightline.detection.detector import detect
from sightline.detection.labelling import is_inverted, label
from sightline.detection.results import Detections, Observations, RejectedCandidate

__all__ = ["Detections", "Observations", "RejectedCandidate", "detect", "is_inverted", "label", "look_again"]
