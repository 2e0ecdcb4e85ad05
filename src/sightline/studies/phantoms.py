"""Phantoms for studies of whole images: the paper's plastic femur, and a pig's femur in soft tissue."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

import sightline as sl
from sightline.calibration import BeadView
from sightline.detection import Observations
from sightline.frame import Frame
from sightline.imaging import Radiograph
from sightline.studies.scenes import VIEWS, draw_showing
from sightline.twin import HipScene, SetUp, render
from sightline.twin.femur import Femur, to_cfcs
from sightline.twin.phantoms import PIG, plastic_hip, porcine_hip

SIDE = "right"


@dataclass(frozen=True)
class Phantom:
    """A bone with its ideal wire centred on the origin, and the function that puts it into a set-up."""

    femur: Femur
    build: Callable[[SetUp, np.random.Generator], HipScene]

    @property
    def wire_mm(self) -> np.ndarray:
        """Entry and end (2, 3) of the ideal wire, CFCS."""
        wire = to_cfcs(np.stack(self.femur.wire_mm()), SIDE, np.zeros(3))
        return wire - wire.mean(axis=0)

    def draw(self, rng: np.random.Generator, frame: Frame) -> tuple[SetUp, HipScene]:
        """Draw a set-up that shows the whole wire in both views, and its hip. Raises SetUpError."""
        setup = draw_showing(rng, frame, self.wire_mm)
        return setup, self.build(setup, rng)


PHANTOMS = {
    "plastic, bored": Phantom(Femur(), lambda setup, _: plastic_hip(setup)),
    "porcine": Phantom(PIG, porcine_hip),
}


def image_of(rng: np.random.Generator, setup: SetUp, hip: HipScene, view: str) -> Radiograph:
    """Render one view at the medium dose."""
    return render(setup, view, hip.at(view).scene, rng)


def observed(image: Radiograph, frame: Frame, view: str) -> Observations:
    """Find and label the beads of an image. Raises SightlineError."""
    return sl.label(sl.detect(image), frame, view)


def calibrated_images(rng: np.random.Generator, setup: SetUp, hip: HipScene) -> list[BeadView]:
    """Render and calibrate both views, each from its own image. Raises SightlineError."""
    return [
        sl.calibrate(observed(image_of(rng, setup, hip, name), setup.frame, name), setup.frame, view=name)
        for name in VIEWS
    ]
