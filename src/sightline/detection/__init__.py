"""Detection, measurement and labelling of beads."""

from sightline.detection.detector import detect
from sightline.detection.labelling import is_inverted, label
from sightline.detection.results import Detections, Observations, RejectedCandidate
from sightline.detection.second_look import look_again

__all__ = ["Detections", "Observations", "RejectedCandidate", "detect", "is_inverted", "label", "look_again"]
