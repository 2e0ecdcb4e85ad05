"""Kernels of detection, labelling and calibration, compiled by two processes before a first demo needs them.

A process compiles on one core. While a first demo draws its images and its robot starts, one process has fitted beads,
and the other has searched an image, labelled and calibrated true beads of the twin, and planned a line. numba has put
the kernels on the disk, where the demo finds them. Without these processes the demo compiles them itself: no result
depends on them.
"""

import subprocess
import sys
from collections.abc import Sequence
from contextlib import suppress
from typing import cast

import cv2
import numpy as np

from sightline.calibration import calibrate
from sightline.calibration.maps.fit_map import Method
from sightline.closing import Closing
from sightline.detection import Detections, label
from sightline.detection.beads.candidates import find_candidates
from sightline.detection.beads.clipping import clipped_shares
from sightline.detection.beads.fit import fit_part
from sightline.detection.beads.noise import LAGS, NoiseModel, estimate_noise
from sightline.detection.beads.refine import BeadFitter, start
from sightline.detection.labelling.joint_kernels import settle
from sightline.detection.log_image import field_and_logs
from sightline.errors import SightlineError
from sightline.frame import Frame
from sightline.imaging import Radiograph
from sightline.imaging.defects import interlaced
from sightline.kernels import is_compiled
from sightline.planning import plan
from sightline.threads import THREADS
from sightline.twin import draw_setup
from sightline.twin.xray.setup import bead_images, shadow_radius_px

SEED = 9  # that of the demo: its beads are labelled and calibrated by all methods
SD_PX = 0.03  # noise of a centre, as a demo's images have [ours]
_SIDE_PX, _WHITE = 512, 4095  # of the image that is searched, and its largest value, as an image intensifier's [ours]
_LIGHT, _SHADOW, _NOISE = 1500.0, 600.0, 15.0  # its values: background, beads, s.d. [ours]
_RADIUS_PX = 8.0  # of its beads


class KernelsAhead(Closing):
    """The processes, each started where its kernels are not compiled yet and a second core is free; they end with the
    block."""

    def __init__(self, frame_name: str, methods: Sequence[Method]) -> None:
        self._processes: list[subprocess.Popen[bytes]] = []
        for largest, name in ((fit_part, "fits"), (settle, "labels")):  # the largest kernel of each
            if THREADS > 1 and not is_compiled(largest):
                command = [sys.executable, "-m", __name__, name, frame_name, *methods]
                quiet = subprocess.DEVNULL
                process = subprocess.Popen(command, stdin=quiet, stdout=quiet, stderr=quiet)  # noqa: S603 - our own
                self._processes.append(process)

    def wait(self) -> None:
        """Wait until they have ended: a demo that goes on before would compile the same kernels again."""
        for process in self._processes:
            process.wait()

    def close(self) -> None:
        """End them; what they have compiled stays."""
        for process in self._processes:
            process.kill()
            process.wait()


def fit_beads() -> None:
    """Fit beads in an image, so that the kernels of the fits, of the noise and of the image's tests are compiled."""
    image, uv_px = _beads()
    logs = np.log(image.pixels.astype(np.float32))
    usable = np.ones(logs.shape, bool)
    rows = start(uv_px, np.full(len(uv_px), _RADIUS_PX), np.full(len(uv_px), np.log(_SHADOW / _LIGHT)))
    noise = estimate_noise(logs, usable)
    assert noise is not None  # noqa: S101 - it was drawn
    interlaced(image)
    clipped_shares(image, usable, rows)
    BeadFitter(logs, usable, noise)(rows)


def search_image() -> None:
    """Search an image for beads, so that the kernels of the search are compiled."""
    mask, logs = field_and_logs(_beads()[0])
    # White noise as drawn: its s.d. is _NOISE at every light.
    find_candidates(logs, mask, NoiseModel(float(2 * np.log(_NOISE)), 2.0, np.eye(LAGS + 1)[0]))


def _beads() -> tuple[Radiograph, np.ndarray]:
    """Return an image with a lattice of dark discs and white noise, and their places (N, 2)."""
    places = np.stack(np.meshgrid(*[np.arange(64.0, _SIDE_PX, 64.0)] * 2), axis=-1).reshape(-1, 2)
    light = np.full((_SIDE_PX, _SIDE_PX), _LIGHT)
    for u, v in places.astype(int).tolist():
        cv2.circle(light, (u, v), int(_RADIUS_PX), _SHADOW, -1)
    light = cv2.GaussianBlur(light, (0, 0), 1.0)
    light += _NOISE * np.random.default_rng(SEED).standard_normal(light.shape)
    light[:2] = _WHITE  # clipped
    return Radiograph(np.clip(np.rint(light), 0, _WHITE).astype(np.uint16), float(_WHITE)), places


def label_and_plan(frame: Frame, methods: Sequence[Method]) -> None:
    """Label and calibrate the true beads of a drawn set-up, and plan a line there, so that the kernels are compiled.

    Raises SetUpError.
    """
    rng = np.random.default_rng(SEED)
    setup, views, line_px = draw_setup(rng, frame), [], []
    line_mm = setup.hip_mm + np.array([[0.0, 0.0, 0.0], [20.0, 10.0, 20.0]])
    for name, view in setup.views.items():
        ids, uv = bead_images(setup, name, rng, SD_PX)
        of = {bead.id: bead for bead in setup.frame_in(name).fiducials_of(name)}
        shown = [of[bead] for bead in ids]
        xyz, radius_mm = np.array([bead.xyz_mm for bead in shown]), np.array([bead.diameter_mm / 2 for bead in shown])
        noise = np.broadcast_to(SD_PX**2 * np.eye(2), (len(ids), 2, 2))
        found = Detections(
            uv_px=uv,
            radius_px=shadow_radius_px(view, xyz, radius_mm),
            covariance_px2=noise,
            kind=tuple("washer" if bead.shape == "washer" else "ball" for bead in shown),
            contrast=-np.ones(len(ids)),
            image_shape=view.chain.shape,
        )
        observations = label(found, frame, None if frame.solid is None else name)
        calibrated = [calibrate(observations, frame, method=method) for method in methods]
        pixels = [one.project(line_mm) for one in calibrated]
        views.append(calibrated[0])
        line_px.append(pixels[0])
    plan(views, *np.swapaxes(line_px, 0, 1))


if __name__ == "__main__":
    with suppress(SightlineError):  # the demo says what is wrong
        if sys.argv[1] == "fits":
            fit_beads()
        else:
            search_image()
            label_and_plan(Frame.load(sys.argv[2]), cast("list[Method]", sys.argv[3:]))
