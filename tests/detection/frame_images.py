"""Small images of the frame's PA beads by a pinhole camera, for sequences in which frame or C-arm moves."""

import numpy as np
from tests.detection.bead_images import Bead, quanta, radiograph

from sightline.frame import Frame
from sightline.imaging import Radiograph

FRAME = Frame.load("gamma")
SIZE, PITCH_MM, FOCAL_MM, DETECTOR_MM = 512, 0.43, np.array([9.3, -6.1, -618.4]), 381.6
QUANTA = 250.0


def place(xyz_mm: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return pixels of points, and their magnification, px/mm."""
    scale = (DETECTOR_MM - FOCAL_MM[2]) / (xyz_mm[:, 2] - FOCAL_MM[2]) / PITCH_MM
    return (SIZE - 1) / 2 + 0.3 + (xyz_mm[:, :2] - FOCAL_MM[:2]) * scale[:, None] + FOCAL_MM[:2] / PITCH_MM, scale


def beads(shift_mm: tuple[float, float, float] = (0.0, 0.0, 0.0), leave_out: int = 0) -> dict[str, Bead]:
    """Return an image of the moved PA beads, without the first `leave_out` of them."""
    fiducials = FRAME.view("pa").fiducials
    uv, scale = place(np.array([f.xyz_mm for f in fiducials]) + shift_mm)
    radius = scale * [f.diameter_mm / 2 for f in fiducials]
    every = {f.id: Bead(u, v, r) for f, (u, v), r in zip(fiducials, uv, radius, strict=True)}
    inside = {i: b for i, b in every.items() if min(b.u, b.v) > 14 and max(b.u, b.v) < SIZE - 15}
    return dict(list(inside.items())[leave_out:])


def image(shown: dict[str, Bead], seed: int) -> Radiograph:
    return radiograph(quanta(list(shown.values()), np.full((SIZE, SIZE), QUANTA)), np.random.default_rng(seed))
