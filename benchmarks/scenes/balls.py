"""Random scenes for the labelling of a solid: detections of its balls in one image of a flat panel, with the truth.

Scenes consist of points; nothing is rendered.
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.distance import cdist
from scipy.spatial.transform import RigidTransform, Rotation

from sightline.detection import Detections

SOURCE_DETECTOR_MM, SOURCE_SOLID_MM = (950.0, 1150.0), (600.0, 800.0)  # physics.md, C-arm and image chain [ours]
PIXEL_MM = (0.15, 0.3)  # flat panels [mem]
SIDE_PX = 1024
FOCAL_SD = 0.005  # of the stated focal length: half of 10 mm of a metre [ours]
PRINCIPAL_SD_PX = 12.0  # half of 5 mm [ours]
BALL_SD_MM = 0.03  # error of each coordinate of a ball [ours]
CENTRE_NOISE_PX = (0.05, 0.3)
RADIUS_FACTOR, RADIUS_NOISE = (0.98, 1.04), 0.03  # as in scenes_labelling
MISJUDGED = 0.02  # share of beads whose radius is far off [ours]
RADIUS_RANGE_PX = (2.0, 25.0)  # the range of `detect`
LIKE_BALLS = 0.4  # share of false detections with the size of a ball [ours]
MERGED = 0.8  # balls nearer than this share of the sum of their radii are one blob, which is dropped [ours]
OFF_CENTRE = 0.7  # share of the room for the solid in the image that is used [ours]


@dataclass(frozen=True, eq=False)
class CloudScene:
    """Detections with their truth: `truth` (N,) is the ball that each shows, or -1."""

    detections: Detections
    truth: np.ndarray
    focal_px: tuple[float, float]
    T_camera_cloud: RigidTransform
    true_focal_px: float
    mirrored: bool

    @property
    def clear(self) -> int:
        """The number of balls detected."""
        return int((self.truth >= 0).sum())


def draw_cloud(
    rng: np.random.Generator,
    balls: int,
    side_mm: float | tuple[float, float, float],
    diameters_mm: tuple[float, ...] = (3.0,),
) -> tuple[np.ndarray, np.ndarray]:
    """Return places (M, 3) of balls in a cube or box, at least 1.8 diameters apart, and diameters (M,) in turn."""
    diameter, half = np.resize(diameters_mm, balls), np.array(side_mm) / 2
    xyz = np.zeros((0, 3))
    while len(xyz) < balls:
        one = rng.uniform(-half, half, (1, 3))
        if not len(xyz) or cdist(xyz, one).min() > 1.8 * diameter.max():
            xyz = np.concatenate([xyz, one])
    return xyz, diameter


def _radii(rng: np.random.Generator, radius: np.ndarray) -> np.ndarray:
    """Return radii as detection reports them: a common factor, noise, and a few that are far off."""
    noise = RADIUS_NOISE * np.clip(rng.standard_normal(len(radius)), -3.0, 3.0)
    out = radius * rng.uniform(*RADIUS_FACTOR) * (1 + noise)
    return np.where(rng.random(len(out)) < MISJUDGED, out * rng.uniform(0.7, 1.4, len(out)), out)


def draw_cloud_scene(
    rng: np.random.Generator,
    cloud: tuple[np.ndarray, np.ndarray],
    *,
    hidden: float = 0.2,
    false: int = 20,
    mirrored: bool | None = None,
) -> CloudScene:
    """Return an image of a cloud of balls (places, diameters) in a random pose, without a share of `hidden` balls.

    `false`: detections that show no ball. `mirrored`: by chance if None.
    """
    xyz, diameter = cloud
    focal = rng.uniform(*SOURCE_DETECTOR_MM) / rng.uniform(*PIXEL_MM)
    stated = focal * (1 + FOCAL_SD * rng.standard_normal())
    depth, middle = rng.uniform(*SOURCE_SOLID_MM), (SIDE_PX - 1) / 2
    room = OFF_CENTRE * max(0.0, SIDE_PX / 2 * depth / focal - np.linalg.norm(xyz, axis=1).max())
    at = np.array([*rng.uniform(-room, room, 2), depth])
    pose = RigidTransform.from_components(at, Rotation.random(rng=rng))
    seen = pose.apply(xyz + BALL_SD_MM * rng.standard_normal(xyz.shape))
    uv = middle + rng.normal(0, PRINCIPAL_SD_PX, 2) + focal * seen[:, :2] / seen[:, 2:]
    radius = focal * diameter / 2 / seen[:, 2]
    mirrored = bool(rng.random() < 0.5) if mirrored is None else mirrored
    if mirrored:
        uv[:, 0] = SIDE_PX - 1 - uv[:, 0]
    clear = ((uv > radius[:, None]) & (uv < SIDE_PX - 1 - radius[:, None])).all(axis=1)
    clear &= (cdist(uv, uv) > MERGED * (radius[:, None] + radius) * (1 - np.eye(len(uv)))).sum(axis=1) >= len(uv) - 1
    clear[rng.choice(len(uv), round(hidden * len(uv)), replace=False)] = False
    truth, noise_px = np.flatnonzero(clear), rng.uniform(*CENTRE_NOISE_PX)
    shown, radii = uv[truth] + noise_px * rng.standard_normal((len(truth), 2)), _radii(rng, radius)
    places, sizes = _with_false(rng, shown, radii[truth], radii, false)
    order = rng.permutation(len(places))
    sd_px = noise_px * rng.uniform(0.7, 1.4, len(places))
    detections = Detections(
        uv_px=places[order],
        radius_px=sizes[order],
        covariance_px2=sd_px[:, None, None] ** 2 * np.eye(2),
        kind=("ball",) * len(places),
        contrast=np.full(len(places), -0.5),
        image_shape=(SIDE_PX, SIDE_PX),
    )
    low, high = (stated * (1 + sign * 2 * FOCAL_SD) for sign in (-1, 1))
    labels = np.append(truth, np.full(false, -1))[order]
    return CloudScene(detections, labels, (low, high), pose, focal, mirrored)


def _with_false(
    rng: np.random.Generator, uv: np.ndarray, radius: np.ndarray, like: np.ndarray, number: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return centres and radii with a `number` of false ones added: of any size, or of a size of `like`."""
    places, sizes = [*uv], radius.tolist()
    while number > 0:
        at = rng.uniform(0, SIDE_PX - 1, 2)
        if rng.random() < LIKE_BALLS:
            size = float(rng.choice(like) * (1 + rng.uniform(-0.05, 0.05)))
        else:
            size = float(np.exp(rng.uniform(*np.log(RADIUS_RANGE_PX))))
        if all(np.hypot(*(at - place)) > max(size, other) for place, other in zip(places, sizes, strict=True)):
            places.append(at)
            sizes.append(size)
            number -= 1
    return np.array(places).reshape(-1, 2), np.array(sizes)
