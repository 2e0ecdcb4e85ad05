"""How residuals follow point, focal point and line: the stated derivatives against differences of the function."""

import numpy as np

from sightline.calibration.view import LinesOfSight
from sightline.common.geometry.planes import Plane
from sightline.planning.points.lines_of_sight import LineResiduals

POINTS_MM = np.array([[3.7, -11.2, 18.3], [-24.1, 27.9, -46.6], [5.2, 8.9, 131.4]])
FOCAL_MM = np.array([22.4, -15.9, -611.3])
# Tilted by 15° and off the origin, so that no axis, height or distance is 0 or 1.
AXES = np.array([[0.93, 0.26, 0.26], [-0.21, 0.96, -0.19]])
PLANE = Plane(np.array([4.3, -2.6, 147.8]), np.linalg.qr(AXES.T)[0].T)
STEP_MM = 1e-3  # differences are then exact to 1e-6 of a derivative


def lines(focal_mm: np.ndarray, xy_mm: np.ndarray) -> LinesOfSight:
    count = len(xy_mm)
    identity = np.broadcast_to(np.eye(2), (count, 2, 2))
    return LinesOfSight("pa", PLANE, focal_mm, xy_mm, identity, None, {}, None, np.ones(count, dtype=bool))


XY_MM = PLANE.central_projection(FOCAL_MM, POINTS_MM) + np.array([[0.3, -0.2], [-0.1, 0.4], [0.2, 0.1]])


def at(focal_mm: np.ndarray = FOCAL_MM, xy_mm: np.ndarray = XY_MM, xyz_mm: np.ndarray = POINTS_MM) -> LineResiduals:
    return LineResiduals.at(lines(focal_mm, xy_mm), xyz_mm)


def test_residuals_and_their_derivatives_by_point_focal_point_and_line():
    np.testing.assert_allclose(at(xy_mm=PLANE.central_projection(FOCAL_MM, POINTS_MM)).xy_mm, 0.0, atol=1e-9)
    np.testing.assert_array_equal(at().to_line[:, 3:], np.eye(2 * len(POINTS_MM)))
    for axis, step in enumerate(STEP_MM * np.eye(3)):
        by_point = (at(xyz_mm=POINTS_MM + step).xy_mm - at(xyz_mm=POINTS_MM - step).xy_mm) / (2 * STEP_MM)
        np.testing.assert_allclose(-at().to_point[:, :, axis], by_point, atol=1e-6)
        by_focal = (at(focal_mm=FOCAL_MM + step).xy_mm - at(focal_mm=FOCAL_MM - step).xy_mm) / (2 * STEP_MM)
        np.testing.assert_allclose(at().to_line[:, axis], by_focal.ravel(), atol=1e-6)


def test_a_line_displaced_on_the_plane_is_displaced_by_its_reach_at_the_point():
    """Along the plane, at the height of each point: similar triangles from the focal point."""
    moved = np.array([0.7, -0.4])
    height = PLANE.height_mm(POINTS_MM)
    share = (PLANE.height_mm(FOCAL_MM) - height) / PLANE.height_mm(FOCAL_MM)
    before, after = (PLANE.to_space(xy) for xy in (XY_MM, XY_MM + moved))
    gone = share[:, None] * (after - before)  # both lines start at the focal point
    np.testing.assert_allclose(at().reach[:, None] * (moved @ PLANE.axes), gone, atol=1e-9)
