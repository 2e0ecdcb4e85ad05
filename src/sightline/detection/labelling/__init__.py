"""Which fiducial of which plate each bead is."""

from sightline.detection.labelling.label import label

__all__ = ["label"]
