"""The femoral head: the sphere tangent to the lines of sight of its drawn rims.

A central projection shows a sphere as an ellipse, a distorting tube as another curve, and neither is centred on the
image of its centre. The fit in space avoids both: a tangent ray passes the sphere's centre at a distance of one radius.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.linalg import block_diag

from sightline.calibration.view import CalibratedView
from sightline.common.checks import Check
from sightline.common.geometry.covariance import ellipsoid_factor, response
from sightline.common.geometry.lines import across, nearest_approach, unit
from sightline.errors import ReconstructionRefusedError
from sightline.planning.bone.aids import Circle
from sightline.planning.points.gaps import CONFIDENCE
from sightline.planning.points.lines_of_sight import CACHED, Sights

# Accepted radii of a femoral head; adults have 20 to 26 mm (physics.md, Femur) [ours].
RADII_MM = (14.0, 35.0)
_ITERATIONS, _CONVERGED_MM = 30, 1e-8
_REWEIGHTINGS = 2  # enough: the weights hardly depend on the sphere

Rays = Sequence[tuple[np.ndarray, np.ndarray]]


@dataclass(frozen=True, eq=False)
class Sphere:
    """The head, CFCS: `covariance_mm2` (4, 4) of (centre, radius), None where a view's error is unknown.

    `agreement`: the check that the outlines of both views fit one sphere; None where the error is unknown.
    """

    centre_mm: np.ndarray
    radius_mm: float
    covariance_mm2: np.ndarray | None
    agreement: Check | None


@dataclass(frozen=True, eq=False)
class Redundant:
    """R numbers of a drawing on two images whose mean is zero for a bone at rest: `values` (R,), mm; their derivatives
    `by_z` (R, n) by the drawing's numbers, and `by_shift` (R, 3) by a shift of the bone between the images, CFCS."""

    values: np.ndarray
    by_z: np.ndarray
    by_shift: np.ndarray

    def along(self, normal: np.ndarray, covariance: np.ndarray) -> "Redundant":
        """Return the one number that estimates a shift along a unit vector (3,) best; `covariance` (n, n) of the
        drawing's numbers."""
        shown = self.by_shift @ normal
        weights = np.linalg.solve(self.by_z @ covariance @ self.by_z.T, shown)
        gain = (weights / (weights @ shown))[None]
        return Redundant(gain @ self.values, gain @ self.by_z, gain @ self.by_shift)


def redundant_of_head(views: Sequence[CalibratedView], circles: tuple[Circle, Circle]) -> Redundant:
    """Return what no sphere explains of the drawn rims of `find_head`. Raises ReconstructionRefusedError."""
    return _found(tuple(views), _as_bytes(circles))[3]


def find_head(
    views: Sequence[CalibratedView], circles: tuple[Circle, Circle]
) -> tuple[np.ndarray, np.ndarray, Check | None]:
    """Return centre and radius (4,) of the sphere drawn by `circles` in two views, their derivatives (4, n) by
    `Sights.index` of the drawing, and the check that the outlines agree.

    Maximum likelihood: weighted by the joint covariance of all drawn numbers, with equal weights where it is unknown.
    It does not depend on anything else that is drawn, and is kept for the next call. Raises
    ReconstructionRefusedError.
    """
    return _found(tuple(views), _as_bytes(circles))[:3]


def _as_bytes(circles: tuple[Circle, Circle]) -> tuple[tuple[bytes, bytes, bytes], ...]:
    return tuple((one.uv_px.tobytes(), one.covariance_px2.tobytes(), one.summary.tobytes()) for one in circles)


@lru_cache(maxsize=CACHED)
def _found(
    views: tuple[CalibratedView, ...], drawn: tuple[tuple[bytes, bytes, bytes], ...]
) -> tuple[np.ndarray, np.ndarray, Check | None, Redundant]:
    arrays = [[np.frombuffer(part) for part in circle] for circle in drawn]
    sights = Sights.of(views, [{"head": (uv.reshape(-1, 2), own.reshape(len(uv), -1))} for uv, own, _ in arrays])
    covariance, at = sights.covariance, sights.values
    rays = sights.rays("head", at[None])
    summary = np.asarray(block_diag(*(numbers.reshape(-1, len(uv) // 2) for uv, _, numbers in arrays)))
    weights, sphere = np.eye(len(summary)), _fitted(rays, summary, np.eye(len(summary)), _start(rays))
    for _ in range(0 if covariance is None else _REWEIGHTINGS):
        by_z = summary @ _by_z(sights, at, sphere)
        weights = np.linalg.inv(by_z @ covariance @ by_z.T)
        sphere = _fitted(rays, summary, weights, sphere)
    own = -_gain(rays, summary, weights, sphere) @ summary @ _by_z(sights, at, sphere)
    residual = summary @ _distances(rays, sphere)[0]
    square = float(residual @ weights @ residual)
    agreement = None if covariance is None else _agreement(square, len(summary) - len(sphere))
    unexplained = np.linalg.svd(summary @ _by_sphere(rays, sphere))[0][:, len(sphere) :].T @ summary
    moved = [np.zeros((rays[0][1].shape[1], 3)), -unit(_to_centre(*rays[1], sphere)[0])]
    left = Redundant(
        unexplained @ _distances(rays, sphere)[0],
        unexplained @ _by_z(sights, at, sphere),
        unexplained @ np.concatenate(moved),
    )
    return sphere, own, agreement, left


def _fitted(rays: Rays, summary: np.ndarray, weights: np.ndarray, sphere: np.ndarray) -> np.ndarray:
    """Return the weighted least-squares sphere (4,), starting at `sphere`. Raises ReconstructionRefusedError."""
    step = np.full(4, np.inf)
    for _ in range(_ITERATIONS):
        step = -_gain(rays, summary, weights, sphere) @ summary @ _distances(rays, sphere)[0]
        sphere = sphere + step
        if not np.isfinite(sphere).all() or np.abs(step).max() < _CONVERGED_MM:
            break
    if not np.abs(step).max() < _CONVERGED_MM or not RADII_MM[0] <= sphere[3] <= RADII_MM[1]:
        raise ReconstructionRefusedError(
            f"the outlines of the head do not fit a sphere of {RADII_MM[0]:.0f} to {RADII_MM[1]:.0f} mm radius; draw "
            "the head's rim again in both images, over as much of it as is visible"
        )
    return sphere


def _gain(rays: Rays, summary: np.ndarray, weights: np.ndarray, sphere: np.ndarray) -> np.ndarray:
    """Return the gain (4, k): the sphere's step is minus this times the measured distances from it."""
    design = summary @ _by_sphere(rays, sphere)
    try:
        return np.linalg.solve(design.T @ weights @ design, design.T @ weights)
    except np.linalg.LinAlgError:
        raise ReconstructionRefusedError(
            "the clicks on the head's rim do not determine a sphere; spread them over the rim in both images"
        ) from None


def outline(view: CalibratedView, sphere: Sphere, points: int = 48) -> np.ndarray:
    """Return the head's silhouette in a view, (n, 2) px in order: those of `points` even ones that the view shows."""
    towards = sphere.centre_mm - view.focal_point_mm
    distance = float(np.linalg.norm(towards))
    sine = sphere.radius_mm / distance
    first, second = np.linalg.svd(towards[None])[2][1:]
    angle = 2 * np.pi * np.arange(points) / points
    ring = np.cos(angle)[:, None] * first + np.sin(angle)[:, None] * second
    middle = sphere.centre_mm - sphere.radius_mm * sine * towards / distance
    return view.project_seen(middle + sphere.radius_mm * np.sqrt(1 - sine**2) * ring)[0]


def _start(rays: Rays) -> np.ndarray:
    """Return a first sphere (4,): the closest approach of both views' mean rays, and the other rays' mean distance."""
    a, b = ((focal[0], (points - focal)[0].mean(axis=0, keepdims=True)) for focal, points in rays)
    centre = nearest_approach(*a, *b).middle_mm[0]
    return np.append(centre, _distances(rays, np.append(centre, 0.0)).mean())


def _distances(rays: Rays, sphere: np.ndarray) -> np.ndarray:
    """Return (K, M), mm: the distance of each line of sight from the surface of the sphere (4,), positive outside."""
    return np.concatenate([np.linalg.norm(_to_centre(*view, sphere), axis=-1) for view in rays], axis=1) - sphere[3]


def _by_z(sights: Sights, at: np.ndarray, sphere: np.ndarray) -> np.ndarray:
    """Return (M, n): the derivative of `_distances` by the head's numbers in z."""
    return response(lambda z: _distances(sights.rays("head", z), sphere), at)[1]


def _by_sphere(rays: Rays, sphere: np.ndarray) -> np.ndarray:
    """Return (M, 4): the derivative of `_distances` by centre and radius, for one set of rays."""
    outward = unit(np.concatenate([_to_centre(*view, sphere)[0] for view in rays]))
    return np.column_stack([outward, -np.ones(len(outward))])


def _to_centre(focal: np.ndarray, points: np.ndarray, sphere: np.ndarray) -> np.ndarray:
    """Return (K, M, 3): the perpendicular from each line of sight to the sphere's centre."""
    return across(sphere[:3] - focal, unit(points - focal))


def _agreement(chi_square: float, freedom: int) -> Check:
    limit = ellipsoid_factor(CONFIDENCE, freedom) ** 2
    passed = chi_square <= limit
    sentence = (
        "The outlines of the head in both images fit one sphere."
        if passed
        else "The outlines of the head do not fit one sphere: the clicks are less accurate than stated, the patient "
        "moved between the views, or the head is not round. Draw them again."
    )
    return Check("head agreement", passed, chi_square, limit, "χ²", sentence)
