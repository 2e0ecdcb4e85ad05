"""A small frame, and measurements of it by an instrument in any pose."""

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from sightline.frame import Fiducial, Frame, FrameView, Plate, Tolerances
from sightline.frame.tables import Series
from sightline.twin.xray.setup import with_errors

SD_MM = 0.005
# Off any grid, so that no plate turned or mirrored is itself.
_PLACES = (
    (-41.0, -38.5), (3.0, -40.0), (39.5, -37.0), (-40.0, 2.5), (1.5, 0.5), (42.0, 4.0), (-37.5, 40.5), (9.0, 38.0),
)  # fmt: skip


def _plate(name: str, at) -> Plate:
    balls = enumerate(_PLACES)
    return Plate(tuple(Fiducial(f"{name}{k}", at(x, y), 5.0 if k < 3 else 3.0, k < 3) for k, (x, y) in balls))


FRAME = Frame(
    "small",
    {
        "pa": FrameView(_plate("px", lambda x, y: (x, y, 300.0)), _plate("ps", lambda x, y: (y, 0.9 * x, 150.0))),
        "lateral": FrameView(_plate("lx", lambda x, y: (300.0, x, y)), _plate("ls", lambda x, y: (150.0, y, 0.8 * x))),
    },
    tolerances=Tolerances(),
)
NOMINAL_MM = FRAME.xyz_mm
IDS = tuple(f.id for f in FRAME.fiducials)


def made(rng: np.random.Generator) -> np.ndarray:
    """(32, 3): where the balls of a frame of these tolerances are."""
    return with_errors(FRAME, rng).xyz_mm


def measured(
    xyz_mm: np.ndarray, rng: np.random.Generator, name: str = "1", *, sd_mm=SD_MM, stated=True, ids=IDS
) -> Series:
    """A series of these balls, from an instrument in any pose."""
    pose = RigidTransform.from_components(rng.uniform(-900, 900, 3), Rotation.random(rng=rng))
    noisy = pose.apply(xyz_mm) + sd_mm * rng.standard_normal(xyz_mm.shape)
    covariance = sd_mm**2 * np.eye(noisy.size) if stated else None
    return Series(name, ids, noisy, covariance, np.full(len(noisy), np.nan))
