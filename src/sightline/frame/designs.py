"""The designs of the built-in frames, and the datum patterns of any frame."""

from collections.abc import Callable, Mapping
from math import cos, radians, sin

import numpy as np

from sightline.errors import FrameError
from sightline.frame.design import Balls, Beam, FrameDesign, Pattern, grid_places
from sightline.frame.patterns import search

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
    chosen = search([np.array(one, dtype=float) for one in places], datums, rng)
    patterns = [tuple(one[index] for index in indices) for one, indices in zip(places, chosen, strict=True)]
    return dict(zip(beams, zip(patterns[::2], patterns[1::2], strict=True), strict=True))


def gamma_design() -> FrameDesign:
    """Return the Γ frame of the paper: both plates of a view on the intensifier's side of the hip."""
    return FrameDesign("gamma", GAMMA_BEAMS, patterns_for(GAMMA_BEAMS, name="gamma"))


def biplane_design() -> FrameDesign:
    """Return the classical frame: the hip between the plates of each view, 150 mm from each [ours]."""
    return FrameDesign(
        "biplane",
        GAMMA_BEAMS,
        patterns_for(GAMMA_BEAMS, name="biplane"),
        pitch_mm=18.5,
        xrii_mm=150.0,
        source_mm=-150.0,
        source_balls=Balls(2.0, 3.0),
    )


def stereo_design() -> FrameDesign:
    """Return the stereo frame (paper, Fig. 4b): two beams converge at the hip through parallel plates; sizes [ours]."""
    return FrameDesign(
        "stereo",
        STEREO_BEAMS,
        patterns_for(STEREO_BEAMS, name="stereo"),
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
    """Return a built-in design by name. Raises FrameError, with the valid names."""
    if name not in BUILTIN:
        raise FrameError(f"there is no built-in frame {name!r}; choose one of {', '.join(BUILTIN)}")
    return BUILTIN[name]()
