"""What tests of the app begin with: marks that are placed, and beads that are seen."""

from collections.abc import Mapping, Sequence

import numpy as np

from sightline.app.plan.decisions import Decisions, Mark
from sightline.case.views import NAMES
from sightline.detection import Observations
from sightline.twin import SetUp, bead_images

SIDE_PX = 1024
Pixels = np.ndarray | Sequence[np.ndarray]  # (2, 2), a row for each image


def mark(uv_px: Pixels) -> Mark:
    """Return a mark that is placed in both images."""
    return Mark({name: (float(u), float(v)) for name, (u, v) in zip(NAMES, uv_px, strict=True)})


def marked(decisions: Decisions, places: Mapping[str, Pixels]) -> Decisions:
    """Place marks in both images."""
    for name, uv_px in places.items():
        decisions = decisions.with_mark(name, mark(uv_px))
    return decisions


def observed(setup: SetUp, name: str, rng: np.random.Generator, quarter: int = 0) -> Observations:
    """Beads with an error of 0.1 px in an image of SIDE_PX x SIDE_PX, stored `quarter` quarter turns clockwise."""
    ids, uv = bead_images(setup, name, rng, 0.1)
    for _ in range(quarter):
        uv = np.stack([SIDE_PX - 1 - uv[:, 1], uv[:, 0]], axis=1)
    noise = np.repeat(0.01 * np.eye(2)[None], len(ids), axis=0)
    return Observations(name, ids, uv, noise, image_shape=(SIDE_PX, SIDE_PX))
