"""The built-in frames: made by the function that `sightline frame new` uses, from figures of their own."""

from collections.abc import Callable, Mapping
from math import cos, radians, sin

import numpy as np

from sightline.errors import FrameError
from sightline.frame.design import Balls, Beam, FrameDesign, Pattern, grid_places, make_frame
from sightline.frame.model import Frame
from sightline.frame.patterns import search

# search(grids, 6, np.random.default_rng(13), moves=300_000) of patterns.py, for grids of 7 and of 8 rows (its
# corners left out): no triple of datums is nearer to another than a stretch or scale of 1.093
# (tests/frame/test_patterns.py).
PATTERNS_7_ROWS: tuple[tuple[Pattern, Pattern], tuple[Pattern, Pattern]] = (
    (
        ((2, 1), (2, 2), (3, 7), (4, 6), (5, 2), (7, 5)),
        ((1, 5), (3, 6), (4, 7), (6, 2), (7, 1), (7, 4)),
    ),
    (
        ((1, 1), (3, 1), (4, 5), (5, 2), (6, 7), (7, 5)),
        ((1, 2), (1, 4), (2, 1), (6, 8), (8, 4), (8, 7)),
    ),
)
MAX_ROWS = 20  # [ours] far more than a C-arm tells apart
_STEREO_RAD = radians(16.0)  # [ours] half the convergence: each view's plates stay out of the other view's field

# Upright beams of the paper's two views, along +Z and +X (contract of the Γ frame, docs/conventions.md).
GAMMA_BEAMS = {
    "pa": Beam((0.0, 0.0, 1.0), (0.0, 0.0, 1.0)),
    "lateral": Beam((1.0, 0.0, 0.0), (1.0, 0.0, 0.0)),
}
STEREO_BEAMS = {
    "left": Beam((-sin(_STEREO_RAD), 0.0, cos(_STEREO_RAD)), (0.0, 0.0, 1.0)),
    "right": Beam((sin(_STEREO_RAD), 0.0, cos(_STEREO_RAD)), (0.0, 0.0, 1.0)),
}


def patterns_for(beams: Mapping[str, Beam], rows: int = 7, datums: int = 6) -> dict[str, tuple[Pattern, Pattern]]:
    """Datum patterns of a frame: those stored where they fit, else searched, some seconds. Raises FrameError."""
    if (rows, datums) == (7, 6) and len(beams) == len(PATTERNS_7_ROWS):
        return dict(zip(beams, PATTERNS_7_ROWS, strict=True))
    if not 4 <= rows <= MAX_ROWS:
        raise FrameError(f"datum patterns are found for 4 to {MAX_ROWS} rows; {rows} were asked for")
    places = [grid_places(rows), grid_places(rows + 1)] * len(beams)
    chosen = search([np.array(one, dtype=float) for one in places], datums, np.random.default_rng(0))
    patterns = [tuple(one[index] for index in mine) for one, mine in zip(places, chosen, strict=True)]
    return dict(zip(beams, zip(patterns[::2], patterns[1::2], strict=True), strict=True))


def gamma_design() -> FrameDesign:
    """The Γ frame of the paper: both plates of a view on the intensifier's side of the hip."""
    return FrameDesign("gamma", GAMMA_BEAMS, patterns_for(GAMMA_BEAMS))


def biplane_design() -> FrameDesign:
    """The classical frame: the hip between the plates of each view, 150 mm from each [ours]."""
    return FrameDesign(
        "biplane",
        GAMMA_BEAMS,
        patterns_for(GAMMA_BEAMS),
        pitch_mm=18.5,
        xrii_mm=150.0,
        source_mm=-150.0,
        source_balls=Balls(2.0, 3.0),
    )


def stereo_design() -> FrameDesign:
    """The stereo frame (paper, Fig. 4b): two beams that converge at the hip through parallel plates, figures [ours]."""
    return FrameDesign(
        "stereo",
        STEREO_BEAMS,
        patterns_for(STEREO_BEAMS),
        pitch_mm=24.0,
        xrii_mm=330.0,
        source_mm=-200.0,
        source_balls=Balls(1.5, 2.5),
    )


BUILTIN: dict[str, Callable[[], FrameDesign]] = {
    "gamma": gamma_design,
    "biplane": biplane_design,
    "stereo": stereo_design,
}


def builtin_design(name: str) -> FrameDesign:
    """A design by name. Raises FrameError, naming those there are."""
    if name not in BUILTIN:
        raise FrameError(f"there is no built-in frame {name!r}; there are: {', '.join(BUILTIN)}")
    return BUILTIN[name]()


def builtin_frame(name: str) -> Frame:
    """A frame by name. Raises FrameError, naming those there are."""
    return make_frame(builtin_design(name))
