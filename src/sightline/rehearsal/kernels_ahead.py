"""Kernels of labelling and calibration, compiled by a process of their own before a first demo needs them.

A process compiles on one core. Until a demo has compiled what finds beads, this one has labelled and calibrated true
beads of the twin on the other core, and numba has put the kernels on the disk, where the demo finds them. A kernel that
comes too late is compiled by the demo too: no result depends on this process.
"""

import subprocess
import sys
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import cast

import numpy as np

from sightline.calibration import calibrate
from sightline.calibration.fit import Method
from sightline.closing import Closing
from sightline.detection import Detections, label
from sightline.detection.labelling.joint_kernels import settle
from sightline.errors import SightlineError
from sightline.frame import Frame
from sightline.threads import THREADS
from sightline.twin import draw_setup
from sightline.twin.carm import bead_images, shadow_radius_px

SEED = 9  # that of the demo: its beads are labelled and calibrated by all methods
SD_PX = 0.03  # noise of a centre, as a demo's images have [ours]


class KernelsAhead(Closing):
    """The process, started where kernels are not compiled yet and a second core is free; it ends with the block."""

    def __init__(self, frame_name: str, methods: Sequence[Method]) -> None:
        self._process: subprocess.Popen[bytes] | None = None
        if THREADS > 1 and not compiled():
            command = [sys.executable, "-m", __name__, frame_name, *methods]
            quiet = subprocess.DEVNULL
            self._process = subprocess.Popen(command, stdin=quiet, stdout=quiet, stderr=quiet)  # noqa: S603 - our own

    def close(self) -> None:
        """End it; what it has compiled stays."""
        if self._process is not None:
            self._process.kill()
            self._process.wait()


def compiled() -> bool:
    """Return whether the largest kernel of labelling is on the disk, or numba compiles nothing."""
    stats = getattr(settle, "stats", None)
    return stats is None or any(Path(stats.cache_path).glob(f"*.{settle.__name__}-*.nbi"))


def label_and_calibrate(frame: Frame, methods: Sequence[Method]) -> None:
    """Label and calibrate the true beads of a drawn set-up, so that the kernels are compiled. Raises SetUpError."""
    rng = np.random.default_rng(SEED)
    setup = draw_setup(rng, frame)
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
        for method in methods:
            calibrate(observations, frame, method=method)


if __name__ == "__main__":
    with suppress(SightlineError):  # the demo says what is wrong
        label_and_calibrate(Frame.load(sys.argv[1]), cast("list[Method]", sys.argv[2:]))
