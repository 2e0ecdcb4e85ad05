"""Images of a solid on flat panels, as points: cameras at C-arm distances, drawn from the priors."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from sightline.calibration import CArm
from sightline.calibration.solids.panel_camera import PanelCamera
from sightline.detection import Observations
from sightline.frame import Frame

SHAPE, PIXEL_MM, DISTANCE_MM, SOURCE_MM = (1536, 1536), 0.194, 1000.0, 620.0  # a flat panel; the source to the solid
C_ARM = CArm(DISTANCE_MM, PIXEL_MM)
# The camera axes of the PA and the lateral beam: rows right, down, beam.
BEAMS = {
    "pa": np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]),
    "lateral": np.array([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]]),
}


def camera(rng: np.random.Generator, view: str, *, aim_mm: Sequence[float] = (0.0, 0.0, 0.0), mirrored: bool = False):
    """A camera whose axis passes near `aim_mm`."""
    rotation = Rotation.from_rotvec(rng.normal(0.0, 0.05, 3)).as_matrix() @ BEAMS[view]
    middle = np.array([*rng.uniform(-10.0, 10.0, 2), SOURCE_MM + rng.uniform(-30.0, 30.0)])
    focal = (DISTANCE_MM + 10.0 * rng.standard_normal()) / PIXEL_MM
    centre = (np.array(SHAPE[::-1]) - 1) / 2 + 5.0 / PIXEL_MM * rng.standard_normal(2)
    return PanelCamera(rotation, middle - rotation @ np.array(aim_mm), focal, centre, mirrored)


def built(rng: np.random.Generator, frame: Frame) -> np.ndarray:
    """(M, 3): where the balls of a solid of these tolerances are."""
    factor = frame.error_factor
    assert frame.solid is not None
    return frame.solid.xyz_mm + (factor @ rng.standard_normal(factor.shape[1])).reshape(-1, 3)


def seen(rng: np.random.Generator, frame: Frame, xyz_mm: np.ndarray, truth: PanelCamera, view: str, sd_px: float = 0.1):
    """Observations of all balls."""
    radius = np.array([f.diameter_mm for f in frame.fiducials]) / 2
    uv, _, _ = truth.shadows(xyz_mm, radius)
    noise = np.broadcast_to(sd_px**2 * np.eye(2), (len(uv), 2, 2))
    ids = tuple(f.id for f in frame.fiducials)
    return Observations(view, ids, uv + sd_px * rng.standard_normal(uv.shape), noise, image_shape=SHAPE)


def turned_images(
    rng: np.random.Generator, frame: Frame, xyz_mm: np.ndarray, count: int, sd_px: float = 0.1
) -> list[Observations]:
    """Images of a solid that is turned by up to 45° about two axes between them."""
    given = []
    for k in range(count):
        one = camera(rng, "pa")
        turn = Rotation.from_euler("xy", rng.uniform(-45.0, 45.0, 2), degrees=True).as_matrix()
        given.append(seen(rng, frame, xyz_mm, replace(one, rotation=one.rotation @ turn), f"image-{k}", sd_px))
    return given
