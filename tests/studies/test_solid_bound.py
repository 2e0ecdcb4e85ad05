"""The bound of a solid: against a pinhole camera with every unknown explicit."""

import numpy as np
import pytest
from benchmarks.scenes.blocks import solid_bound
from scipy.spatial.transform import Rotation

from sightline.frame import Frame
from sightline.studies.bound import BoundData
from sightline.twin import SetUp, draw_setup
from sightline.twin.xray.distributions import beam_at
from sightline.twin.xray.setup import BEAMS

BLOCK = Frame.load("block60")
BEAD_PX, PICK_PX = 0.1, 0.1
PIXEL_MM = 298 / 1536


def _seen(setup: SetUp) -> dict[str, BoundData]:
    ids = tuple(bead.id for bead in setup.frame.fiducials)
    noise = np.broadcast_to(BEAD_PX**2 * np.eye(2), (len(ids), 2, 2))
    return {name: BoundData(ids, noise, PICK_PX**2 * np.eye(2), np.zeros(2)) for name in setup.views}


class _Pinholes:
    """The cameras of a set-up, written here anew: x = R X + t, u = c + f x / z.

    Unknowns: of each camera rotation (1/100 rad), translation, focal length and principal point; of each ball its
    error; the target; all mm, from the truth.
    """

    def __init__(self, setup: SetUp, target_mm: np.ndarray) -> None:
        balls = np.array([bead.xyz_mm for bead in setup.true_frame.fiducials])
        self.points = np.vstack([balls, target_mm])
        self.cameras = []
        for view in setup.views.values():
            axes, focal = view.detector.basis, view.focal_point_mm
            self.cameras.append((axes, -axes @ focal, -view.detector.height_mm(focal), view.detector.to_plane(focal)))
        free, ball = np.inf, setup.frame.effective_tolerances.bead_mm
        camera = [free] * 6 + [10.0, 5.0, 5.0]
        self.prior = np.array(camera * len(self.cameras) + [ball] * balls.size + [free] * 3)  # s.d.

    def data(self, unknowns: np.ndarray) -> np.ndarray:
        own, errors = np.split(unknowns, [9 * len(self.cameras)])
        points, out = self.points + errors.reshape(-1, 3), []
        for (axes, shift, focal, foot), move in zip(self.cameras, own.reshape(-1, 9), strict=True):
            x = points @ (Rotation.from_rotvec(move[:3] / 100.0).as_matrix() @ axes).T + shift + move[3:6]
            out.append((foot + move[7:9] + (focal + move[6]) * x[:, :2] / x[:, 2:]) / PIXEL_MM)
        return np.concatenate(out).ravel()

    def design(self) -> np.ndarray:
        """By how many s.d. of the noise the data and the priors change with each unknown."""
        steps = 1e-3 * np.eye(len(self.prior))
        of_data = np.stack([(self.data(s) - self.data(-s)) / 2e-3 for s in steps], axis=1) / BEAD_PX
        return np.vstack([of_data, np.diag(1.0 / self.prior)])


@pytest.mark.parametrize("views", [None, BEAMS, {"a": beam_at(0.0), "b": beam_at(np.radians(30.0))}])
def test_bound_is_the_inverse_of_the_explicit_information(views):
    setup = draw_setup(np.random.default_rng(71), BLOCK, views=views)
    target = setup.hip_mm + np.array([12.3, -7.9, 15.1])
    cameras = _Pinholes(setup, target)
    uv = cameras.data(np.zeros(len(cameras.prior))).reshape(len(setup.views), -1, 2)
    seen = [view.project(cameras.points) for view in setup.views.values()]
    np.testing.assert_allclose(np.diff(uv, axis=1), np.diff(seen, axis=1), atol=1e-6)  # up to the pixel's origin
    design = cameras.design()
    explicit = np.linalg.inv(design.T @ design)[-3:, -3:]
    np.testing.assert_allclose(solid_bound(setup, _seen(setup), target), explicit, rtol=2e-4, atol=1e-9)
