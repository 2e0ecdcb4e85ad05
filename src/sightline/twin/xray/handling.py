"""Handling errors of a frame, between its measurement and its use: heat, moisture, the weight of drapes."""

from dataclasses import dataclass

import numpy as np

from sightline.errors import SetUpError
from sightline.frame import Frame, RigidBody
from sightline.twin.xray.setup import displaced

EXPANSION_PER_K = 70e-6  # PMMA, 0.07 mm/(m K) [src data sheets of cast PMMA; physics.md, Frame]
MOISTURE_EXPANSION = (
    0.2  # relative growth in length per share of mass absorbed as water: 1 % of water, 0.2 % [ours, typical]
)
DRAPE_N = 10.0  # load of a wet drape on one arm, which displaces a plate by one plate tolerance [ours]
DOWN = np.array([0.0, 0.0, -1.0])  # the patient lies supine: +Z is up


@dataclass(frozen=True)
class Handling:
    """Change since the frame was measured: temperature, K; absorbed water, share of mass; load per arm, N."""

    warmer_k: float = 0.0
    water_share: float = 0.0
    drape_n: float = 0.0

    def __post_init__(self) -> None:
        if not (-100 < self.warmer_k < 100 and -0.03 < self.water_share < 0.03 and 0 <= self.drape_n < 1000):
            raise SetUpError(f"a frame of PMMA cannot be used so: {self}; give values within -100 to 100 K, 3 %, 1 kN")


def in_use(frame: Frame, handling: Handling) -> Frame:
    """Return the frame as it is in use, with its handling errors.

    Heat and moisture expand each plate, or the solid, about its centre. Each DRAPE_N of load lowers and tilts a plate
    by a plate tolerance (about Y, the same for the arms of both sides). The metal arms keep their length. A solid does
    not bend.
    """
    stretch = EXPANSION_PER_K * handling.warmer_k + MOISTURE_EXPANSION * handling.water_share
    tolerance, load = frame.effective_tolerances, handling.drape_n / DRAPE_N if frame.solid is None else 0.0
    sag, tilt = load * tolerance.plate_mm * DOWN, load * tolerance.plate_rad * np.array([0.0, 1.0, 0.0])

    def move(body: RigidBody) -> np.ndarray:
        centred = body.xyz_mm - body.xyz_mm.mean(axis=0)
        return stretch * centred + np.cross(tilt, centred) + sag

    return displaced(frame, np.concatenate([move(body) for body in frame.bodies]))
