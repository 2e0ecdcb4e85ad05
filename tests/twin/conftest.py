import numpy as np
import pytest

from sightline.frame import Fiducial, Frame, FrameView, Plate
from sightline.twin import SetUp, draw_setup


def _plate(name: str, rows: int, pitch_mm: float, height_mm: float, axes: tuple[int, int, int]) -> Plate:
    beads = []
    for i in range(rows):
        for j in range(rows):
            xyz = np.array([(i - (rows - 1) / 2) * pitch_mm, (j - (rows - 1) / 2) * pitch_mm, height_mm])[list(axes)]
            datum = (i, j) in {(1, 1), (1, 5), (5, 2)}
            place = (float(xyz[0]), float(xyz[1]), float(xyz[2]))
            beads.append(Fiducial(f"{name}-{i}{j}", place, 5.0 if datum else 3.0, datum))
    return Plate(tuple(beads))


def _frame() -> Frame:
    views = {}
    for name, axes in (("pa", (0, 1, 2)), ("lateral", (2, 1, 0))):
        xrii = _plate(f"{name}-x", 7, 22.0, 300.0, axes)
        views[name] = FrameView(xrii=xrii, source=_plate(f"{name}-s", 7, 18.0, 150.0, axes))
    return Frame("two-arms", views)


@pytest.fixture(scope="session")
def frame() -> Frame:
    """A frame with the plates of the Γ frame, made here so that the twin's tests hang on no frame file."""
    return _frame()


@pytest.fixture(scope="session")
def setup(frame: Frame) -> SetUp:
    """A set-up of this frame. The one of all rooms would keep whichever frame asked first."""
    return draw_setup(np.random.default_rng(7), frame)
