"""Simulated fluoroscopy: the twin's hip in its frame, 30 images a second, with a C-arm that is bumped once."""

import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import count

import numpy as np

from sightline.frame import Frame
from sightline.imaging import Radiograph
from sightline.planning import Trajectory
from sightline.planning.points.results import SpacePoints
from sightline.twin import DOSES, ViewTruth, shown_hip_scene
from sightline.twin.xray.render import expose

IMAGES_PER_S = 30.0
BUMP_S = 6.0  # time of the bump after the start
BUMP_MM = 0.5  # shift of the C-arm, across the beam
_NOISES = 6  # images of each state, shown in turn, because rendering is slower than the stream


@dataclass(frozen=True, eq=False)
class Shot:
    """One image, its number from 1, and its time, s since 1970."""

    image: Radiograph
    number: int
    stamped_s: float


class SimulatedFluoroscopy:
    """An endless stream of images of the PA view: `still` ones in turn, and from BUMP_S on `moved` ones.

    `wire`: the ideal wire in the bone, without a stated error, since it is not planned. Raises SetUpError if no set-up
    shows the whole wire.
    """

    def __init__(self, seed: int, frame: Frame) -> None:
        rng = np.random.default_rng(seed)
        setup, hip = shown_hip_scene(rng, frame)
        truth = setup.views["pa"]
        angle = rng.uniform(0.0, 2 * np.pi)
        bumped = shifted(truth, BUMP_MM * np.array([np.cos(angle), np.sin(angle)]) @ truth.detector.axes)
        self.still, self.moved = (
            tuple(exposure.read_out(rng) for _ in range(_NOISES))
            for exposure in (expose(state, hip.scene, DOSES["low"]) for state in (truth, bumped))
        )
        none = np.zeros(2)
        self.wire = Trajectory(SpacePoints(hip.wire_mm.copy(), none, none > 0, None, None, None, none == 0, "nearest"))
        self._closed = False

    def __iter__(self) -> Iterator[Shot]:
        start = time.monotonic()
        for k in count():
            time.sleep(max(0.0, start + k / IMAGES_PER_S - time.monotonic()))
            if self._closed:
                return
            images = self.still if k < BUMP_S * IMAGES_PER_S else self.moved
            yield Shot(images[k % len(images)], k + 1, time.time())

    def close(self) -> None:
        """End the stream."""
        self._closed = True


def shifted(view: ViewTruth, shift_mm: np.ndarray) -> ViewTruth:
    """Return the view with the whole C-arm shifted by (3,) mm, CFCS; its distortion stays the same."""
    detector = replace(view.detector, origin_mm=view.detector.origin_mm + shift_mm)
    return replace(view, focal_point_mm=view.focal_point_mm + shift_mm, detector=detector)
