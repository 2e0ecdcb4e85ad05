"""The paper's figure 13 as a study."""

import json
from dataclasses import replace

import numpy as np
import pytest

from sightline.studies import fig13 as study_fig13
from sightline.studies.fig13 import POSES, Figure13, holes_mm
from sightline.twin.xray.distributions import Distortion


def test_poses_are_right_handed_and_turn_about_the_long_axis():
    for axes in POSES.values():
        np.testing.assert_array_equal(np.cross(axes[0], axes[1]), axes[2])
    turn = POSES["lateral"].T @ POSES["pa"]  # takes the PA pose's axes to the lateral one's
    np.testing.assert_array_equal(turn @ [0.0, 1.0, 0.0], [0.0, 1.0, 0.0])
    assert np.trace(turn) == 1.0  # by 90°


def test_holes_fill_the_field_and_the_first_is_its_middle():
    holes = holes_mm(107.5)
    assert (holes[0] == 0.0).all()
    assert len(holes) > 80
    assert np.linalg.norm(holes, axis=1).max() < 105.5


def test_a_trial_says_how_far_the_holes_moved():
    trial = Figure13().trial(np.random.default_rng([7, 0]))
    assert json.loads(json.dumps(trial)) == trial
    moved = np.linalg.norm(np.subtract(trial["lateral"], trial["pa"]), axis=1)
    assert trial["centre"] == pytest.approx(moved[0], abs=2e-3)
    assert trial["largest"] == pytest.approx(moved.max(), abs=2e-3)
    assert trial["shape"] < trial["rms"] <= trial["largest"]


def test_without_magnetic_fields_and_random_parts_both_images_are_the_same(monkeypatch):
    calm = replace(
        Distortion(), earth_ut=(0.0, 0.0), stray_ut=0.0, gradient_ut_per_mm=0.0, beyond_degree5_mm=(1e-9, 2e-9)
    )
    monkeypatch.setattr(study_fig13, "Distortion", lambda: calm)
    assert Figure13().trial(np.random.default_rng([7, 1]))["largest"] < 1e-6


def test_the_summary_states_the_median_and_the_share_inside():
    holes = [[0.0, 0.0], [20.0, 0.0]]
    trials = [
        {"centre": c, "largest": c + 1, "rms": c, "shape": 0.5, "pa": holes, "lateral": [[c, 0.0], [20.0 + c, 0.0]]}
        for c in (1.0, 2.5, 2.9, 3.5, 4.0)
    ]
    summary = Figure13().summary(trials)
    assert summary.estimates[0].value == 0.4
    assert summary.findings[0].startswith("The centre hole moves by 2.9 mm")
