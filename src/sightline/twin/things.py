"""Things with sharp edges in the beam: balls, washers, wires and screws, plates. Lengths mm, places in CFCS."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from sightline.frame import Fiducial, Frame, Plate
from sightline.twin.beam import attenuation_per_mm

Point: TypeAlias = tuple[float, float, float]
PLATE_MM = 8.0  # thickness of a calibration plate [ours]
PLATE_RIM_MM = 8.0  # how far a plate reaches beyond its outermost beads [ours]
WASHER_HOLE = 0.5  # inner over outer diameter [ours]
WASHER_MM = 1.5  # thickness [ours]


@dataclass(frozen=True)
class Ball:
    """A ball of steel set into another material, which it displaces."""

    centre_mm: Point
    radius_mm: float
    within: str = "pmma"


@dataclass(frozen=True)
class Rod:
    """A steel cylinder, or a tube or washer where `hole_mm` > 0, set into another material, which it displaces.

    `axis` is a unit vector; `half_mm` half the length along it.
    """

    centre_mm: Point
    axis: Point
    radius_mm: float
    half_mm: float
    hole_mm: float = 0.0
    within: str = "tissue"


@dataclass(frozen=True, eq=False)
class Box:
    """A cuboid of PMMA. `axes` (3, 3): rows are its own axes; `half_mm` (3,)."""

    centre_mm: np.ndarray
    axes: np.ndarray
    half_mm: np.ndarray


Solid: TypeAlias = Ball | Rod

# Columns of a packed solid.
CENTRE, AXIS, RADIUS, HOLE, HALF = slice(0, 3), slice(3, 6), 6, 7, 8
COLUMNS = 9


def pack(solids: Sequence[Solid]) -> tuple[np.ndarray, np.ndarray]:
    """Solids as numbers: shapes (M, 9), half-length negative for a ball; attenuation above what they displace (M, 3),
    1/mm at ENERGIES_KEV."""
    shapes, excess = np.zeros((len(solids), COLUMNS)), np.zeros((len(solids), 3))
    steel = attenuation_per_mm("steel")
    for row, one in enumerate(solids):
        shapes[row, CENTRE], shapes[row, RADIUS] = one.centre_mm, one.radius_mm
        excess[row] = steel - attenuation_per_mm(one.within)
        if isinstance(one, Rod):
            shapes[row, AXIS], shapes[row, HOLE], shapes[row, HALF] = one.axis, one.hole_mm, one.half_mm
        else:
            shapes[row, HALF] = -1.0
    return shapes, excess


def stations(shapes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points (D, 3) along the axes of packed solids (M, 9), at most half a radius apart (a ball: its centre), and which
    solid each belongs to (D,)."""
    places, owner = [], []
    for m, shape in enumerate(shapes):
        half = max(shape[HALF], 0.0)
        steps = np.linspace(-half, half, 1 + int(np.ceil(4 * half / shape[RADIUS])))
        places.append(shape[CENTRE] + steps[:, None] * shape[AXIS])
        owner.append(np.full(len(steps), m))
    return np.concatenate([np.zeros((0, 3)), *places]), np.concatenate([np.zeros(0, dtype=int), *owner])


def frame_solids(frame: Frame) -> tuple[Solid, ...]:
    """The beads of all views of a frame, where they are."""
    return tuple(
        _bead(bead, plate)
        for view in frame.views.values()
        for plate in (view.xrii, view.source)
        for bead in plate.fiducials
    )


def _bead(bead: Fiducial, plate: Plate) -> Solid:
    if bead.shape == "ball":
        return Ball(bead.xyz_mm, bead.diameter_mm / 2)
    x, y, z = (float(c) for c in plate.plane.normal)
    hole = WASHER_HOLE * bead.diameter_mm / 2
    return Rod(bead.xyz_mm, (x, y, z), bead.diameter_mm / 2, WASHER_MM / 2, hole_mm=hole, within="pmma")


def frame_boxes(frame: Frame) -> tuple[Box, ...]:
    """The PMMA plates of all views of a frame, as large as their beads need."""
    return tuple(_plate_box(plate) for view in frame.views.values() for plate in (view.xrii, view.source))


def _plate_box(plate: Plate) -> Box:
    xy = plate.plane.to_plane(plate.xyz_mm)
    low, high = xy.min(axis=0) - PLATE_RIM_MM, xy.max(axis=0) + PLATE_RIM_MM
    return Box(
        centre_mm=plate.plane.to_space((low + high) / 2),
        axes=np.vstack([plate.plane.axes, plate.plane.normal]),
        half_mm=np.array([*(high - low) / 2, PLATE_MM / 2]),
    )
