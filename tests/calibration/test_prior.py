"""The prior's average over its grid, of which only a part is computed."""

from dataclasses import replace

import numpy as np
import pytest
from calibration_scenes import GAMMA

from sightline.calibration.maps import smooth as prior
from sightline.calibration.plates.beads import match
from sightline.calibration.plates.joint import fit_jointly
from sightline.studies.scenes import measure
from sightline.twin import draw_setup


@pytest.mark.parametrize("noise_known", [True, False])
@pytest.mark.parametrize("seed", range(2))
def test_what_is_left_out_of_the_grid_has_no_weight(monkeypatch, seed: int, noise_known: bool) -> None:
    rng = np.random.default_rng(seed)
    seen = measure(rng, draw_setup(rng, GAMMA), 0.1)["lateral"]
    beads = match(seen if noise_known else replace(seen, covariance_px2=None), GAMMA, "lateral")
    part = fit_jointly(beads).learned
    monkeypatch.setattr(prior, "MAX_LOG_RATIO", np.inf)
    whole = fit_jointly(beads).learned
    assert part.noise_scale == pytest.approx(whole.noise_scale, rel=1e-6)  # a weight of exp(-15) is 3e-7
    at = np.random.default_rng(9).uniform(-1, 1, (20, 2))
    np.testing.assert_allclose(part.kernel(at, at), whole.kernel(at, at), rtol=1e-5)


def test_the_evidence_is_that_of_its_definition() -> None:
    """Fails where a determinant is left out or counted twice, or a shared column acts on one coordinate only."""
    rng, n, a, shared = np.random.default_rng(3), 20, 4, 2
    shape = np.cov(rng.normal(size=(n, 3 * n)))
    design, data, columns = rng.normal(size=(n, a)), rng.normal(size=(n, 2)), rng.normal(size=(n, 2, shared))
    diagonal = rng.uniform(0.5, 1.0, n)
    rows = np.concatenate([design, data, np.swapaxes(columns, 1, 2).reshape(n, -1)], axis=1).T
    evidence = prior._log_evidence(3.0 * shape + np.diag(diagonal), rows, a)

    covariance = np.kron(3.0 * shape + np.diag(diagonal), np.eye(2))
    every = np.hstack([np.kron(design, np.eye(2)), columns.reshape(2 * n, shared)])
    inverse = np.linalg.inv(covariance)
    normal = every.T @ inverse @ every
    residual = data.ravel() - every @ np.linalg.solve(normal, every.T @ inverse @ data.ravel())
    misfit = residual @ inverse @ residual
    log_det = np.linalg.slogdet(covariance)[1] + np.linalg.slogdet(normal)[1]
    assert evidence == pytest.approx(-0.5 * (log_det + misfit), rel=1e-10)


def test_the_prior_does_not_depend_on_the_rounding_of_pixels() -> None:
    """Fails (2e-9) where the evidence is computed from data a million times as large as their noise."""
    rng = np.random.default_rng(0)
    seen, found = measure(rng, draw_setup(rng, GAMMA), 0.01)["lateral"], []
    for scale in 1.0 + 4e-16 * np.arange(6):
        scaled = replace(seen, uv_px=seen.uv_px * scale)
        found.append(fit_jointly(match(scaled, GAMMA, "lateral")).learned.kernel.variances_mm2)
    np.testing.assert_allclose(found, found[:1] * 6, rtol=3e-10)
