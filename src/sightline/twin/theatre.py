"""Objects of an operating theatre in the beam: drapes, the table's rail, a drill guide. CFCS, mm."""

import numpy as np

from sightline.twin.implants import WIRE_DIAMETER_MM
from sightline.twin.things import Box, Scene, SoftTissue, rod_between

SHEET_MM = 0.15  # thickness of a sterile drape of polyethylene [ours]
FOLD_SHEETS = (2, 8)  # range of the number of sheets in a fold, both included [ours]
FOLD_MM = (4.0, 15.0)  # half-width of a fold [ours]
RAIL_MM = (10.0, 25.0)  # thickness and height of an operating table's steel rail [mem]
GUIDE_MM, GUIDE_LENGTH_MM, GUIDE_PLAY_MM = 10.0, 120.0, 0.2  # outer diameter, length, hole over wire [ours]
FOOT_MM, FOOT_THICK_MM = 18.0, 3.0  # the guide's foot on the skin [ours]


def drape(
    rng: np.random.Generator, at_mm: np.ndarray, normal: np.ndarray, half_mm: float = 150.0, folds: int = 6
) -> Scene:
    """Draw a sheet across `normal` (3,) around a point (3,), with folds of several sheets at random positions and
    angles."""
    third = np.asarray(normal, dtype=np.float64) / np.linalg.norm(normal)
    first, second = np.linalg.svd(third[None])[2][1:]
    sheet = Box(np.asarray(at_mm), np.stack([first, second, third]), np.array([half_mm, half_mm, SHEET_MM / 2]))
    boxes = [sheet]
    for _ in range(folds):
        angle = rng.uniform(0, np.pi)
        along = np.cos(angle) * first + np.sin(angle) * second
        thick = SHEET_MM * rng.integers(*FOLD_SHEETS, endpoint=True)
        across = np.cross(third, along)
        centre = sheet.centre_mm + rng.uniform(-half_mm / 2, half_mm / 2) * across + third * (thick + SHEET_MM) / 2
        half = np.array([half_mm, rng.uniform(*FOLD_MM), thick / 2])
        boxes.append(Box(centre, np.stack([along, across, third]), half))
    return Scene(boxes=tuple(Box(b.centre_mm, b.axes, b.half_mm, material="polyethylene") for b in boxes))


def table_rail(at_mm: np.ndarray, length_mm: float = 600.0) -> Scene:
    """Return the steel rail of the operating table along Y, centred at a point (3,), with its flat sides towards ±X."""
    half = np.array([RAIL_MM[0], length_mm, RAIL_MM[1]]) / 2
    return Scene(boxes=(Box(np.asarray(at_mm), np.eye(3), half, material="steel"),))


def drill_guide(wire_mm: np.ndarray, body: SoftTissue, wire_diameter_mm: float = WIRE_DIAMETER_MM) -> Scene:
    """Return a steel tube on the line of a wire (2, 3: entry, end), with its foot on the skin. Raises SetUpError."""
    entry, end = np.asarray(wire_mm, dtype=np.float64)
    back = (entry - end) / np.linalg.norm(entry - end)
    skin, hole = body.skin_mm(wire_mm), (wire_diameter_mm + GUIDE_PLAY_MM) / 2
    tube = rod_between(skin, skin + GUIDE_LENGTH_MM * back, GUIDE_MM / 2, hole, within=None)
    foot = rod_between(skin, skin + FOOT_THICK_MM * back, FOOT_MM / 2, GUIDE_MM / 2, within=None)
    return Scene(solids=(tube, foot))
