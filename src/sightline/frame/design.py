"""Frames designed from a few parameters: square grids of balls across the beams of two views, datums by pattern."""

from collections.abc import Mapping
from dataclasses import dataclass
from math import ceil

import numpy as np

from sightline.errors import FrameError
from sightline.frame.nominal import SOURCE_TO_HIP_MM
from sightline.frame.plate import Fiducial, FrameView, Plate
from sightline.geometry.planes import Plane

Pattern = tuple[tuple[int, int], ...]  # (row, column) of each datum, counted from 1 as in the ids


@dataclass(frozen=True)
class Beam:
    """The beam of a view, CFCS: along `direction` through the origin; `normal`: unit normal of its plates."""

    direction: tuple[float, float, float]
    normal: tuple[float, float, float]

    @property
    def obliquity(self) -> float:
        """Distance along the beam per distance along the plates' normal."""
        return 1 / float(np.dot(self.direction, self.normal))


@dataclass(frozen=True)
class Balls:
    """Ball diameters of one plate, mm."""

    ordinary_mm: float = 3.0  # physics.md, Frame [ours]
    datum_mm: float = 5.0  # physics.md, Frame [ours]


@dataclass(frozen=True)
class FrameDesign:
    """Parameters of a frame; distances are from the hip along the plate normal, positive towards the intensifier.

    The XRII plate has `rows` x `rows` balls, `pitch_mm` apart. The source plate has one more row on the same field: the
    two grids beat once across the image, so balls of the two plates overlap in a few places wherever the frame is, and
    never all at once. `patterns`: each view's datums, XRII plate first.
    """

    name: str
    beams: Mapping[str, Beam]
    patterns: Mapping[str, tuple[Pattern, Pattern]]
    rows: int = 7
    pitch_mm: float = 22.0  # [ours] reaches the ends of a 95 mm wire at 45° (physics.md, Frame)
    xrii_mm: float = 300.0  # physics.md, Frame [ours]
    source_mm: float = 150.0  # physics.md, Frame [ours]
    xrii_balls: Balls = Balls()
    source_balls: Balls = Balls()


def grid_places(rows: int) -> tuple[tuple[int, int], ...]:
    """Return (row, column), counted from 1, of the balls of a square plate."""
    return tuple((row, column) for row in range(1, rows + 1) for column in range(1, rows + 1))


def source_pitch_mm(design: FrameDesign, beam: Beam) -> float:
    """Return the pitch at which the source plate covers the XRII plate's field, rounded up to half a millimetre."""
    source, xrii = (SOURCE_TO_HIP_MM + beam.obliquity * mm for mm in (design.source_mm, design.xrii_mm))
    return ceil(2 * design.pitch_mm * source / xrii * (design.rows - 1) / design.rows) / 2


def views_of(design: FrameDesign) -> dict[str, FrameView]:
    """Return the views of a design; ids are view-plate-row-column, such as "pa-x-3-4". Raises FrameError."""
    if design.rows < 3 or design.pitch_mm <= 0 or design.source_mm >= design.xrii_mm:
        raise FrameError(
            "give at least 3 rows, a pitch above zero, and an XRII plate further towards the intensifier "
            "than the source plate"
        )
    return {view: _view(design, view) for view in design.beams}


def _view(design: FrameDesign, name: str) -> FrameView:
    beam = design.beams[name]
    xrii, source = design.patterns[name]
    pitch = source_pitch_mm(design, beam)
    if pitch <= 0 or SOURCE_TO_HIP_MM + beam.obliquity * design.source_mm <= 0:
        raise FrameError(
            f"the source plate lies behind the X-ray source, {SOURCE_TO_HIP_MM:g} mm from the hip; move it towards the "
            "hip"
        )
    return FrameView(
        xrii=_plate(
            f"{name}-x", _across(beam, design.xrii_mm), (design.rows, design.pitch_mm), xrii, design.xrii_balls
        ),
        source=_plate(
            f"{name}-s", _across(beam, design.source_mm), (design.rows + 1, pitch), source, design.source_balls
        ),
    )


def _across(beam: Beam, distance_mm: float) -> Plane:
    """Return the plane of a plate, with its origin on the beam."""
    return Plane.across(np.array(beam.normal), np.array(beam.direction) * distance_mm * beam.obliquity)


def _plate(prefix: str, plane: Plane, grid: tuple[int, float], datums: Pattern, balls: Balls) -> Plate:
    rows, pitch = grid
    middle = (rows + 1) / 2
    fiducials: list[Fiducial] = []
    for row, column in grid_places(rows):
        datum = (row, column) in datums
        x, y, z = plane.to_space(pitch * (np.array([column, row]) - middle)).round(6).tolist()
        diameter = balls.datum_mm if datum else balls.ordinary_mm
        fiducials.append(Fiducial(f"{prefix}-{row}-{column}", (x, y, z), diameter, datum))
    return Plate(tuple(fiducials))
