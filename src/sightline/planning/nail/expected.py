"""What a nail with a hole should look like in an image, near a point: lengths in metal, and the rims of the open lens.

Near a point every view is a perspective camera: its matrix is fitted to the projections of points around it, so that
many rays cost little.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sightline.calibration.view import CalibratedView
from sightline.common.geometry.lines import across, nearest_approach, unit
from sightline.errors import ReconstructionRefusedError
from sightline.planning.nail.result import HolePose, Nail

_MIN_OPEN_PX = 2.0  # [ours] of the lens beside a point of its rim: in a narrower corner, blur joins both rims
_CUBE_MM = 8.0  # [ours] half the side of the cube in which a camera is fitted: as large as a hole with its nail
_AROUND = 30  # points of each rim, 4 px apart
GRID_PX = 0.5  # steps of the grid of metal
_AROUND_PX = 12.0  # of the grid beyond the rims' points: half a profile, its shift and the blur
_ROLLS_RAD = np.deg2rad(np.arange(-40.0, 41.0, 5.0))  # of the hole about the nail, from the mean beam
_ALONG_MM = np.array([-0.6, 0.0, 0.6])  # of the hole along the nail, from the clicks
_PATCH = 1.3  # half the side of the patch that is compared, hole radii
_PATCH_CELLS = 17
MAX_CLICK_MM = 2.0  # between the hole's places along the nail in the two views: holes are 25 mm apart [ours]


@dataclass(frozen=True, eq=False)
class LocalCamera:
    """A view near a point: pixels (u w, v w, w) = `matrix` (3, 4) times (x, y, z, 1)."""

    matrix: np.ndarray

    @staticmethod
    def of(view: CalibratedView, at_mm: np.ndarray) -> "LocalCamera":
        """Return the camera that a view is near a point (3,). Raises OutsideRegionError."""
        grid = np.stack(np.meshgrid(*3 * [[-1.0, 0.0, 1.0]], indexing="ij"), axis=-1).reshape(-1, 3)
        uv = view.project(at_mm + _CUBE_MM * grid)
        middle, scale = uv.mean(axis=0), uv.std()
        x = np.column_stack([grid, np.ones(len(grid))])
        rows = np.zeros((2 * len(grid), 12))
        rows[::2, :4] = rows[1::2, 4:8] = x
        rows[::2, 8:], rows[1::2, 8:] = (-x * column[:, None] for column in ((uv - middle) / scale).T)
        own = np.linalg.svd(rows)[2][-1].reshape(3, 4)
        own = own * np.sign(own[2, 3])
        to_grid = np.vstack([np.column_stack([np.eye(3), -at_mm]) / _CUBE_MM, [0.0, 0.0, 0.0, 1.0]])
        to_pixels = np.array([[scale, 0.0, middle[0]], [0.0, scale, middle[1]], [0.0, 0.0, 1.0]])
        return LocalCamera(to_pixels @ own @ to_grid)

    @property
    def focal_mm(self) -> np.ndarray:
        """(3,) where the rays meet."""
        return -np.linalg.solve(self.matrix[:, :3], self.matrix[:, 3])

    def project(self, xyz_mm: np.ndarray) -> np.ndarray:
        """Return the pixels (..., 2) of points (..., 3)."""
        homogeneous = xyz_mm @ self.matrix[:, :3].T + self.matrix[:, 3]
        return homogeneous[..., :2] / homogeneous[..., 2:]

    def rays(self, uv_px: np.ndarray) -> np.ndarray:
        """Return the unit vectors (..., 3) of the rays of pixels (..., 2), away from the source."""
        inverse = np.linalg.inv(self.matrix[:, :3])
        return unit(uv_px @ inverse[:, :2].T + inverse[:, 2])


@dataclass(frozen=True, eq=False)
class ExpectedRims:
    """Points of both rims that bound the open lens in an image, and the metal around them.

    `uv_px` (N, 2); `normal` (N, 2): unit vectors away from the lens; `is_exit` (N,) bool; `metal_mm` (H, W): lengths in
    metal on the rays of a grid in steps of GRID_PX, whose first pixel is `corner_px` (2,).
    """

    uv_px: np.ndarray
    normal: np.ndarray
    is_exit: np.ndarray
    metal_mm: np.ndarray
    corner_px: np.ndarray


def expected_rims(camera: LocalCamera, pose: HolePose, nail: Nail) -> ExpectedRims:
    """Return the boundary of the lens that a view should show."""
    points, outward = (np.concatenate(both) for both in zip(*(rim(pose, nail, s) for s in (-1.0, 1.0)), strict=True))
    is_exit = np.repeat([False, True], _AROUND)
    open_there = metal_mm(camera.focal_mm, unit(points - 0.02 * outward - camera.focal_mm), pose, nail) < 1e-6
    points, outward, is_exit = points[open_there], outward[open_there], is_exit[open_there]
    uv = camera.project(points)
    tangent = unit(camera.project(points + 0.01 * np.cross(pose.axis, outward)) - uv)
    normal = np.stack([tangent[:, 1], -tangent[:, 0]], axis=-1)
    normal *= np.sign((normal * (camera.project(points + 0.01 * outward) - uv)).sum(axis=1))[:, None]
    inside = camera.rays(uv - _MIN_OPEN_PX * normal)
    wide = metal_mm(camera.focal_mm, inside, pose, nail) < 1e-6  # not in a corner of the lens
    uv, normal, is_exit = uv[wide], normal[wide], is_exit[wide]
    if not len(uv):
        return ExpectedRims(uv, normal, is_exit, np.zeros((0, 0)), np.zeros(2))
    corner, end = uv.min(axis=0) - _AROUND_PX, uv.max(axis=0) + _AROUND_PX
    u, v = (np.arange(a, b + GRID_PX, GRID_PX) for a, b in zip(corner, end, strict=True))
    rays = camera.rays(np.stack(np.meshgrid(u, v), axis=-1))
    return ExpectedRims(uv, normal, is_exit, metal_mm(camera.focal_mm, rays, pose, nail), corner)


def metal_mm(focal_mm: np.ndarray, rays: np.ndarray, pose: HolePose, nail: Nail) -> np.ndarray:
    """Return the lengths (...) in the nail's metal on rays (..., 3): its tube, less its hole."""
    return metals_mm(focal_mm, rays, [pose], nail)[0]


def metals_mm(focal_mm: np.ndarray, rays: np.ndarray, poses: Sequence[HolePose], nail: Nail) -> np.ndarray:
    """Return `metal_mm` (K, ...) of K poses of one nail."""
    first, flat = poses[0], rays.reshape(-1, 3)
    tube = _Beside.of(focal_mm, flat, first.nail_mm[None], first.along[None])
    holes = _Beside.of(focal_mm, flat, np.array([p.hole_mm for p in poses]), np.array([p.axis for p in poses]))
    outer, bore, hole = tube.span(nail.diameter_mm / 2), tube.span(nail.bore_mm / 2), holes.span(nail.hole_mm / 2)
    metal = _length(outer) - _length(bore) - _length(outer, hole) + _length(bore, hole)
    return metal.reshape(len(poses), *rays.shape[:-1])


def hole_candidates(
    cameras: Sequence[LocalCamera], nail_mm: np.ndarray, along: np.ndarray, clicks_px: Sequence[np.ndarray]
) -> list[HolePose]:
    """Return poses of a hole near a click in each view, with any roll about the nail that shows a lens.

    Raises ReconstructionRefusedError where the clicks are on two holes.
    """
    rays = [camera.rays(np.asarray(uv)) for camera, uv in zip(cameras, clicks_px, strict=True)]
    on_nail = [
        nearest_approach(nail_mm, along, camera.focal_mm, ray).first_mm
        for camera, ray in zip(cameras, rays, strict=True)
    ]
    places = np.array([(point - nail_mm) @ along for point in on_nail])
    if np.ptp(places) > MAX_CLICK_MM:
        raise ReconstructionRefusedError(
            f"the clicks are {np.ptp(places):.1f} mm apart along the nail (at most {MAX_CLICK_MM:.0f} mm): they are on "
            "two different holes; click the same hole in all images"
        )
    first = unit(across(np.sum(rays, axis=0), along))
    axes = np.cos(_ROLLS_RAD)[:, None] * first + np.sin(_ROLLS_RAD)[:, None] * np.cross(along, first)
    points = nail_mm + (places.mean() + _ALONG_MM)[:, None] * along
    return [HolePose(point, along, point, axis) for point in points for axis in axes]


def patch_px(camera: LocalCamera, at_mm: np.ndarray, nail: Nail) -> np.ndarray:
    """Return a square grid of pixels (n, n, 2) that contains the hole at a point (3,)."""
    middle = camera.project(at_mm)
    aside = np.linalg.svd(camera.rays(middle)[None])[2][1]
    reach = _PATCH * float(np.linalg.norm(camera.project(at_mm + nail.hole_mm / 2 * aside) - middle))
    steps = np.linspace(-reach, reach, _PATCH_CELLS)
    return middle + np.stack(np.meshgrid(steps, steps), axis=-1)


def rim(pose: HolePose, nail: Nail, side: float) -> tuple[np.ndarray, np.ndarray]:
    """Return points of the entry (`side` -1) or exit (1) rim, and directions away from the hole's axis, (N, 3) each."""
    angle = 2 * np.pi * np.arange(_AROUND) / _AROUND
    first = unit(across(pose.along, pose.axis))
    outward = np.cos(angle)[:, None] * first + np.sin(angle)[:, None] * np.cross(pose.axis, first)
    start = pose.hole_mm + nail.hole_mm / 2 * outward
    near, far = through_surface(start, pose.axis, (pose.nail_mm, pose.along), nail.diameter_mm / 2)
    return start + (far if side > 0 else near)[:, None] * pose.axis, outward


def through_surface(
    start_mm: np.ndarray, along: np.ndarray, line: tuple[np.ndarray, np.ndarray], radius_mm: float | np.ndarray
) -> np.ndarray:
    """Return where lines from points (..., 3) along vectors (..., 3) enter and leave a cylinder about a line (points
    and unit vectors (..., 3)): (2, ...), in lengths of the vectors."""
    point, axis = line
    off, step = across(start_mm - point, axis), across(along, axis)
    a, b, c = ((p * q).sum(axis=-1) for p, q in ((step, step), (off, step), (off, off)))
    root = np.sqrt(np.maximum(b * b - a * (c - radius_mm**2), 0.0))
    return np.stack([-b - root, root - b]) / a


@dataclass(frozen=True, eq=False)
class _Beside:
    """M rays beside K lines, (K, M): the place of a ray nearest to a line, mm from the ray's origin; the squared
    distance there, mm²; and the squared sine of the angle between them."""

    place_mm: np.ndarray
    apart_mm2: np.ndarray
    sine2: np.ndarray

    @staticmethod
    def of(origin_mm: np.ndarray, rays: np.ndarray, points_mm: np.ndarray, along: np.ndarray) -> "_Beside":
        """Return it for unit rays (M, 3) from one origin (3,), and lines through points (K, 3) along unit (K, 3)."""
        start = origin_mm - points_mm
        cosine, ahead, moment = (vectors @ rays.T for vectors in (along, start, np.cross(along, start)))
        sine2 = 1 - cosine**2
        return _Beside(((start * along).sum(axis=1)[:, None] * cosine - ahead) / sine2, moment**2 / sine2, sine2)

    def span(self, radius_mm: float) -> tuple[np.ndarray, np.ndarray]:
        """Return where the rays enter and leave cylinders about the lines, (K, M) each, mm; one place if they do not
        meet."""
        half = np.sqrt(np.maximum(radius_mm**2 - self.apart_mm2, 0.0) / self.sine2)
        return self.place_mm - half, self.place_mm + half


def _length(*spans: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
    """Return the length (...) that all spans have in common."""
    first, last = spans[0]
    for near, far in spans[1:]:
        first, last = np.maximum(first, near), np.minimum(last, far)
    return np.maximum(last - first, 0.0)
