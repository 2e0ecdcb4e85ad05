"""Central projection onto the reference plane, in parameters in which it is nearly linear."""

from dataclasses import dataclass

import numpy as np

from sightline.common.geometry.planes import Plane
from sightline.errors import CalibrationRefusedError

# Limits for the ratio of a bead's height above the reference plane to that of F [ours]; 0.16 on a Γ frame's source
# plate.
MIN_SOURCE_DISTANCE = 0.05  # of 1 - ratio
MIN_PARALLAX = 0.01  # of |ratio|


@dataclass(frozen=True, eq=False)
class Pencil:
    """The pencil of lines through F = plane.origin + (p / q) @ axes + normal / q, as `pq` = (p_x, p_y, q).

    A point at x in the plane's axes and height h is projected to y = (x - h p) / (1 - h q): linear in p, nearly so in
    q, and regular for a focal point at infinity (q = 0), where F itself is not.
    """

    plane: Plane
    pq: np.ndarray

    @staticmethod
    def through(plane: Plane, focal_point_mm: np.ndarray) -> "Pencil":
        """Return the pencil of a focal point (3,), CFCS."""
        q = 1 / plane.height_mm(focal_point_mm)
        return Pencil(plane, np.append(q * plane.to_plane(focal_point_mm), q))

    @property
    def focal_point_mm(self) -> np.ndarray:
        """(3,) F, CFCS."""
        p, q = self.pq[:2], self.pq[2]
        return self.plane.origin_mm + (p / q) @ self.plane.axes + self.plane.normal / q

    @property
    def focal_point_by_pq(self) -> np.ndarray:
        """(3, 3): derivative of F by pq."""
        p, q = self.pq[:2], self.pq[2]
        by_q = -(p @ self.plane.axes + self.plane.normal) / q**2
        return np.column_stack([self.plane.axes.T / q, by_q])

    def project(self, xyz_mm: np.ndarray) -> np.ndarray:
        """Return the plane coordinates (N, 2), mm, of points (N, 3), CFCS."""
        return self._placed(xyz_mm)[0]

    def by_pq(self, xyz_mm: np.ndarray) -> np.ndarray:
        """Return (N, 2, 3): the derivative of `project` by pq."""
        y, h, depth = self._placed(xyz_mm)
        derivative = np.zeros((len(y), 2, 3))
        derivative[:, 0, 0] = derivative[:, 1, 1] = -h / depth
        derivative[:, :, 2] = (h / depth)[:, None] * y
        return derivative

    def by_point(self, xyz_mm: np.ndarray) -> np.ndarray:
        """Return (N, 2, 3): the derivative of `project` by the points."""
        return self.projected(xyz_mm)[1]

    def projected(self, xyz_mm: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return `project`, `by_point`, and (N,) the depth of the points from F over that of the plane."""
        y, _, depth = self._placed(xyz_mm)
        lift = self.pq[2] * y - self.pq[:2]
        return y, (self.plane.axes + lift[:, :, None] * self.plane.normal) / depth[:, None, None], depth

    def _placed(self, xyz_mm: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return `project`, and the points' heights (N,), mm, and depths (N,) from F, over that of the plane."""
        h = self.plane.height_mm(xyz_mm)
        depth = 1 - h * self.pq[2]
        return (self.plane.to_plane(xyz_mm) - h[:, None] * self.pq[:2]) / depth[:, None], h, depth


def refuse_misplaced(pencil: Pencil, xyz_mm: np.ndarray) -> None:
    """Raise CalibrationRefusedError for a focal point between the planes of the beads (N, 3) or at infinity.

    It may lie on either side of both planes.
    """
    ratio = pencil.plane.height_mm(xyz_mm) * pencil.pq[2]
    largest, smallest = float(ratio.max()), float(ratio.min())
    if not 1 - largest > MIN_SOURCE_DISTANCE:
        raise CalibrationRefusedError(
            "the beads put the X-ray source between the plates; check that the labels of the two plates are not "
            "exchanged, and that frame and view are those in the image"
        )
    if not max(largest, -smallest) > MIN_PARALLAX:
        raise CalibrationRefusedError(
            "the beads put the X-ray source at infinity: the plates' images show no parallax; check that both plates "
            "are in the image and that their distance in the frame file is correct"
        )
