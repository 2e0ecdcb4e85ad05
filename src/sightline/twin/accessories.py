"""Metal and drapes that `sightline simulate --with` adds to a specimen."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from sightline.errors import UnusableInputError
from sightline.twin.implants import angled_plate, guide_wire, lag_screw
from sightline.twin.specimens import Specimen
from sightline.twin.theatre import drape, drill_guide, table_rail
from sightline.twin.things import Scene, SoftTissue

DRAPE_GAP_MM = 2.0  # from the skin to a drape [ours]
RAIL_CENTRE_MM = (130.0, 0.0, -80.0)  # from the hip: beside the patient, at the lower edge of a lateral image [ours]


def with_accessories(specimen: Specimen, names: Sequence[str], rng: np.random.Generator) -> Specimen:
    """Return the specimen with the accessories of these names in its beams; its truth lists them under "with".

    Raises UnusableInputError for a name that is not in ACCESSORIES or an accessory that needs a hip.
    """
    scene = specimen.scene
    for name in names:
        if name not in ACCESSORIES:
            raise UnusableInputError(f"there is no accessory {name!r}; there are: {', '.join(ACCESSORIES)}")
        scene += ACCESSORIES[name](specimen, rng)
    return replace(specimen, scene=scene, truth={**specimen.truth, "with": list(names)})


def _wire(specimen: Specimen) -> np.ndarray:
    if specimen.wire_mm is None:
        raise UnusableInputError("this accessory needs the wire of a hip; simulate hip, plastic or porcine with it")
    return specimen.wire_mm


def _body(specimen: Specimen) -> SoftTissue:
    return specimen.scene.tissue or SoftTissue().around(specimen.setup.hip_mm)


def _angled_plate(specimen: Specimen, _: np.random.Generator) -> Scene:
    caudal = np.array([0.0, 1.0 if specimen.setup.side == "right" else -1.0, 0.0])
    return angled_plate(_wire(specimen), caudal)


def _drape(specimen: Specimen, rng: np.random.Generator) -> Scene:
    """Return a sheet in front of the skin for each beam."""
    body = _body(specimen)
    (x, z), (half_x, half_z) = body.centre_mm, body.half_mm
    y = specimen.setup.hip_mm[1]
    front = drape(rng, np.array([x, y, z + half_z + DRAPE_GAP_MM]), np.array([0.0, 0.0, 1.0]))
    side = drape(rng, np.array([x + half_x + DRAPE_GAP_MM, y, z]), np.array([1.0, 0.0, 0.0]))
    return front + side


def _table_rail(specimen: Specimen, _: np.random.Generator) -> Scene:
    return table_rail(specimen.setup.hip_mm + RAIL_CENTRE_MM)


ACCESSORIES: dict[str, Callable[[Specimen, np.random.Generator], Scene]] = {
    "guide-wire": lambda specimen, _: guide_wire(_wire(specimen)),
    "lag-screw": lambda specimen, _: lag_screw(_wire(specimen)),
    "angled-plate": _angled_plate,
    "drill-guide": lambda specimen, _: drill_guide(_wire(specimen), _body(specimen)),
    "drape": _drape,
    "table-rail": _table_rail,
}
