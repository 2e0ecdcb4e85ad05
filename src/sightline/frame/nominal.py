"""The C-arm that frames are designed for and checked against; never used to compute a result."""

import numpy as np

from sightline.frame.model import FrameView

SOURCE_TO_HIP_MM = 620.0  # physics.md, C-arm and image chain [ours]
SOURCE_TO_DETECTOR_MM = 1000.0  # ARCADIS Varic 968 [src manual]
FIELD_DIAMETER_MM = 215.0  # useful field of a 9 inch intensifier [mem]


def nominal_axis(view: FrameView) -> np.ndarray:
    """(3,) unit vector, CFCS: the beam through the hip, from source to intensifier, along the middles of the plates."""
    along = view.xrii.xyz_mm.mean(axis=0) - view.source.xyz_mm.mean(axis=0)
    return along / np.linalg.norm(along)


def nominal_focal_point_mm(view: FrameView) -> np.ndarray:
    """(3,), CFCS: where the X-ray source is expected when the hip lies at the origin."""
    return -SOURCE_TO_HIP_MM * nominal_axis(view)
