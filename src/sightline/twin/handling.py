"""What befalls a frame between the day it is measured and the day it is used: heat, water, the weight of drapes."""

from dataclasses import dataclass, replace

import numpy as np

from sightline.errors import SetUpError
from sightline.frame import Frame, Plate
from sightline.twin.carm import SetUp, displaced

EXPANSION_PER_K = 70e-6  # PMMA [mem, physics.md]
SWELLING = 0.2  # growth in length per share of mass taken up as water: 1 % of water, 0.2 % [mem]
DRAPE_N = 10.0  # a wet drape over one arm: sags a plate by one plate tolerance [ours]
DOWN = np.array([0.0, 0.0, -1.0])  # the patient lies supine: +Z is up


@dataclass(frozen=True)
class Handling:
    """Against the state in which the frame was measured: warmer, K; water taken up, share of mass; load per arm, N."""

    warmer_k: float = 0.0
    water_share: float = 0.0
    drape_n: float = 0.0

    def __post_init__(self) -> None:
        if not (-100 < self.warmer_k < 100 and -0.03 < self.water_share < 0.03 and 0 <= self.drape_n < 1000):
            raise SetUpError(f"no frame of PMMA is used so: {self}")


@dataclass(frozen=True)
class HandlingSpread:
    """What handlings are drawn from [ours]."""

    warmer_k: float = 5.0  # s.d.: lamps and draughts against a measuring room
    water_share: float = 0.002  # s.d., either way: wiped wet or dried since
    drape_n: float = 20.0  # uniform from none


def draw_handling(rng: np.random.Generator, spread: HandlingSpread | None = None) -> Handling:
    """A handling from its distribution."""
    spread = spread or HandlingSpread()
    warmer, water = rng.normal(0.0, [spread.warmer_k, spread.water_share])
    return Handling(float(warmer), float(np.clip(water, -0.02, 0.02)), float(rng.uniform(0.0, spread.drape_n)))


def in_use(frame: Frame, handling: Handling) -> Frame:
    """The frame as it is while it is used.

    Each plate grows about its middle by heat and water; a drape lowers and tilts it by a plate's tolerance (about Y, to
    either side's arm alike) for each DRAPE_N. The metal of the arms keeps its length.
    """
    stretch = EXPANSION_PER_K * handling.warmer_k + SWELLING * handling.water_share
    tolerance, load = frame.effective_tolerances, handling.drape_n / DRAPE_N
    sag, tilt = load * tolerance.plate_mm * DOWN, load * tolerance.plate_rad * np.array([0.0, 1.0, 0.0])

    def move(plate: Plate) -> np.ndarray:
        centred = plate.xyz_mm - plate.xyz_mm.mean(axis=0)
        return stretch * centred + np.cross(tilt, centred) + sag

    plates = [plate for view in frame.views.values() for plate in (view.xrii, view.source)]
    return displaced(frame, np.concatenate([move(plate) for plate in plates]))


def handled(setup: SetUp, handling: Handling) -> SetUp:
    """A set-up whose true frame, with the errors it was made with, has been handled; the software is not told."""
    return replace(setup, true_frame=in_use(setup.true_frame, handling))
