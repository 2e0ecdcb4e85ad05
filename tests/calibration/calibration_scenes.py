"""Scenes whose truth is known in closed form: a perspective camera with, or without, a cubic distortion."""

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from sightline.common.geometry.planes import Plane
from sightline.detection.results import Observations
from sightline.frame import Frame, Tolerances

GAMMA = Frame.load("gamma")
EXACT = replace(GAMMA, tolerances=Tolerances(1e-9, 0.0, 0.0, 0.0, 0.0))
TARGETS_MM = np.array([[2.0, 3.0, 1.0], [21.0, -17.0, 9.0], [-24.0, 12.0, -14.0], [11.0, 26.0, -8.0]])
NOISE_PX = 0.1


@dataclass(frozen=True)
class Camera:
    """F and a detector, `tilt_rad` from parallel to the XRII plate; pixel = centre + D(x) / pitch.

    D(x) = x + cubic distortion with `bend` (share of displacement at 100 mm), not radial on purpose.
    """

    focal_point_mm: np.ndarray
    detector: Plane
    pitch_mm: float = 0.21
    bend: float = 0.0

    @staticmethod
    def pa(tilt_rad: float = 0.0, bend: float = 0.0) -> "Camera":
        turn = Rotation.from_rotvec([0.6 * tilt_rad, 0.8 * tilt_rad, 0.0]).as_matrix()
        axes = np.array([[0.8, 0.6, 0.0], [0.6, -0.8, 0.0]]) @ turn.T
        return Camera(np.array([12.3, -7.7, -618.4]), Plane(np.array([3.0, 5.0, 381.6]), axes), bend=bend)

    def project(self, xyz_mm: np.ndarray) -> np.ndarray:
        x = self.detector.central_projection(self.focal_point_mm, xyz_mm)
        unit = x / 100.0
        swirl = np.stack([unit[:, 0] - 0.3 * unit[:, 1], unit[:, 1] + 0.5 * unit[:, 0]], axis=1)
        return 511.5 + (x + 100.0 * self.bend * (unit**2).sum(axis=1, keepdims=True) * swirl) / self.pitch_mm

    def observe(
        self, frame: Frame = EXACT, rng: np.random.Generator | None = None, sd_px: float = NOISE_PX
    ) -> Observations:
        """All beads of the PA view, with noise where a generator is given, and its covariance."""
        view = frame.view("pa")
        uv = self.project(np.concatenate([view.xrii.xyz_mm, view.source.xyz_mm]))
        if rng is not None:
            uv = uv + sd_px * rng.standard_normal(uv.shape)
        covariance = np.broadcast_to(sd_px**2 * np.eye(2), (len(uv), 2, 2))
        return Observations("pa", tuple(f.id for f in view.fiducials), uv, covariance, image_shape=(1024, 1024))


def choose(observations: Observations, keep) -> Observations:
    """The observations whose id `keep` accepts."""
    rows = [k for k, i in enumerate(observations.ids) if keep(i)]
    noise = observations.covariance_px2
    return replace(
        observations,
        ids=tuple(observations.ids[k] for k in rows),
        uv_px=observations.uv_px[rows],
        covariance_px2=None if noise is None else noise[rows],
        radius_px=None if observations.radius_px is None else observations.radius_px[rows],
    )


def displaced(observations: Observations, moves_px: dict[int, tuple[float, float]]) -> Observations:
    """The observations with some beads moved."""
    uv = observations.uv_px.copy()
    for row, move in moves_px.items():
        uv[row] += move
    return replace(observations, uv_px=uv)


def line_numbers(view, uv_px: np.ndarray) -> np.ndarray:
    """(focal point, xy of each line) of a view, as in LinesOfSight.covariance."""
    lines = view.lines_of_sight(uv_px)
    return np.concatenate([lines.focal_point_mm, lines.xy_mm.ravel()])


def true_numbers(camera: Camera, plane: Plane, xyz_mm: np.ndarray) -> np.ndarray:
    """The same, true."""
    xy = plane.central_projection(camera.focal_point_mm, xyz_mm)
    return np.concatenate([camera.focal_point_mm, xy.ravel()])
