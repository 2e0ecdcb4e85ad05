"""The prior's average over its grid, of which only a part is computed."""

import numpy as np
import pytest
from calibration_scenes import GAMMA

from sightline.calibration import prior
from sightline.calibration.beads import match
from sightline.calibration.joint import fit_jointly
from sightline.detection import Observations
from sightline.twin import bead_images, draw_setup


@pytest.mark.parametrize("noise_known", [True, False])
@pytest.mark.parametrize("seed", range(3))
def test_what_is_left_out_of_the_grid_has_no_weight(monkeypatch, seed: int, noise_known: bool) -> None:
    rng = np.random.default_rng(seed)
    ids, uv_px = bead_images(draw_setup(rng, GAMMA), "lateral", rng, 0.1)
    noise = np.repeat(0.01 * np.eye(2)[None], len(ids), axis=0) if noise_known else None
    beads = match(Observations("lateral", ids, uv_px, noise), GAMMA, "lateral")
    part = fit_jointly(beads).learned
    monkeypatch.setattr(prior, "MAX_LOG_RATIO", np.inf)
    whole = fit_jointly(beads).learned
    assert part.noise_scale == pytest.approx(whole.noise_scale, rel=1e-6)  # a weight of exp(-15) is 3e-7
    at = np.random.default_rng(9).uniform(-1, 1, (20, 2))
    np.testing.assert_allclose(part.kernel(at, at), whole.kernel(at, at), rtol=1e-5)
