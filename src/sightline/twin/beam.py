"""The X-ray beam and what attenuates it: three energies stand for a 70 kVp spectrum; beam hardening comes with them."""

import numpy as np

from sightline.errors import UnusableInputError

TABLE_KEV = np.array([40.0, 60.0, 80.0])
# 1/cm at 40, 60, 80 keV [calc, xraydb]
TABLE_PER_CM = {
    "steel": (30.3, 10.1, 4.95),  # 316L
    "bone": (1.278, 0.604, 0.428),  # cortical
    "tissue": (0.285, 0.217, 0.193),
    "pmma": (0.280, 0.229, 0.208),
    "titanium": (9.41, 3.28, 1.75),  # Ti6Al4V
    "aluminium": (1.535, 0.750, 0.545),
    "polyethylene": (0.216, 0.187, 0.173),
    "composite": (0.570, 0.362, 0.301),  # epoxy with 51 % of glass by mass, 1.64 g/cm³
}
# A 70 kVp spectrum has no photons of 80 keV: the table is read at energies below 70, straight in log-log between its
# entries (none of the materials has an edge there). Weights: share of photons before the patient [ours].
ENERGIES_KEV = np.array([40.0, 50.0, 60.0])
WEIGHTS = np.array([0.45, 0.35, 0.20])


def attenuation_per_mm(material: str) -> np.ndarray:
    """(3,) linear attenuation of a material at ENERGIES_KEV, 1/mm. Raises UnusableInputError, naming what there is."""
    if material not in TABLE_PER_CM:
        raise UnusableInputError(f"there is no material {material!r}; there are: {', '.join(TABLE_PER_CM)}")
    table = np.log(TABLE_PER_CM[material])
    return np.exp(np.interp(np.log(ENERGIES_KEV), np.log(TABLE_KEV), table)) / 10


def excess_per_mm(material: str, within: str | None) -> np.ndarray:
    """(3,) 1/mm: what a material takes beyond what it displaces; None is air, which takes nothing here."""
    return attenuation_per_mm(material) - (0.0 if within is None else attenuation_per_mm(within))
