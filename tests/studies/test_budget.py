"""The error budget as a study."""

import json

import numpy as np
import pytest

from sightline.studies.budget import FRAME_ALONE, MEANINGS, STATED, TOGETHER, Budget, SetUpWith
from sightline.studies.scenes import EXACT, VIEWS, WHOLE

SMALL = Budget(picks_px=(0.5,))


def test_set_ups_differ_by_what_is_switched_on_alone():
    rng = np.random.default_rng(6)
    none, plates, beads = (
        SetUpWith(rng, EXACT, 0.1, bead_noise=False),
        SetUpWith(rng, FRAME_ALONE["plates"], 0.1, bead_noise=False),
        SetUpWith(rng, EXACT, 0.1, bead_noise=True),
    )
    for name in VIEWS:
        one, other = none.scene.setup.views[name], plates.scene.setup.views[name]
        np.testing.assert_array_equal(one.focal_point_mm, other.focal_point_mm)
        shifts = np.subtract(
            [f.xyz_mm for f in plates.scene.setup.true_frame.view(name).xrii.fiducials],
            plates.scene.frame.view(name).xrii.xyz_mm,
        )
        # A plate moves as one: its balls differ by what 0.2 mrad turn over 93 mm, four standard deviations.
        assert 0 < np.ptp(shifts, axis=0).max() < 4 * 0.2e-3 * 2 * 93
        noise = beads.scene.observations[name].uv_px - none.scene.observations[name].uv_px
        assert noise.std() == pytest.approx(0.1, rel=0.25)
    assert none.scene.frame.tolerances == WHOLE
    exact = none.scene.setup.true_frame.view("pa")
    np.testing.assert_array_equal(exact.xrii.xyz_mm, none.scene.frame.view("pa").xrii.xyz_mm)


@pytest.mark.slow
def test_a_trial_repeats_and_its_sources_add_up():
    trials = [SMALL.trial(np.random.default_rng([1, k])) for k in range(12)]
    assert json.loads(json.dumps(trials[0])) == trials[0]
    assert SMALL.trial(np.random.default_rng([1, 0])) == trials[0]
    squares = {name: np.mean([np.square(t["0.5"][name]) for t in trials]) for name in (*MEANINGS, TOGETHER)}
    # The cross terms of 12 set-ups, some 0.3 of the sum each way.
    assert squares[TOGETHER] == pytest.approx(sum(squares[name] for name in MEANINGS), rel=0.5)
    # A pick of 0.5 px in each of two views is 0.11 mm at the hip; nothing else of the images comes near.
    assert 0.08 < np.sqrt(squares["picks"]) < 0.16
    assert squares["beads"] < 0.1 * squares["picks"]


def test_figures_are_root_mean_squares():
    part = {name: [0.3, 0.4] for name in (*MEANINGS, TOGETHER)} | {f"{s}, stated": [0.1, 0.1] for s in STATED}
    summary = SMALL.summary([{"0.5": part}, {"0.5": part}, {"refused": "why"}])
    by_name = {figure.name: figure for figure in summary.estimates}
    assert by_name["picks 0.5 px: plates"].value == pytest.approx(np.sqrt(0.125))
    assert by_name["set-ups refused"].value == pytest.approx(1 / 3)
    rows = {row[0]: row[1] for row in summary.tables[0].rows}
    assert rows["sum"] == f"{np.sqrt(6 * 0.125):.3f}"
    assert summary.tables[1].rows[0][1] == f"{np.sqrt(3 * 0.125):.3f} / 0.100"
    assert SMALL.summary([{"refused": "why"}]).findings == ("Every set-up was refused.",)
