"""The paper's figure 12 as a study."""

import json

import numpy as np
import pytest

from sightline.planning.curve import MatchingCurve
from sightline.studies.study_fig12 import ENDS, Figure12, held


def bent(half_width_px: float) -> MatchingCurve:
    """A parabola that leaves the chord between -60 and 60 mm by 18 px."""
    depth = np.arange(-100.0, 101.0, 2.0)
    uv = np.stack([5 * depth, depth**2 / 200], axis=-1)
    tangent = np.tile([1.0, 0.0], (len(depth), 1))
    flat = np.zeros(len(depth), dtype=bool)
    xyz = np.zeros((len(depth), 3))
    return MatchingCurve("pa", "lateral", depth, xyz, uv, tangent, flat, lambda: np.full(len(depth), half_width_px))


def test_distance_band_and_bend_of_a_curve_that_is_known():
    found = held(bent(2.5), np.array([0.0, -3.0]))
    assert found == {"off_px": pytest.approx(-3.0), "band_px": 2.5, "bend_px": pytest.approx(18.0)}


@pytest.mark.slow
def test_exact_picks_and_beads_leave_the_true_place_on_the_curve():
    calm = Figure12(pick_px=1e-3, bead_px=0.01)
    rough = Figure12(pick_px=5.0, bead_px=0.01)
    off = [[one.trial(np.random.default_rng([4, k]))["entry"]["off_px"] for k in range(6)] for one in (calm, rough)]
    assert np.std(off[0]) < 2.5  # the frame's tolerances alone
    assert np.std(off[1]) > 1.3 * np.std(off[0])


def test_a_trial_repeats_and_is_plain():
    trial = Figure12().trial(np.random.default_rng([3, 1]))
    assert json.loads(json.dumps(trial)) == trial
    assert trial == Figure12().trial(np.random.default_rng([3, 1]))
    assert all(0.5 < trial[end]["band_px"] < 12.0 for end in ENDS)


@pytest.mark.slow
def test_the_summary_states_shares_and_draws_the_curves():
    trial = Figure12().trial(np.random.default_rng([3, 1]))
    one = {"band_px": 2.0, "bend_px": 4.0}
    trials = [{**trial, **{end: {**one, "off_px": off} for end in ENDS}} for off in (-1.0, 3.0)]
    summary = Figure12().summary([*trials, {"draw": 1, "refused": "LabellingRefusedError"}])
    assert summary.estimates[0].value == pytest.approx(1 / 3)
    assert summary.tables[0].rows[0][1].startswith("0.5 (")
    assert "image-matching curve of the end" in summary.plots[0].svg
    assert "data:image/jpeg" in summary.plots[0].svg
