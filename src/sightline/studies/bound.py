"""Lower bound of the error of targets: no unbiased estimator that uses the same images can do better.

The bound is the inverse Fisher information (Bayesian, van Trees) of one target's xyz in one set-up. Data: the pixels of
all visible beads of both views and of the target, with their true covariances. Nuisance parameters: both focal points
and a cubic for each view's map, with flat priors; the part of the map beyond a cubic and the errors of the frame, with
the priors that they were drawn from. Everything is linearised about the truth, so the bound is a marginal of one
Gaussian.

On the reference plane of a view, bead b (pixel u, point X) obeys `cubic(u) + beyond(u) + J noise = projection(F, X)`.
"""

from dataclasses import dataclass
from functools import partial

import numpy as np
from scipy.linalg import block_diag, cho_factor, cho_solve

from sightline.common.geometry.planes import Plane
from sightline.twin import SetUp, ViewTruth

_STEP_MM = 1e-3  # of numerical derivatives; the functions are smooth on a scale of millimetres


@dataclass(frozen=True, eq=False)
class BoundData:
    """The data of one view: `ids` of its visible beads, their covariances `bead_px2` (N, 2, 2), the target's pick.

    `pick_px2` (2, 2): covariance of the pick. `across_px` (2,): zero, or the direction in which a snapped pick is not
    a measurement.
    """

    ids: tuple[str, ...]
    bead_px2: np.ndarray
    pick_px2: np.ndarray
    across_px: np.ndarray


def bound(setup: SetUp, seen: dict[str, BoundData], target_mm: np.ndarray) -> np.ndarray:
    """Return the lower bound (3, 3), mm², of the covariance of a target at `target_mm` (3,), CFCS."""
    return target_bound([_linearised(setup, name, data, target_mm) for name, data in seen.items()])


@dataclass(frozen=True, eq=False)
class Linear:
    """One view: data = nuisance @ (unknowns without a prior) + target @ X + response @ e + noise of `covariance`.

    `e`: unit-variance errors that all views share.
    """

    nuisance: np.ndarray
    target: np.ndarray
    response: np.ndarray
    covariance: np.ndarray


def target_bound(views: list[Linear]) -> np.ndarray:
    """Return the lower bound (3, 3), mm², of the covariance of the target X of all views."""
    nuisance = np.asarray(block_diag(*[view.nuisance for view in views]))
    design = np.hstack([nuisance, np.vstack([view.target for view in views])])
    response = np.vstack([view.response for view in views])
    covariance = np.asarray(block_diag(*[view.covariance for view in views])) + response @ response.T
    information = design.T @ cho_solve(cho_factor(covariance), design)
    scale = 1.0 / np.sqrt(np.diag(information))
    return (scale[:, None] * np.linalg.inv(scale[:, None] * information * scale) * scale)[-3:, -3:]


def _linearised(setup: SetUp, name: str, seen: BoundData, target_mm: np.ndarray) -> Linear:
    """Return a view; its unknowns without a prior are the cubic and F."""
    truth, plane = setup.views[name], setup.frame.view(name).xrii.plane
    fiducials = setup.true_frame.view(name).by_id
    places = list(setup.frame.view(name).by_id)
    rows = np.array([places.index(i) for i in seen.ids])
    xyz = np.vstack([np.array([fiducials[i].xyz_mm for i in seen.ids]), target_mm])
    n, focal = len(xyz), truth.focal_point_mm
    uv = truth.project(xyz)
    by_point = derivative(partial(plane.central_projection, focal), xyz)
    by_focal = derivative(lambda f: plane.central_projection(f[0], xyz), focal[None])
    jacobian = plane_per_pixel(truth, plane, xyz, by_point)
    cubic = np.kron(cubic_terms(uv), np.eye(2))
    factor = setup.frame.error_factor[setup.frame.rows(name)].reshape(len(places), 3, -1)[rows]
    response = np.zeros((n, 2, factor.shape[-1]))
    response[:-1] = by_point[:-1] @ factor
    noise_px = np.asarray(block_diag(*seen.bead_px2, seen.pick_px2)) + truth.beyond_cubic_covariance(uv)
    to_mm = np.asarray(block_diag(*jacobian))
    linear = Linear(
        nuisance=np.hstack([cubic, -by_focal.reshape(2 * n, 3)]),
        target=np.vstack([np.zeros((2 * n - 2, 3)), by_point[-1]]),
        response=response.reshape(2 * n, -1),
        covariance=to_mm @ noise_px @ to_mm.T,
    )
    return snapped(linear, jacobian[-1], seen.across_px)


def snapped(view: Linear, jacobian: np.ndarray, across_px: np.ndarray) -> Linear:
    """Return a view with only the component of the target's pixel along its curve, if `across_px` is not zero.

    `jacobian` (2, 2): of the last two data by the target's pixel.
    """
    if not across_px.any():
        return view
    keep = np.eye(2 * len(view.target) // 2)[:-1]
    keep[-1, -2:] = np.array([across_px[1], -across_px[0]]) @ np.linalg.inv(jacobian)
    return Linear(keep @ view.nuisance, keep @ view.target, keep @ view.response, keep @ view.covariance @ keep.T)


def plane_per_pixel(truth: ViewTruth, plane: Plane, xyz_mm: np.ndarray, by_point: np.ndarray) -> np.ndarray:
    """Return d plane / d pixel (N, 2, 2) at the images of points, from displacements along the plane's axes."""
    px = derivative(truth.project, xyz_mm) @ plane.axes.T
    return (by_point @ plane.axes.T) @ np.linalg.inv(px)


def derivative(function, at: np.ndarray) -> np.ndarray:
    """Return the derivative (N, 2, 3) of a function of points, by central differences."""
    steps = _STEP_MM * np.eye(3)
    return np.stack([(function(at + s) - function(at - s)) / (2 * _STEP_MM) for s in steps], axis=-1)


def cubic_terms(uv_px: np.ndarray) -> np.ndarray:
    """Return the cubic monomials (N, 10) of pixels (N, 2)."""
    x, y = ((uv_px - uv_px.mean(axis=0)) / np.ptp(uv_px, axis=0)).T
    return np.stack([x**a * y**b for a in range(4) for b in range(4 - a)], axis=-1)
