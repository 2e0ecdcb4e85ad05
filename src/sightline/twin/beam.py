"""The X-ray beam and what attenuates it: three energies stand for a 70 kVp spectrum; beam hardening comes with them."""

import numpy as np

TABLE_KEV = np.array([40.0, 60.0, 80.0])
# 1/cm at 40, 60, 80 keV [calc, xraydb]
TABLE_PER_CM = {
    "steel": (30.3, 10.1, 4.95),  # 316L
    "bone": (1.278, 0.604, 0.428),  # cortical
    "tissue": (0.285, 0.217, 0.193),
    "pmma": (0.280, 0.229, 0.208),
}
# A 70 kVp spectrum has no photons of 80 keV: the table is read at energies below 70, straight in log-log between its
# entries (none of the materials has an edge there). Weights: share of photons before the patient [ours].
ENERGIES_KEV = np.array([40.0, 50.0, 60.0])
WEIGHTS = np.array([0.45, 0.35, 0.20])


def attenuation_per_mm(material: str) -> np.ndarray:
    """(3,) linear attenuation of a material at ENERGIES_KEV, 1/mm."""
    table = np.log(TABLE_PER_CM[material])
    return np.exp(np.interp(np.log(ENERGIES_KEV), np.log(TABLE_KEV), table)) / 10
