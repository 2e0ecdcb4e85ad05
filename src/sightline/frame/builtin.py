"""The built-in frames: made by the function that `sightline frame new` uses, from figures of their own."""

from collections.abc import Callable
from math import cos, radians, sin

from sightline.errors import FrameError
from sightline.frame.design import Balls, Beam, FrameDesign, Pattern, make_frame
from sightline.frame.model import Frame

# Found by `patterns.search` for 7 x 7 and 8 x 8 grids (docs/frame-file.md gives the command and what they reach).
PATTERNS_7_ROWS: tuple[tuple[Pattern, Pattern], tuple[Pattern, Pattern]] = (
    (
        ((1, 7), (2, 3), (3, 5), (6, 3), (6, 4), (7, 2)),
        ((1, 7), (2, 8), (4, 8), (6, 1), (7, 1), (7, 4)),
    ),
    (
        ((1, 4), (1, 5), (3, 6), (6, 2), (6, 4), (7, 2)),
        ((2, 1), (2, 7), (3, 3), (5, 6), (7, 1), (7, 5)),
    ),
)
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


def _named(beams: dict[str, Beam]) -> dict[str, tuple[Pattern, Pattern]]:
    return dict(zip(beams, PATTERNS_7_ROWS, strict=True))


def gamma_design() -> FrameDesign:
    """The Γ frame of the paper: both plates of a view on the intensifier's side of the hip."""
    return FrameDesign("gamma", GAMMA_BEAMS, _named(GAMMA_BEAMS))


def biplane_design() -> FrameDesign:
    """The classical frame: the hip between the plates of each view, 150 mm from each [ours]."""
    return FrameDesign(
        "biplane",
        GAMMA_BEAMS,
        _named(GAMMA_BEAMS),
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
        _named(STEREO_BEAMS),
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


def builtin_frame(name: str) -> Frame:
    """A frame by name. Raises FrameError, naming those there are."""
    if name not in BUILTIN:
        raise FrameError(f"there is no built-in frame {name!r}; there are: {', '.join(BUILTIN)}")
    return make_frame(BUILTIN[name]())
