"""The twin's flat panels, cut to their middle: a block of scattered balls beside a hip, seen straight from above."""

from dataclasses import dataclass, replace

import numpy as np

from sightline.common.geometry.planes import Plane
from sightline.twin.anatomy.femur import draw_femur, voxelise
from sightline.twin.objects.things import Ball, Box, Scene, SoftTissue
from sightline.twin.xray.presets import ImageChain
from sightline.twin.xray.render import Projection, project
from sightline.twin.xray.setup import ViewTruth, shadow_centres_px, shadow_radius_px
from sightline.twin.xray.tubes import FlatPanel

TO_HIP_MM = 620.0
HALF_MM = 30.0  # half the edge of the cube of balls


@dataclass(frozen=True, eq=False)
class Shown:
    """Balls before a panel: their shadows' true centres (N, 2) and radii (N,), px, and the expected image."""

    view: ViewTruth
    uv_px: np.ndarray
    radius_px: np.ndarray
    projection: Projection


def middle_of(chain: ImageChain, side_px: int) -> ImageChain:
    """Return the panel's middle `side_px` x `side_px` pixels as a panel of its own."""
    return replace(
        chain, shape=(side_px, side_px), field_mm=side_px * chain.pitch_mm, mask_px=side_px / 2 * (1 - 1 / 75)
    )


def view_of(panel: ImageChain) -> ViewTruth:
    """Return a view along -z; the hip is at the origin."""
    axes = np.array([[1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    detector = Plane(np.array([0.0, 0.0, TO_HIP_MM - panel.sdd_mm]), axes)
    return ViewTruth("pa", np.array([0.0, 0.0, TO_HIP_MM]), detector, FlatPanel(panel).undistorted)


def hip() -> Scene:
    """Return a hip in its flesh."""
    rng = np.random.default_rng(0)
    return Scene(volumes=(voxelise(draw_femur(rng), "right", np.zeros(3), rng),), tissue=SoftTissue())


def scattered(
    view: ViewTruth, rng: np.random.Generator, count: int, from_source_mm: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return centres (N, 3) and radii (N,), mm, of balls of 3 and 5 mm whose shadows do not touch."""
    xyz, radius = np.zeros((0, 3)), np.zeros(0)
    while len(xyz) < count:
        new = np.array([0.0, 0.0, TO_HIP_MM - from_source_mm]) + rng.uniform(-HALF_MM, HALF_MM, 3)
        every, sizes = np.vstack([xyz, new]), np.append(radius, rng.choice([1.5, 2.5]))
        uv, shadow = view.project(every), shadow_radius_px(view, every, sizes) + 0.6 / view.chain.pitch_mm
        apart = np.linalg.norm(uv[:-1] - uv[-1], axis=1)
        if view.in_field(uv[-1], 1.5 * shadow[-1]) and (apart > shadow[:-1] + shadow[-1]).all():
            xyz, radius = every, sizes
    return xyz, radius


def shown(view: ViewTruth, xyz_mm: np.ndarray, radius_mm: np.ndarray, around: Scene) -> Shown:
    """Return steel balls in a wide slab of PMMA, with other things in the beam."""
    slab = Box(np.array([0.0, 0.0, xyz_mm[:, 2].mean()]), np.eye(3), np.array([200.0, 200.0, 40.0]))
    balls = tuple(Ball((x, y, z), r) for (x, y, z), r in zip(xyz_mm.tolist(), radius_mm.tolist(), strict=True))
    return Shown(
        view,
        shadow_centres_px(view, xyz_mm, radius_mm),
        shadow_radius_px(view, xyz_mm, radius_mm),
        project(view, Scene(solids=balls, boxes=(slab,)) + around),
    )
