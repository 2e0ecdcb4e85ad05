"""Which fiducial of which plate each bead is."""

from sightline.detection.labelling.label import is_inverted, label

__all__ = ["is_inverted", "label"]
