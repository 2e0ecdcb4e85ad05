"""Three images of a block on the twin's panel: PA, lateral, oblique; for tests of several rooms."""

from pathlib import Path

import numpy as np
from tests.worked import make_once

from sightline.frame import Frame
from sightline.imaging import write_dicom
from sightline.twin import SetUp, draw_setup, render
from sightline.twin.objects.things import frame_scene
from sightline.twin.scenes.specimens import tagged
from sightline.twin.xray.setup import BEAMS

BLOCK = Frame.load("block60")
# About the middle of the hip: entry, end and three landmarks.
POINTS_MM = np.array(
    [[24.8, 19.2, -7.2], [-17.6, -20.8, 8.8], [-20.0, -12.0, 9.0], [14.0, 22.0, -11.0], [8.0, -19.0, 16.0]]
)


def draw_three(rng: np.random.Generator, chain: str | None = None) -> tuple[SetUp, np.ndarray]:
    """A set-up with three views, and the points (5, 3), which all of them show."""
    while True:
        setup = draw_setup(rng, BLOCK, chain=chain, views=BEAMS)
        xyz = setup.hip_mm + POINTS_MM
        if all(view.in_field(view.project(xyz), 10.0).all() for view in setup.views.values()):
            return setup, xyz


def three_files(folder: Path, setup: SetUp) -> dict[str, Path]:
    """The images of the block alone, with the tags that a panel writes, drawn once for all processes of a folder."""
    files = {name: folder / f"three_{name}.dcm" for name in setup.views}

    def draw() -> None:
        rng, scene = np.random.default_rng(32), frame_scene(setup.true_frame)
        for name, file in files.items():
            write_dicom(tagged(setup, name, render(setup, name, scene, rng)), file)

    make_once(folder, "three", draw)
    return files
