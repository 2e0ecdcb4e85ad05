"""Methods from the same beads to points in space: ours, the paper's, and common alternatives."""

from collections.abc import Callable
from contextlib import suppress
from functools import partial

import cv2
import numpy as np
from scipy.interpolate import RBFInterpolator
from scipy.spatial import KDTree

import sightline as sl
from sightline.calibration import BeadView
from sightline.calibration.maps.fit_map import Method as MapName
from sightline.calibration.maps.hull import Hull
from sightline.calibration.plates.classical import focal_point
from sightline.common.geometry.lines import nearest_approach
from sightline.errors import SightlineError
from sightline.studies.scenes import VIEWS, TargetScene

# From target pixels (2, T, 2) and their standard deviation, px, to points (T, 3), CFCS.
Locate = Callable[[np.ndarray, float], np.ndarray]
Method = Callable[[TargetScene], Locate]
Predict = Callable[[np.ndarray], np.ndarray]
Fit = Callable[[np.ndarray, np.ndarray], Predict]

# Exceptions by which a method refuses.
REFUSALS = (SightlineError, cv2.error, np.linalg.LinAlgError)
LWM_NEIGHBOURS = 12  # as in XMALab and Matlab's cp2tform


def local_weighted_mean(uv: np.ndarray, xy: np.ndarray) -> Predict:
    """Fit the local weighted mean of Goshtasby 1988, as in XMALab and Matlab's cp2tform: blended quadratics through 12
    neighbours."""
    tree = KDTree(uv)
    distance, near = (np.asarray(a) for a in tree.query(uv, k=LWM_NEIGHBOURS))
    reach = distance[:, -1]

    def quadratic(d: np.ndarray) -> np.ndarray:
        x, y = d[..., 0], d[..., 1]
        return np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=-1)

    coefficients = [
        np.linalg.lstsq(quadratic((uv[k] - centre) / r), xy[k], rcond=None)[0]
        for k, centre, r in zip(near, uv, reach, strict=True)
    ]

    def predict(at: np.ndarray) -> np.ndarray:
        total, points = np.zeros((len(at), 1)), np.zeros_like(at)
        for centre, r, c in zip(uv, reach, coefficients, strict=True):
            d = (at - centre) / r
            t = np.minimum(np.linalg.norm(d, axis=1), 1.0)[:, None]
            weight = 1 - 3 * t**2 + 2 * t**3
            total += weight
            points += weight * (quadratic(d) @ c)
        return points / np.maximum(total, 1e-12)

    return predict


def thin_plate_spline(uv: np.ndarray, xy: np.ndarray) -> Predict:
    """Fit scipy's thin-plate spline through every control point."""
    return RBFInterpolator(uv, xy, kernel="thin_plate_spline")


# Methods of this package: the map, and the degree of a polynomial.
OURS: dict[str, tuple[MapName, int]] = {
    "smooth": ("smooth", 3),
    "localized": ("localized", 3),
    **{f"polynomial {degree}": ("polynomial", degree) for degree in (1, 2, 3, 5, 7)},
}


def calibrated(scene: TargetScene, name: str = "smooth") -> list[BeadView]:
    """Calibrate both views of a scene by one of OURS."""
    method, degree = OURS[name]
    return [sl.calibrate(scene.observations[view], scene.frame, method=method, degree=degree) for view in VIEWS]


def ours(name: str, scene: TargetScene) -> Locate:
    """Calibrate a scene by a method of this package: `smooth` with the covariance-weighted point, the others, as in the
    paper, with the point of nearest approach."""
    views = calibrated(scene, name)
    how = "weighted" if name == "smooth" else "nearest"

    def locate(uv_px: np.ndarray, pick_px: float) -> np.ndarray:
        covariance = np.broadcast_to(pick_px**2 * np.eye(2), (2, uv_px.shape[1], 2, 2))
        return sl.reconstruct(views, uv_px, covariance, how).xyz_mm

    return locate


def by_plates(fit: Fit, scene: TargetScene) -> Locate:
    """Calibrate a scene by the paper's method with another map: one map per plate, the focal point as the intersection
    of lines through both, the point of nearest approach."""
    views = [_plates(scene, name, fit) for name in VIEWS]

    def locate(uv_px: np.ndarray, pick_px: float) -> np.ndarray:
        lines = [(focal, through(uv) - focal) for (focal, through), uv in zip(views, uv_px, strict=True)]
        return nearest_approach(*[end for line in lines for end in line]).middle_mm

    return locate


def _plates(scene: TargetScene, name: str, fit: Fit) -> tuple[np.ndarray, Predict]:
    """Return the focal point, and the map from pixels to points of their lines of sight on the XRII plate, CFCS."""
    view, seen = scene.frame.view(name), scene.observations[name]
    maps, beads = [], []
    for plate in (view.xrii, view.source):
        on_plate = np.isin(seen.ids, plate.ids)
        xyz = np.array([view.by_id[i].xyz_mm for i, mine in zip(seen.ids, on_plate, strict=True) if mine])
        beads.append((seen.uv_px[on_plate], xyz))
        maps.append(fit(seen.uv_px[on_plate], plate.plane.to_plane(xyz)))
    (uv, xyz), (source_uv, _) = beads
    crossed = Hull.of(source_uv).contains(uv)  # where the source plate's map interpolates
    focal = focal_point(xyz[crossed], view.source.plane.to_space(maps[1](uv[crossed])))
    return focal, lambda at: view.xrii.plane.to_space(maps[0](at))


def opencv(parameters: int, scene: TargetScene) -> Locate:
    """Calibrate a scene by OpenCV's method: calibrateCamera with 0, 5 or 14 distortion parameters on all beads, then
    triangulatePoints. 0: bundle adjustment of a pinhole."""
    cameras = [_camera(scene, name, parameters) for name in VIEWS]

    def locate(uv_px: np.ndarray, pick_px: float) -> np.ndarray:
        flat = [
            cv2.undistortPoints(uv[:, None], camera, distortion)[:, 0].T
            for (camera, distortion, _), uv in zip(cameras, uv_px, strict=True)
        ]
        homogeneous = cv2.triangulatePoints(cameras[0][2], cameras[1][2], *flat)
        return (homogeneous[:3] / homogeneous[3]).T

    return locate


def _camera(scene: TargetScene, name: str, parameters: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return camera matrix, distortion and pose (3, 4) of one view. The fit starts from the nominal focal length and
    centre."""
    flags = cv2.CALIB_USE_INTRINSIC_GUESS
    if parameters == 0:
        flags |= cv2.CALIB_ZERO_TANGENT_DIST | cv2.CALIB_FIX_K1 | cv2.CALIB_FIX_K2 | cv2.CALIB_FIX_K3
    if parameters == 14:
        flags |= cv2.CALIB_RATIONAL_MODEL | cv2.CALIB_THIN_PRISM_MODEL | cv2.CALIB_TILTED_MODEL
    criteria = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 200, 1e-12)
    known, seen, chain = scene.frame.xyz_mm_by_id, scene.observations[name], scene.setup.views[name].chain
    height, width = chain.shape
    beads = np.array([known[i] for i in seen.ids], dtype=np.float32)
    focal_px = chain.sdd_mm / chain.pitch_mm
    guess = np.array([[focal_px, 0.0, (width - 1) / 2], [0.0, focal_px, (height - 1) / 2], [0.0, 0.0, 1.0]])
    pixels = seen.uv_px.astype(np.float32)
    _, camera, distortion, turns, shifts = cv2.calibrateCamera(
        [beads], [pixels], (width, height), guess, np.zeros(parameters or 5), flags=flags, criteria=criteria
    )
    return camera, distortion, np.hstack([cv2.Rodrigues(turns[0])[0], shifts[0]])


METHODS: dict[str, Method] = {
    **{name: partial(ours, name) for name in OURS},
    "OpenCV 0": partial(opencv, 0),
    "OpenCV 5": partial(opencv, 5),
    "OpenCV 14": partial(opencv, 14),
    "local weighted mean": partial(by_plates, local_weighted_mean),
    "thin-plate spline": partial(by_plates, thin_plate_spline),
}


def errors(scene: TargetScene, method: str, picks: list[tuple[np.ndarray, float]]) -> list[np.ndarray | None]:
    """Return the errors (T,), mm, of the targets for each of `picks` (pixels (2, T, 2), their s.d.); None: refused."""
    of_picks: list[np.ndarray | None] = [None] * len(picks)
    with suppress(*REFUSALS):
        locate = METHODS[method](scene)
        for k, (uv_px, pick_px) in enumerate(picks):
            with suppress(*REFUSALS):
                of_picks[k] = np.linalg.norm(locate(uv_px, pick_px) - scene.target_mm, axis=1)
    return of_picks
