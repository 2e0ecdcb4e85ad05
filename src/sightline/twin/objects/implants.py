"""Metal and drapes in the beam: guide wire, lag screw, angled plate, drill guide, table rail. CFCS, mm."""

from itertools import pairwise

import numpy as np

from sightline.errors import SetUpError
from sightline.twin.objects.things import Box, Scene, SoftTissue, rod_between

WIRE_DIAMETER_MM = 2.5  # [paper]
WIRE_LENGTH_MM = 200.0  # [paper]
TIP_STEP_MM = 0.1  # of the radius, from disc to disc of a trocar tip: half a pixel or less in an image [ours]
# A sliding hip screw of 135° [paper]; sizes of a common make [ours, typical].
SHANK_DIAMETER_MM = 8.0
THREAD_DIAMETER_MM, THREAD_LENGTH_MM, THREAD_PITCH_MM = 12.5, 22.0, 2.75
BORE_DIAMETER_MM = 3.2  # cannulation
BARREL_DIAMETER_MM, BARREL_LENGTH_MM = 13.0, 38.0
SIDE_PLATE_MM = (6.0, 19.0)  # thickness, width
PLATE_ABOVE_MM = 18.0  # how far the plate extends above the entry point
SCREWS, SCREW_PITCH_MM, FIRST_SCREW_MM = 4, 16.0, 22.0  # four screws [paper]
SCREW_DIAMETER_MM, SCREW_LENGTH_MM = 4.5, 38.0
SHEET_MM = 0.15  # thickness of a sterile drape of polyethylene [ours]
FOLD_SHEETS = (2, 8)  # range of the number of sheets in a fold, both included [ours]
FOLD_MM = (4.0, 15.0)  # half-width of a fold [ours]
RAIL_MM = (10.0, 25.0)  # thickness and height of an operating table's steel rail [ours, typical]
GUIDE_MM, GUIDE_LENGTH_MM, GUIDE_PLAY_MM = 10.0, 120.0, 0.2  # outer diameter, length, hole over wire [ours]
FOOT_MM, FOOT_THICK_MM = 18.0, 3.0  # the guide's foot on the skin [ours]


def guide_wire(
    wire_mm: np.ndarray,
    diameter_mm: float = WIRE_DIAMETER_MM,
    length_mm: float = WIRE_LENGTH_MM,
    within: str | None = "tissue",
) -> Scene:
    """Return a straight steel wire with its tip at the second of two points (2, 3) and its axis through the first."""
    tip, back = _axis(wire_mm)
    discs = int(np.ceil(diameter_mm / 2 / TIP_STEP_MM))
    at = np.append(np.linspace(0.0, 1.5 * diameter_mm, discs + 1), length_mm)  # a tip of 1.5 diameters [ours]
    wide = np.append((np.arange(discs) + 0.5) / discs, 1.0) * diameter_mm / 2
    parts = zip(pairwise(at), wide.tolist(), strict=True)
    return Scene(solids=tuple(rod_between(tip + a * back, tip + b * back, r, within=within) for (a, b), r in parts))


def lag_screw(wire_mm: np.ndarray) -> Scene:
    """Return a cannulated lag screw over a wire (2, 3), its shank reaching to the entry, its thread made of rings."""
    tip, back = _axis(wire_mm)
    outer, inner = THREAD_DIAMETER_MM / 2, SHANK_DIAMETER_MM / 2
    rings = [
        rod_between(tip + a * back, tip + (a + THREAD_PITCH_MM / 4) * back, outer, inner)
        for a in np.arange(0.0, THREAD_LENGTH_MM, THREAD_PITCH_MM)
    ]
    return Scene(solids=(rod_between(tip, wire_mm[0], inner, BORE_DIAMETER_MM / 2), *rings))


def angled_plate(wire_mm: np.ndarray, caudal: np.ndarray) -> Scene:
    """Return the plate on the lateral cortex: barrel around the wire (2, 3), blade along `caudal` (3,), four screws.

    Raises SetUpError if the wire runs along the shaft.
    """
    _, back = _axis(wire_mm)
    down = np.asarray(caudal, dtype=np.float64) / np.linalg.norm(caudal)
    out = back - (back @ down) * down
    if np.linalg.norm(out) < 0.1:
        raise SetUpError("the wire runs along the shaft; an angled plate needs an angle")
    out /= np.linalg.norm(out)
    entry = np.asarray(wire_mm, dtype=np.float64)[0]
    thick, wide = SIDE_PLATE_MM
    reach = FIRST_SCREW_MM + SCREW_PITCH_MM * (SCREWS - 1) + 10.0
    middle = entry + out * thick / 2 + down * (reach - PLATE_ABOVE_MM) / 2
    half = np.array([thick, wide, reach + PLATE_ABOVE_MM]) / 2
    blade = Box(middle, np.stack([out, np.cross(down, out), down]), half, material="steel", within="tissue")
    inside = entry - BARREL_LENGTH_MM * back
    barrel = rod_between(entry, inside, BARREL_DIAMETER_MM / 2, SHANK_DIAMETER_MM / 2)
    heads = [entry + down * (FIRST_SCREW_MM + SCREW_PITCH_MM * k) for k in range(SCREWS)]
    screws = [rod_between(head, head - SCREW_LENGTH_MM * out, SCREW_DIAMETER_MM / 2) for head in heads]
    return Scene(solids=(barrel, *screws), boxes=(blade,))


def _axis(wire_mm: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the end point (3,) of a wire (2, 3), and the unit vector (3,) from there to its entry."""
    entry, end = np.asarray(wire_mm, dtype=np.float64)
    length = np.linalg.norm(entry - end)
    if not length > 0:
        raise SetUpError("a wire needs two different points")
    return end, (entry - end) / length


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
