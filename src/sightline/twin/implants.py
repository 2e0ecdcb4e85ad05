"""Implants as parts of a scene: guide wire, lag screw, angled plate with its screws. CFCS, mm."""

from itertools import pairwise

import numpy as np

from sightline.errors import SetUpError
from sightline.twin.things import Box, Scene, rod_between

WIRE_DIAMETER_MM = 2.5  # [paper]
WIRE_LENGTH_MM = 200.0  # [paper]
TIP_STEP_MM = 0.1  # of the radius, from disc to disc of a trocar tip: half a pixel or less in an image [ours]
# A sliding hip screw of 135° [paper]; sizes of a common make [mem].
SHANK_DIAMETER_MM = 8.0
THREAD_DIAMETER_MM, THREAD_LENGTH_MM, THREAD_PITCH_MM = 12.5, 22.0, 2.75
BORE_DIAMETER_MM = 3.2  # cannulation
BARREL_DIAMETER_MM, BARREL_LENGTH_MM = 13.0, 38.0
SIDE_PLATE_MM = (6.0, 19.0)  # thickness, width
PLATE_ABOVE_MM = 18.0  # how far the plate extends above the entry point
SCREWS, SCREW_PITCH_MM, FIRST_SCREW_MM = 4, 16.0, 22.0  # four screws [paper]
SCREW_DIAMETER_MM, SCREW_LENGTH_MM = 4.5, 38.0


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
