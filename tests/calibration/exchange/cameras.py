"""Random cameras about a hip, as hypothesis draws them."""

import numpy as np
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from sightline.calibration.exchange.pinhole import Pinhole


@st.composite
def pinholes(draw, mirrored: bool | None = False) -> Pinhole:
    """A C-arm's camera: any direction of the beam, 300 to 900 mm before the hip; flat detector, square-ish pixels."""
    seed = draw(st.integers(0, 2**32 - 1))
    rng = np.random.default_rng(seed)
    turn = Rotation.random(rng=rng).as_matrix()
    height, width = (int(n) for n in rng.integers(64, 2048, 2))
    pixel = tuple(float(s) for s in rng.uniform(0.1, 0.5, 2))
    sdd = rng.uniform(600, 1300)
    flip = draw(st.booleans()) if mirrored is None else mirrored
    camera = np.array(
        [
            [(-1 if flip else 1) * sdd / pixel[0], 0.0, rng.uniform(-0.5, 1.5) * width],
            [0.0, sdd / pixel[1], rng.uniform(-0.5, 1.5) * height],
            [0.0, 0.0, 1.0],
        ]
    )
    translation = np.array([*rng.uniform(-80, 80, 2), rng.uniform(300, 900)])
    return Pinhole("pa", camera, turn, translation, (height, width), (pixel[0], pixel[1]))


def points_about_hip(seed: int = 5) -> np.ndarray:
    """(20, 3) CFCS mm."""
    return np.random.default_rng(seed).uniform(-90, 90, (20, 3))


def project(pinhole: Pinhole, xyz_mm: np.ndarray) -> np.ndarray:
    """(N, 2) px, by the definition in `Pinhole`, not by its code."""
    x, y, z = (xyz_mm @ pinhole.rotation.T + pinhole.translation_mm).T
    k = pinhole.camera_matrix
    return np.column_stack([(k[0, 0] * x + k[0, 1] * y) / z + k[0, 2], k[1, 1] * y / z + k[1, 2]])


def rtk_ray(given: dict[str, float], at_mm: tuple[float, float]) -> tuple[np.ndarray, np.ndarray]:
    """Source and a place of RTK's detector (3,), world mm: from RTK's drawing of its parameters, no matrix of ours."""
    a, b, c = (np.deg2rad(-given[name]) for name in ("InPlaneAngle", "OutOfPlaneAngle", "GantryAngle"))
    rz = np.array([[np.cos(a), -np.sin(a), 0], [np.sin(a), np.cos(a), 0], [0, 0, 1]])
    rx = np.array([[1, 0, 0], [0, np.cos(b), -np.sin(b)], [0, np.sin(b), np.cos(b)]])
    ry = np.array([[np.cos(c), 0, np.sin(c)], [0, 1, 0], [-np.sin(c), 0, np.cos(c)]])
    to_world = (rz @ rx @ ry).T
    depth = given["SourceToIsocenterDistance"] - given["SourceToDetectorDistance"]
    placed = [given["ProjectionOffsetX"] + at_mm[0], given["ProjectionOffsetY"] + at_mm[1], depth]
    source = [given["SourceOffsetX"], given["SourceOffsetY"], given["SourceToIsocenterDistance"]]
    return to_world @ source, to_world @ placed
