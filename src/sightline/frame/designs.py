"""Built-in frames, and frames designed from a few parameters, with the datum patterns of any frame.

A designed frame has square grids of balls across the beams of two views, and datums by pattern. The built-in solids are
blocks of PMMA that carry their balls in one piece; the plate on the detector beside them shows the distortion of an
image intensifier.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from math import ceil, cos, radians, sin

import numpy as np

from sightline.common.geometry.planes import Plane
from sightline.common.names import named
from sightline.errors import FrameError
from sightline.frame.patterns import search
from sightline.frame.plate import SOURCE_TO_HIP_MM, Fiducial, FrameView, Plate, RigidBody

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
    """Ball diameters of one plate, mm; defaults: physics.md, Frame."""

    ordinary_mm: float = 3.0
    datum_mm: float = 5.0


@dataclass(frozen=True)
class FrameDesign:
    """Parameters of a frame; distances are from the hip along the plate normal, positive towards the intensifier.

    The XRII plate has `rows` x `rows` balls, `pitch_mm` apart. The source plate has one more row on the same field: the
    two grids beat once across the image, so balls of the two plates overlap in a few places wherever the frame is, and
    never all at once. `patterns`: each view's datums, XRII plate first. Defaults and the sizes in BUILTIN are [ours]
    (physics.md, Frame); the pitch reaches the ends of a 95 mm wire at 45°.
    """

    name: str
    beams: Mapping[str, Beam]
    patterns: Mapping[str, tuple[Pattern, Pattern]]
    rows: int = 7
    pitch_mm: float = 22.0
    xrii_mm: float = 300.0
    source_mm: float = 150.0
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


# Found by search(grids, 6, np.random.default_rng(seed), moves) of patterns.py for grids of 7 and of 8 rows: gamma seed
# 13, 300,000 moves, without the corners of 8 rows; biplane 37 and stereo 33, 150,000 moves. Within a frame no triple
# resembles another to a stretch or scale below 1.09; between frames at most three datums of six coincide, once four
# (gamma, stereo) (tests/frame/test_patterns.py).
PATTERNS_7_ROWS: dict[str, tuple[tuple[Pattern, Pattern], tuple[Pattern, Pattern]]] = {
    "gamma": (
        (
            ((2, 1), (2, 2), (3, 7), (4, 6), (5, 2), (7, 5)),
            ((1, 5), (3, 6), (4, 7), (6, 2), (7, 1), (7, 4)),
        ),
        (
            ((1, 1), (3, 1), (4, 5), (5, 2), (6, 7), (7, 5)),
            ((1, 2), (1, 4), (2, 1), (6, 8), (8, 4), (8, 7)),
        ),
    ),
    "biplane": (
        (
            ((1, 2), (1, 3), (3, 5), (5, 4), (6, 4), (7, 2)),
            ((1, 6), (2, 2), (3, 7), (6, 8), (8, 2), (8, 4)),
        ),
        (
            ((1, 4), (1, 7), (2, 5), (6, 4), (7, 1), (7, 3)),
            ((1, 1), (1, 7), (4, 8), (5, 3), (8, 1), (8, 6)),
        ),
    ),
    "stereo": (
        (
            ((1, 6), (2, 3), (3, 7), (5, 3), (6, 5), (7, 1)),
            ((2, 1), (4, 8), (5, 3), (5, 7), (7, 1), (8, 8)),
        ),
        (
            ((1, 5), (1, 6), (4, 7), (5, 1), (6, 3), (7, 3)),
            ((1, 5), (1, 6), (2, 3), (6, 4), (8, 1), (8, 3)),
        ),
    ),
}
MAX_ROWS = 20  # [ours] far more than a C-arm resolves
_STEREO_RAD = radians(16.0)  # [ours] half the convergence: keeps each view's plates out of the other view's field

# Beams of the paper's two views, along +Z and +X (definition of the Γ frame, docs/conventions.md).
GAMMA_BEAMS = {
    "pa": Beam((0.0, 0.0, 1.0), (0.0, 0.0, 1.0)),
    "lateral": Beam((1.0, 0.0, 0.0), (1.0, 0.0, 0.0)),
}
STEREO_BEAMS = {
    "left": Beam((-sin(_STEREO_RAD), 0.0, cos(_STEREO_RAD)), (0.0, 0.0, 1.0)),
    "right": Beam((sin(_STEREO_RAD), 0.0, cos(_STEREO_RAD)), (0.0, 0.0, 1.0)),
}


def patterns_for(
    beams: Mapping[str, Beam], rows: int = 7, datums: int = 6, name: str = ""
) -> dict[str, tuple[Pattern, Pattern]]:
    """Return the datum patterns of a frame: those of a built-in frame, else from a search that takes some seconds.

    The frame's `name` seeds the search, so that two frames of one laboratory have different patterns and their images
    are not confused. Raises FrameError.
    """
    if name in PATTERNS_7_ROWS and (rows, datums, len(beams)) == (7, 6, 2):
        return dict(zip(beams, PATTERNS_7_ROWS[name], strict=True))
    if not 4 <= rows <= MAX_ROWS:
        raise FrameError(f"give 4 to {MAX_ROWS} rows; no datum pattern can be found for {rows}")
    places = [grid_places(rows), grid_places(rows + 1)] * len(beams)
    rng = np.random.default_rng(list(name.encode()))
    chosen = search([np.array(grid, dtype=float) for grid in places], datums, rng)
    patterns = [tuple(grid[index] for index in indices) for grid, indices in zip(places, chosen, strict=True)]
    return dict(zip(beams, zip(patterns[::2], patterns[1::2], strict=True), strict=True))


BUILTIN = {
    # Of the paper: both plates of a view on the intensifier's side of the hip.
    "gamma": FrameDesign("gamma", GAMMA_BEAMS, patterns_for(GAMMA_BEAMS, name="gamma")),
    # The classical frame: the hip between the plates of each view, 150 mm from each.
    "biplane": FrameDesign(
        "biplane", GAMMA_BEAMS, patterns_for(GAMMA_BEAMS, name="biplane"), pitch_mm=18.5, xrii_mm=150.0,
        source_mm=-150.0, source_balls=Balls(2.0, 3.0),
    ),
    # Paper, Fig. 4b: two beams converge at the hip through parallel plates.
    "stereo": FrameDesign(
        "stereo", STEREO_BEAMS, patterns_for(STEREO_BEAMS, name="stereo"), pitch_mm=24.0, xrii_mm=330.0,
        source_mm=-200.0, source_balls=Balls(1.5, 2.5),
    ),
}  # fmt: skip


def builtin_design(name: str) -> FrameDesign:
    """Return a built-in design by name. Raises FrameError, with the valid names."""
    return named(name, BUILTIN, "built-in frame", FrameError)


Place = tuple[float, float, float]

# Found by `python tools/design_block.py NAME`: ball centres 3.5 mm under a face, on whole millimetres along it,
# at places whose shadows seldom overlap. Small block: 30 x 30 x 50 mm; cubes: 40, 60 and 120 mm. The shadows of the
# cube of 40 mm seldom overlap along its edges either: a small field leaves no choice of how it stands.
_BLOCK30_LARGE: tuple[Place, ...] = (
    (11.5, 9.0, 19.0), (-9.0, 9.0, 21.5), (-9.0, 11.5, 5.0), (8.0, -9.0, -21.5),
)  # fmt: skip
_BLOCK30_SMALL: tuple[Place, ...] = (
    (-11.5, -9.0, 13.0), (-9.0, -11.5, -19.0), (11.5, 0.0, -5.0), (9.0, -9.0, 21.5), (-11.5, -2.0, -2.0),
    (1.0, -11.5, 5.0), (-1.0, 11.5, -11.0), (-9.0, 9.0, -21.5),
)  # fmt: skip
_BLOCK40_LARGE: tuple[Place, ...] = (
    (6.0, -16.5, -12.0), (-1.0, -6.0, 16.5), (16.5, 1.0, -11.0), (16.5, 11.0, 4.0),
)  # fmt: skip
_BLOCK40_SMALL: tuple[Place, ...] = (
    (-3.0, 8.0, -16.5), (-16.5, -7.0, 1.0), (-16.5, -14.0, 7.0), (-12.0, -7.0, -16.5), (8.0, 16.5, 0.0),
    (-16.5, 13.0, -6.0), (16.5, -14.0, 14.0), (6.0, 6.0, 16.5), (-4.0, -16.5, -4.0), (-8.0, 16.5, -12.0),
)  # fmt: skip
_BLOCK60_LARGE: tuple[Place, ...] = (
    (20.0, 9.0, -26.5), (-16.0, -26.5, -24.0), (-26.5, 12.0, 10.0), (16.0, 24.0, 26.5), (26.5, -14.0, 22.0),
)  # fmt: skip
_BLOCK60_SMALL: tuple[Place, ...] = (
    (7.0, -26.5, 24.0), (26.5, -24.0, -13.0), (26.5, 24.0, -4.0), (-17.0, -9.0, 26.5), (-26.5, 1.0, -24.0),
    (9.0, 26.5, 9.0), (-4.0, 26.5, -24.0), (-24.0, 26.5, -13.0), (0.0, -5.0, -26.5), (-26.5, -24.0, 24.0),
    (-23.0, -26.5, 4.0),
)  # fmt: skip
_CUBE120_LARGE: tuple[Place, ...] = (
    (11.0, 17.0, 56.5), (-15.0, 56.5, -6.0), (-1.0, 56.5, -40.0), (45.0, -9.0, 56.5), (8.0, 56.5, 17.0),
    (-35.0, -56.5, -21.0), (-56.5, -7.0, 30.0), (30.0, 26.0, -56.5), (56.5, 34.0, 11.0), (0.0, -56.5, -12.0),
)  # fmt: skip
_CUBE120_SMALL: tuple[Place, ...] = (
    (-56.5, -49.0, -30.0), (-46.0, 6.0, -56.5), (-35.0, -56.5, 50.0), (56.5, -50.0, 34.0), (56.5, 5.0, 40.0),
    (-42.0, 56.5, 33.0), (56.5, -31.0, 4.0), (-29.0, 36.0, 56.5), (-56.5, 50.0, -42.0), (16.0, -45.0, -56.5),
    (56.5, 22.0, -25.0), (-4.0, -26.0, 56.5), (-45.0, 36.0, -56.5), (4.0, -56.5, 39.0), (56.5, -21.0, -48.0),
    (48.0, 56.5, 5.0), (-56.5, 21.0, 39.0), (-56.5, -10.0, -27.0), (-17.0, -29.0, -56.5), (37.0, -32.0, 56.5),
    (-56.5, -49.0, 21.0), (49.0, -56.5, -32.0),
)  # fmt: skip
LARGE_MM, SMALL_MM = Balls.datum_mm, Balls.ordinary_mm  # two sizes, so that a glance tells the orientation


def _solid(large: tuple[Place, ...], small: tuple[Place, ...]) -> RigidBody:
    sized = [(xyz, LARGE_MM) for xyz in large] + [(xyz, SMALL_MM) for xyz in small]
    return RigidBody(tuple(Fiducial(f"b{n}", xyz, diameter) for n, (xyz, diameter) in enumerate(sized, 1)))


SOLIDS = {
    "block30": _solid(_BLOCK30_LARGE, _BLOCK30_SMALL),
    "block40": _solid(_BLOCK40_LARGE, _BLOCK40_SMALL),
    "block60": _solid(_BLOCK60_LARGE, _BLOCK60_SMALL),
    "cube120": _solid(_CUBE120_LARGE, _CUBE120_SMALL),
}

# The plate on a detector [ours]: its balls' distance from the input plane, towards the source; 69 balls in a circle of
# 100 mm, a 9-inch field; with half the shadows of a block's balls, so that a glance tells them apart.
STAND_OFF_MM = 20.0
_ROWS, _PITCH_MM, _RADIUS_STEPS = 9, 22.0, 4.6
_LARGE_MM, _SMALL_MM = 3.0, 2.0
# Places (row, column) of the datum markers. No two triples of them resemble each other (`patterns.resemblance`), and
# each half of the plate has three.
_DATUMS = ((1, 3), (1, 6), (3, 2), (6, 8), (9, 4), (9, 6))


def _detector_plate() -> Plate:
    middle = (_ROWS + 1) / 2
    places = [(row, column) for row in range(1, _ROWS + 1) for column in range(1, _ROWS + 1)]
    within = [p for p in places if (p[0] - middle) ** 2 + (p[1] - middle) ** 2 <= _RADIUS_STEPS**2]
    return Plate(
        tuple(
            Fiducial(
                f"d-{row}-{column}",
                (_PITCH_MM * (column - middle), _PITCH_MM * (row - middle), STAND_OFF_MM),
                _LARGE_MM if (row, column) in _DATUMS else _SMALL_MM,
                (row, column) in _DATUMS,
            )
            for row, column in within
        )
    )


DETECTOR_PLATE = _detector_plate()
WITH_PLATE = {f"{name}+detector-plate": name for name in ("block30", "block40", "block60")}  # each with its solid
FRAME_NAMES = (*BUILTIN, *SOLIDS, *WITH_PLATE)  # of all built-in frames
