"""Places beside a hip where a solid of balls may stand: in both images with the whole wire, and outside the skin.

Nominal C-arm, beams along +Z and +X. The image may have any rotation, so a field counts as a disc, the largest in the
image of a panel. Each beam is aimed at the middle of what its image must show; how far the aim may miss is the place's
`margin_mm`.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import cv2
import numpy as np

from sightline.frame import Frame
from sightline.frame.nominal import SOURCE_TO_HIP_MM
from sightline.studies.study import Table
from sightline.twin.things import SoftTissue

FIELDS_MM = {"9-inch intensifier": 140.0, "30 cm panel": 185.0}  # at the hip [mem]
BLOCKS = ("block30", "block40", "block60", "cube120")
MARGIN_MM = 8.0  # aiming error per image, at the hip [ours]
DRAPES_MM = 5.0  # [ours]
COVER_MM = 3.5  # balls' centres under the solid's faces (frame/solids.py)
CLEAR_MM = 5.0  # minimum distance between an end of the wire and a ball in an image, at the hip [ours]
STEP_MM = 10.0
REACH_MM = ((-40.0, 140.0), (-100.0, 100.0), (0.0, 180.0))  # of the search: lateral, caudal, anterior
BEAM_AXES = ((2, [0, 1]), (0, [1, 2]))  # of CFCS: along the beam, across it


@dataclass(frozen=True)
class Place:
    """Where the middle of a solid may stand: `at_mm` from the middle of the wire (lateral, caudal, anterior)."""

    at_mm: tuple[float, float, float]
    margin_mm: float
    outside: bool

    @property
    def distance_mm(self) -> float:
        """Distance from the middle of the wire."""
        return float(np.linalg.norm(self.at_mm))


def places(frame: Frame, field_mm: float, wire_mm: np.ndarray) -> list[Place]:
    """Return all places, `STEP_MM` apart, of the solid of `frame` beside a wire (2, 3) for a field at the hip."""
    assert frame.solid is not None  # noqa: S101 - chosen by the study
    balls = frame.solid.xyz_mm - (frame.solid.xyz_mm.min(axis=0) + frame.solid.xyz_mm.max(axis=0)) / 2
    half = np.abs(balls).max(axis=0) + COVER_MM
    found = []
    for at in product(*(np.arange(low, high + STEP_MM, STEP_MM) for low, high in REACH_MM)):
        margin = min(_margin_mm(balls + at, wire_mm, field_mm, axis) for axis in BEAM_AXES)
        if margin >= MARGIN_MM:
            found.append(Place((float(at[0]), float(at[1]), float(at[2])), margin, _outside(np.array(at), half)))
    return found


def place_table(blocks: Sequence[str], wire_mm: np.ndarray) -> Table:
    """Return the table of where each solid may stand for each field."""
    rows = []
    for name, (what, field_mm) in product(blocks, FIELDS_MM.items()):
        every = sorted(places(Frame.load(name), field_mm, wire_mm), key=lambda one: one.distance_mm)
        free = [one for one in every if one.outside]
        nearest = f"{' / '.join(f'{mm:g}' for mm in free[0].at_mm)}: {free[0].distance_mm:.0f} mm" if free else "none"
        margin = f"{max(one.margin_mm for one in free):.0f} mm" if free else ""
        farthest = f"{every[-1].distance_mm:.0f} mm" if every else "none"
        rows.append((name, f"{what}, {field_mm:g} mm", nearest, margin, farthest))
    columns = ("solid", "field at the hip", "nearest outside the skin", "its largest margin", "farthest in the images")
    note = (
        "Middle of the solid from that of the wire: lateral / caudal / anterior, mm. Both images show the solid and "
        f"the whole wire even if aimed {MARGIN_MM:g} mm off. Margin: how far off the aim may be at the best place "
        "outside the skin, which is that of the twin's thigh with drapes."
    )
    return Table("Where a solid may stand", columns, tuple(rows), note)


def _margin_mm(balls: np.ndarray, wire: np.ndarray, field_mm: float, axes: tuple[int, list[int]]) -> float:
    """Return the field's radius at the hip less that of the least circle around balls and wire in an image; negative
    infinite where a ball hides an end."""
    along, across = axes
    seen = [xyz[:, across] * (SOURCE_TO_HIP_MM / (SOURCE_TO_HIP_MM + xyz[:, along]))[:, None] for xyz in (balls, wire)]
    if np.linalg.norm(seen[0][:, None] - seen[1], axis=2).min() < CLEAR_MM:
        return -np.inf
    return field_mm / 2 - cv2.minEnclosingCircle(np.concatenate(seen).astype(np.float32))[1]


def _outside(at_mm: np.ndarray, half_mm: np.ndarray) -> bool:
    """Return whether a box lies outside the twin's hip and thigh with drapes."""
    body = SoftTissue()
    middle, reach = np.array(body.centre_mm), np.array(body.half_mm) + DRAPES_MM
    edge = np.linspace(-1.0, 1.0, 13)
    faces = np.array([(x, z) for x, z in product(edge, edge)]) * half_mm[[0, 2]] + at_mm[[0, 2]]
    return bool((((faces - middle) / reach) ** 2).sum(axis=1).min() > 1)
