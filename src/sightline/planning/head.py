"""The femoral head: the sphere that the lines of sight of its drawn rims touch.

A central projection shows a sphere as an ellipse, a distorting tube as something else, and neither is centred on the
image of its centre. Lines of sight that touch a sphere have none of this: each passes the centre at one radius.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import block_diag

from sightline.calibration.view import CalibratedView
from sightline.checks import Check
from sightline.errors import ReconstructionRefusedError
from sightline.geometry.covariance import ellipsoid_factor, response
from sightline.geometry.lines import nearest_approach
from sightline.planning.aids import Circle
from sightline.planning.sights import Sights

# Radii between which a sphere may be a femoral head; adults have 20 to 26 mm (physics.md, Femur) [ours].
RADII_MM = (14.0, 35.0)
# Outlines of one sphere disagree so much once in a thousand heads [ours].
_AGREE = 0.999
_ITERATIONS, _CONVERGED_MM = 30, 1e-8
_REWEIGHTED = 2  # times: weights hardly follow the sphere

Rays = Sequence[tuple[np.ndarray, np.ndarray]]


@dataclass(frozen=True, eq=False)
class Sphere:
    """The head, CFCS: `covariance_mm2` (4, 4) of (centre, radius), None where a view's error is unknown.

    `agreement`: are the outlines of both views those of one sphere? None where the error is unknown.
    """

    centre_mm: np.ndarray
    radius_mm: float
    covariance_mm2: np.ndarray | None
    agreement: Check | None


def find_head(
    sights: Sights, circles: tuple[Circle, Circle], covariance: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray, Check | None]:
    """Centre and radius (4,) of the sphere drawn as "head", how they follow its numbers in z (4, n), and whether the
    outlines agree. `covariance`: of z.

    Maximum likelihood: every drawn number weighs by the joint covariance of all; alike where that is unknown.
    Raises ReconstructionRefusedError.
    """
    index = sights.index("head")
    at = sights.values[index]
    rays = sights.rays("head", at[None])
    summary = np.asarray(block_diag(*(circle.summary for circle in circles)))
    weights, sphere = np.eye(len(summary)), _fitted(rays, summary, np.eye(len(summary)), _start(rays))
    own_covariance = None if covariance is None else covariance[np.ix_(index, index)]
    for _ in range(0 if own_covariance is None else _REWEIGHTED):
        by_z = summary @ _by_z(sights, at, sphere)
        weights = np.linalg.inv(by_z @ own_covariance @ by_z.T)
        sphere = _fitted(rays, summary, weights, sphere)
    own = -_gain(rays, summary, weights, sphere) @ summary @ _by_z(sights, at, sphere)
    missed = summary @ _missed(rays, sphere)[0]
    agreement = None if covariance is None else _agreement(float(missed @ weights @ missed), len(summary) - len(sphere))
    return sphere, own, agreement


def _fitted(rays: Rays, summary: np.ndarray, weights: np.ndarray, sphere: np.ndarray) -> np.ndarray:
    """Weighted least squares from a first sphere (4,). Raises ReconstructionRefusedError."""
    step = np.full(4, np.inf)
    for _ in range(_ITERATIONS):
        step = -_gain(rays, summary, weights, sphere) @ summary @ _missed(rays, sphere)[0]
        sphere = sphere + step
        if not np.isfinite(sphere).all() or np.abs(step).max() < _CONVERGED_MM:
            break
    if not np.abs(step).max() < _CONVERGED_MM or not RADII_MM[0] <= sphere[3] <= RADII_MM[1]:
        raise ReconstructionRefusedError(
            f"the outlines of the head belong to no sphere of {RADII_MM[0]:.0f} to {RADII_MM[1]:.0f} mm radius; "
            "draw the head's rim again, as far round as it can be seen, in both images"
        )
    return sphere


def _gain(rays: Rays, summary: np.ndarray, weights: np.ndarray, sphere: np.ndarray) -> np.ndarray:
    """(4, k): the sphere moves by minus this times what the drawings miss it by."""
    design = summary @ _by_sphere(rays, sphere)
    try:
        return np.linalg.solve(design.T @ weights @ design, design.T @ weights)
    except np.linalg.LinAlgError:
        raise ReconstructionRefusedError(
            "the clicks on the head's rim determine no sphere; spread them over the rim in both images"
        ) from None


def outline(view: CalibratedView, sphere: Sphere, points: int = 48) -> np.ndarray:
    """The head's silhouette as a view shows it, (n, 2) px in order: what of `points` even ones the view sees."""
    towards = sphere.centre_mm - view.focal_point_mm
    distance = float(np.linalg.norm(towards))
    sine = sphere.radius_mm / distance
    across = np.linalg.svd(towards[None])[2][1:]
    turn = 2 * np.pi * np.arange(points) / points
    ring = np.cos(turn)[:, None] * across[0] + np.sin(turn)[:, None] * across[1]
    middle = sphere.centre_mm - sphere.radius_mm * sine * towards / distance
    return view.project_seen(middle + sphere.radius_mm * np.sqrt(1 - sine**2) * ring)[0]


def _start(rays: Rays) -> np.ndarray:
    """(4,): where the middle rays of both views pass nearest, and how far from there the others pass."""
    a, b = ((focal[0], (points - focal)[0].mean(axis=0, keepdims=True)) for focal, points in rays)
    centre = nearest_approach(*a, *b).middle_mm[0]
    return np.append(centre, _missed(rays, np.append(centre, 0.0)).mean())


def _missed(rays: Rays, sphere: np.ndarray) -> np.ndarray:
    """(K, M): how far outside the sphere (4,) each line of sight passes, mm."""
    return np.concatenate([np.linalg.norm(_across(*one, sphere), axis=-1) for one in rays], axis=1) - sphere[3]


def _by_z(sights: Sights, at: np.ndarray, sphere: np.ndarray) -> np.ndarray:
    """(M, n): derivative of `_missed` by the head's numbers in z."""
    return response(lambda z: _missed(sights.rays("head", z), sphere), at)[1]


def _by_sphere(rays: Rays, sphere: np.ndarray) -> np.ndarray:
    """(M, 4): derivative of `_missed`, for one set of rays, by centre and radius."""
    across = np.concatenate([_across(*one, sphere)[0] for one in rays])
    outward = across / np.linalg.norm(across, axis=1, keepdims=True)
    return np.column_stack([outward, -np.ones(len(outward))])


def _across(focal: np.ndarray, points: np.ndarray, sphere: np.ndarray) -> np.ndarray:
    """(K, M, 3): from each line of sight straight to the centre."""
    way = points - focal
    way = way / np.linalg.norm(way, axis=-1, keepdims=True)
    to_centre = sphere[:3] - focal
    return to_centre - (to_centre * way).sum(axis=-1, keepdims=True) * way


def _agreement(misfit: float, freedom: int) -> Check:
    limit = ellipsoid_factor(_AGREE, freedom) ** 2
    passed = misfit <= limit
    sentence = "The outlines of the head in both images are those of one sphere" + (
        "."
        if passed
        else " only if the clicks err more than stated, the patient moved between the views, or the head is not round: "
        "draw them again."
    )
    return Check("head agreement", passed, misfit, limit, "χ²", sentence)
