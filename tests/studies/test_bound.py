"""The bound against brute force: every nuisance an explicit parameter."""

from dataclasses import replace

import numpy as np
import pytest

from sightline.frame import Frame, Tolerances
from sightline.studies.bound import BoundData, bound
from sightline.twin import SetUp, bead_images, draw_setup

TARGET_MM = np.array([12.3, -7.9, 15.1])
BEAD_PX, PICK_PX = 0.1, 0.2
STEP = 1e-3


@pytest.fixture(scope="module")
def setup() -> SetUp:
    frame = replace(Frame.load("gamma"), tolerances=Tolerances(0.02, 0.03, 1e-4, 0.05, 2e-4))
    return draw_setup(np.random.default_rng(11), frame)


@pytest.fixture(scope="module")
def seen(setup: SetUp) -> dict[str, BoundData]:
    """Every third bead only, to keep the explicit problem small."""
    out = {}
    for name in ("pa", "lateral"):
        ids = bead_images(setup, name, np.random.default_rng(0), sd_px=0.0)[0][::3]
        noise = np.broadcast_to(BEAD_PX**2 * np.eye(2), (len(ids), 2, 2))
        out[name] = BoundData(ids, noise, PICK_PX**2 * np.eye(2), np.zeros(2))
    return out


def _explicit(setup: SetUp, name: str, seen: BoundData) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """How the measured pixels of beads and target (flattened) move with the flat nuisances (cubic, F), with the
    nuisances that have a unit prior (beyond cubic; frame), and with the target, by moving everything a little."""
    truth, plane = setup.views[name], setup.frame.view(name).xrii.plane
    beads = setup.true_frame.view(name).by_id
    xyz = np.vstack([[beads[i].xyz_mm for i in seen.ids], TARGET_MM])
    focal = truth.focal_point_mm

    def pixels(f: np.ndarray, points: np.ndarray, shift_mm: np.ndarray) -> np.ndarray:
        on_plane = plane.central_projection(f, points) + shift_mm
        return truth.project(plane.to_space(on_plane)).ravel()

    zero = np.zeros((len(xyz), 2))

    def moved(f: np.ndarray, points: np.ndarray, shift_mm: np.ndarray) -> np.ndarray:
        here = pixels(focal + STEP * f, xyz + STEP * points, STEP * shift_mm)
        there = pixels(focal - STEP * f, xyz - STEP * points, -STEP * shift_mm)
        return (here - there) / (2 * STEP)

    nothing, still = np.zeros(3), np.zeros_like(xyz)
    x, y = (truth.project(xyz) / 500 - 1).T
    powers = np.stack([x**a * y**b for a in range(4) for b in range(4 - a)])
    cubic = [moved(nothing, still, np.outer(p, axis)) for p in powers for axis in np.eye(2)]
    by_focal = [moved(axis, still, zero) for axis in np.eye(3)]
    last = np.eye(len(xyz))[-1]
    by_target = [moved(nothing, np.outer(last, axis), zero) for axis in np.eye(3)]
    order = list(setup.frame.view(name).by_id)
    rows = [order.index(i) for i in seen.ids]
    factor = setup.frame.error_factor[setup.frame.rows(name)].reshape(len(order), 3, -1)[rows]
    by_axis = np.stack([moved(nothing, np.tile(axis, (len(xyz), 1)), zero) for axis in np.eye(3)], axis=-1)
    frame = np.zeros((2 * len(xyz), factor.shape[-1]))
    frame[:-2] = np.einsum("ija,iak->ijk", by_axis[:-2].reshape(-1, 2, 3), factor).reshape(-1, factor.shape[-1])
    beyond = truth.beyond_cubic_factor(truth.project(xyz))
    return np.transpose(cubic + by_focal), beyond, frame, np.transpose(by_target)


@pytest.fixture(scope="module")
def explicit(setup: SetUp, seen: dict[str, BoundData]) -> tuple[np.ndarray, np.ndarray]:
    """Design (whitened data by parameters), and prior information of the parameters."""
    parts = [_explicit(setup, name, one) for name, one in seen.items()]
    sizes = [len(p[0]) for p in parts]
    flat = [p[0].shape[1] for p in parts]
    beyond = [p[1].shape[1] for p in parts]
    shared = parts[0][2].shape[1]
    total = sum(flat) + sum(beyond) + shared + 3
    design = np.zeros((sum(sizes), total))
    for k, (nuisance, own, frame, target) in enumerate(parts):
        rows = slice(sum(sizes[:k]), sum(sizes[: k + 1]))
        design[rows, sum(flat[:k]) : sum(flat[: k + 1])] = nuisance
        start = sum(flat) + sum(beyond[:k])
        design[rows, start : start + beyond[k]] = own
        design[rows, total - 3 - shared : total - 3] = frame
        design[rows, total - 3 :] = target
    sd = np.concatenate([np.r_[np.full(n - 2, BEAD_PX), PICK_PX, PICK_PX] for n in sizes])
    prior = np.ones(total)
    prior[: sum(flat)] = prior[-3:] = 0.0
    return design / sd[:, None], prior


def test_bound_is_the_inverse_of_the_explicit_information(setup, seen, explicit):
    design, prior = explicit
    brute = np.linalg.inv(design.T @ design + np.diag(prior))[-3:, -3:]
    np.testing.assert_allclose(bound(setup, seen, TARGET_MM), brute, rtol=1e-4, atol=1e-8)


def test_snapped_bound_is_the_limit_of_a_huge_variance(setup, seen):
    across = np.array([0.6, 0.8])
    snapped = dict(seen) | {"lateral": replace(seen["lateral"], across_px=across)}
    huge = PICK_PX**2 * np.eye(2) + 1e6 * np.outer(across, across)
    blurred = dict(seen) | {"lateral": replace(seen["lateral"], pick_px2=huge)}
    np.testing.assert_allclose(bound(setup, snapped, TARGET_MM), bound(setup, blurred, TARGET_MM), rtol=1e-4, atol=1e-7)
