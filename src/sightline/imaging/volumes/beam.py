"""The X-ray beam and its attenuation: three energies that represent 70 kVp, or the spectrum of a tungsten tube.

Both show beam hardening.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from importlib.resources import files

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
# A 70 kVp spectrum has no photons of 80 keV: the table is interpolated at energies below 70, linearly in log-log (none
# of the materials has an absorption edge there). Weights: share of photons before the patient [ours].
ENERGIES_KEV = np.array([40.0, 50.0, 60.0])
WEIGHTS = np.array([0.45, 0.35, 0.20])


THREE = "three energies"


@dataclass(frozen=True, eq=False)
class Spectrum:
    """N energies, keV; their shares (N,) of the photons before the patient; attenuation (N,) of each material, 1/mm."""

    energies_kev: np.ndarray
    weights: np.ndarray
    per_mm: Mapping[str, np.ndarray]


@lru_cache(maxsize=1)
def _spectra() -> dict[str, Spectrum]:
    """Return the spectra by name. Those of tungsten tubes are made by tools/make_spectra.py [calc, spekpy, xraydb]."""
    at = np.log(ENERGIES_KEV)
    three = {name: np.exp(np.interp(at, np.log(TABLE_KEV), np.log(row))) / 10 for name, row in TABLE_PER_CM.items()}
    spectra = {THREE: Spectrum(ENERGIES_KEV, WEIGHTS, three)}
    tubes = files("sightline.imaging.volumes").joinpath("spectra.json").read_text("utf-8")
    for name, tube in json.loads(tubes).items():
        per_mm = {material: np.array(row) / 10 for material, row in tube["per_cm"].items()}
        spectra[name] = Spectrum(np.array(tube["kev"]), np.array(tube["weights"]), per_mm)
    return spectra


def spectrum(name: str) -> Spectrum:
    """Return the spectrum called `name`. Raises UnusableInputError, which lists the valid names."""
    if name not in _spectra():
        raise UnusableInputError(f"there is no spectrum {name!r}; there are: {', '.join(_spectra())}")
    return _spectra()[name]


def attenuation_per_mm(material: str, beam: str = THREE) -> np.ndarray:
    """Return the linear attenuation (N,) of a material at a spectrum's energies, 1/mm.

    Raises UnusableInputError, which lists the valid names.
    """
    if material not in TABLE_PER_CM:
        raise UnusableInputError(f"there is no material {material!r}; there are: {', '.join(TABLE_PER_CM)}")
    return spectrum(beam).per_mm[material]


def excess_per_mm(material: str, within: str | None, beam: str = THREE) -> np.ndarray:
    """Return the attenuation (N,) of a material above that of the one it displaces, 1/mm; None: air, taken as 0."""
    return attenuation_per_mm(material, beam) - (0.0 if within is None else attenuation_per_mm(within, beam))
