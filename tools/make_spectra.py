"""Compute src/sightline/imaging/volumes/spectra.json: tungsten spectra and the attenuation of materials.

Needs spekpy 2.5 (MIT, 208 MB of tables) and xraydb 4.5 (MIT), which the package does not need:
`pip install --group tables`, then `python tools/make_spectra.py`. Bins of 5 keV; energy and attenuation of each are
means over its photons.
"""

import json
from pathlib import Path

import numpy as np
import spekpy
import xraydb

OUT = Path(__file__).parents[1] / "src" / "sightline" / "imaging" / "volumes" / "spectra.json"
BIN_KEV = 5.0
ANODE_DEG = 12.0  # [mem]
SPECTRA = {  # kVp, filters in mm
    "70kVp-3Al": (70.0, {"Al": 3.0}),  # [mem] the minimum filtration of a C-arm
    "70kVp-3Al-0.1Cu": (70.0, {"Al": 3.0, "Cu": 0.1}),  # [mem] a modern C-arm
}
# Shares by mass and g/cm³, as for the table in beam.py: bone and tissue of ICRU [mem].
MATERIALS = {
    "steel": ({"Fe": 0.655, "Cr": 0.17, "Ni": 0.12, "Mo": 0.025, "Mn": 0.02, "Si": 0.01}, 8.0),
    "bone": (
        {
            "H": 0.034,
            "C": 0.155,
            "N": 0.042,
            "O": 0.435,
            "Na": 0.001,
            "Mg": 0.002,
            "P": 0.103,
            "S": 0.003,
            "Ca": 0.225,
        },
        1.92,
    ),
    "tissue": (
        {
            "H": 0.102,
            "C": 0.143,
            "N": 0.034,
            "O": 0.708,
            "Na": 0.002,
            "P": 0.003,
            "S": 0.003,
            "Cl": 0.002,
            "K": 0.003,
        },
        1.06,
    ),
    "pmma": ({"C": 0.5998, "H": 0.0805, "O": 0.3196}, 1.19),
    "titanium": ({"Ti": 0.90, "Al": 0.06, "V": 0.04}, 4.43),
    "aluminium": ({"Al": 1.0}, 2.70),
    "polyethylene": ({"C": 0.8563, "H": 0.1437}, 0.95),
    "composite": ({"Si": 0.2382, "O": 0.3747, "C": 0.3528, "H": 0.0343}, 1.64),
}


def per_cm(material: str, kev: np.ndarray) -> np.ndarray:
    """Return the attenuation (N,), 1/cm, at energies (N,), keV."""
    shares, density = MATERIALS[material]
    formula = "".join(f"{element}{share / xraydb.atomic_mass(element):.6f}" for element, share in shares.items())
    return xraydb.material_mu(formula, 1000 * kev, density=density)


def binned(kvp: float, filters: dict[str, float]) -> dict:
    """Return one spectrum: mean energies, shares of the photons, 1/cm of every material."""
    beam = spekpy.Spek(kvp=kvp, th=ANODE_DEG, dk=0.5)
    for element, mm in filters.items():
        beam.filter(element, mm)
    kev, photons = beam.get_spectrum(edges=False)
    which = np.floor(kev / BIN_KEV).astype(int)
    share = np.bincount(which, photons)
    kept = share > 1e-3 * share.sum()  # each other bin has less than a thousandth

    def mean(values: np.ndarray) -> list[float]:
        return [round(float(x), 5) for x in (np.bincount(which, photons * values)[kept] / share[kept])]

    return {
        "kev": mean(kev),
        "weights": [round(float(x), 5) for x in share[kept] / share[kept].sum()],
        "per_cm": {material: mean(per_cm(material, kev)) for material in MATERIALS},
        "half_value_mm_al": round(float(beam.get_hvl1()), 3),
    }


if __name__ == "__main__":
    OUT.write_text(json.dumps({name: binned(*one) for name, one in SPECTRA.items()}, indent=1) + "\n")
