"""Pictures of a registered bone: each image, the bone's shadow beside it, and the shadow's edges over the image."""

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
from scipy.ndimage import gaussian_laplace
from scipy.spatial.transform import RigidTransform

from sightline.common import draw as drawing
from sightline.from_images.registration.align import FINE
from sightline.from_images.registration.bone import ScannedBone
from sightline.from_images.registration.cast import shadow
from sightline.from_images.registration.observed import BoneShot, Observed
from sightline.imaging.radiograph import stretched

_SIZE_PX = 256  # [ours] of a shadow
_BEAD = np.ones((17, 17), dtype=np.uint8)  # [ours] pixels that hold a bead, or two that touch
_WIRE_POINTS = 21  # [ours] a wire bends with the image's distortion
# Of lines [ours]: smoothing in pixels of a shadow, and in pixels of the image how far a corner is from its line, and
# how long a line is at least.
_SMOOTH_PX, _OFF_PX, _SHORT_PX = 1.5, 0.7, 24
_EDGE = 0.85  # quantile of the shadow's gradient above which there is an edge [ours]


def size_in(count: int) -> tuple[float, float]:
    """Return the size of a picture of `count` views, inches."""
    return 6.0, 2.2 * count


def new_axes(figure: Any, count: int) -> Any:
    """Return the axes (count, 3) that `draw` fills."""
    return figure.subplots(count, 3, squeeze=False)


def draw(
    axes: Any, shots: Sequence[BoneShot], bone: ScannedBone, pose: RigidTransform, wire_mm: np.ndarray | None = None
) -> None:
    """Draw a row for each view: the image, the shadow alone, and the shadow's edges over the image.

    `wire_mm` (2, 3): entry and end of a wire, CFCS, over all of them, as far as the view is calibrated.
    """
    from matplotlib.colors import to_rgba

    for row, shot in zip(axes, shots, strict=True):
        seen = shot.pooled(_SIZE_PX)
        drawn, edges = _shadow(seen, bone, pose)
        image = stretched(-seen.attenuation, -seen.attenuation[seen.usable])
        shown = [image, -drawn, image]
        for panel, picture, title in zip(row, shown, ("image", "bone", "edges of the bone"), strict=True):
            panel.imshow(picture, cmap="gray", interpolation="nearest")
            panel.set_axis_off()
            panel.set_title(f"{shot.view.name}: {title}", loc="left", fontsize="small")
        over = np.zeros((*edges.shape, 4))
        over[edges] = to_rgba(drawing.ORANGE, 0.7)
        row[2].imshow(over, interpolation="nearest")
        if wire_mm is not None:
            uv = shot.view.project_seen(np.linspace(wire_mm[0], wire_mm[1], _WIRE_POINTS))[0]
            at = (uv - (seen.factor - 1) / 2) / seen.factor
            for panel in row:
                panel.plot(*at.T, color=drawing.BLUE)
                panel.plot(*at[:1].T, "o", color=drawing.BLUE)  # the entry


def edge_lines(shot: BoneShot, bone: ScannedBone, pose: RigidTransform) -> list[np.ndarray]:
    """Return the edges of the bone's shadow as lines (N, 2), px of the image: where it is steepest."""
    seen = shot.pooled(_SIZE_PX)
    drawn, edges = _shadow(seen, bone, pose)
    size = [n * seen.factor for n in drawn.shape[::-1]]  # from here on the pixels are those of the image
    inside = cv2.resize(gaussian_laplace(drawn, _SMOOTH_PX), size, interpolation=cv2.INTER_CUBIC) > 0
    steep = cv2.resize(edges.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0
    lines = []
    for curve in cv2.findContours(inside.astype(np.uint8), cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)[0]:
        uv = np.asarray(curve)[:, 0]
        on = steep[tuple(uv.T[::-1])]
        runs = np.split(uv, np.flatnonzero(np.diff(on)) + 1)[0 if on[0] else 1 :: 2]
        thinned = (cv2.approxPolyDP(run, _OFF_PX, closed=False)[:, 0] for run in runs if len(run) > _SHORT_PX)
        lines += [run.astype(np.float64) for run in thinned]
    return lines


def _shadow(seen: Observed, bone: ScannedBone, pose: RigidTransform) -> tuple[np.ndarray, np.ndarray]:
    """Return the bone's shadow (H, W) in an image's field, and bool where it has edges."""
    drawn = shadow(seen.rays, bone.at(FINE.spacing_mm), pose).reshape(seen.attenuation.shape)
    field = cv2.morphologyEx(seen.known.astype(np.uint8), cv2.MORPH_CLOSE, _BEAD)  # lines of sight, and beads
    drawn *= field
    steep = np.hypot(*np.gradient(drawn)) * cv2.erode(field, _BEAD[:5, :5])  # an edge of the field is none of bone
    return drawn, steep > np.quantile(steep[drawn > 0], _EDGE) if (drawn > 0).any() else drawn > 0
