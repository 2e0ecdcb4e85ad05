"""Labelling: assign each bead to a fiducial of a plate."""

from sightline.detection.labelling.label import is_inverted, label

__all__ = ["is_inverted", "label"]
