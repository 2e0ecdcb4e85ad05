"""Robustness as a study: each disturbance does what it says, and its plans are judged by what came."""

import json

import numpy as np
import pytest

from sightline.studies.study_robustness import LEVELS, UNDISTURBED, WIRE_ENDS_MM, DisturbedSetUp, Robustness, key

MOVED = "patient moved between the views, mm"
SMALL = Robustness(disturbances=(MOVED,))


@pytest.fixture(scope="module")
def case() -> DisturbedSetUp:
    return DisturbedSetUp.drawn(np.random.default_rng([12, 0]))


def test_a_calm_plan_is_go_and_near(case):
    calm = case.planned()
    assert calm["ended"] == "GO"
    assert calm["error_mm"] < 1.5  # plates and arms of the default frame leave 0.7 mm (95 %) at the ends of a wire


def test_too_few_beads_are_refused_or_no_go(case):
    assert case.planned(missing=0.95)["ended"] == "refused"
    assert case.planned(missing=0.8, in_block=True)["ended"] != "GO"


def test_rough_beads_that_are_stated_so_cost_accuracy_alone(case):
    rough = case.planned(bead_px=0.4)
    assert rough["ended"] == "GO"
    assert rough["error_mm"] != case.planned()["error_mm"]


def test_displaced_balls_are_found(case):
    one = case.planned(displaced=(1, 3.0))  # 3 mm among beads known to 0.05 mm: it is left out
    assert one["ended"] == "GO"
    assert one["error_mm"] == pytest.approx(case.planned()["error_mm"], abs=0.1)


def test_movement_is_an_error_of_its_size_and_shows_in_the_gap(case):
    moved = case.planned(moved_mm=40.0)
    assert moved["error_mm"] > 10.0
    assert moved["ended"] == "NO-GO"
    assert "gap" in moved["why"]


def test_landmarks_let_a_snapped_plan_be_go_and_show_movement(case):
    still = case.planned(snapped=True, landmarks=True)
    assert still["ended"] == "GO"
    assert still["error_mm"] < 1.5
    bare = case.planned(snapped=True)
    assert (bare["ended"], bare["why"]) == ("NO-GO", "movement")
    assert bare["error_mm"] == still["error_mm"]
    moved = case.planned(snapped=True, landmarks=True, moved_mm=10.0)
    assert moved["ended"] == "NO-GO"
    assert "movement" in moved["why"]


def test_a_trial_repeats_and_is_plain():
    trial = SMALL.trial(np.random.default_rng([3, 1]))
    assert json.loads(json.dumps(trial)) == trial
    assert list(trial) == [UNDISTURBED, *(key(MOVED, level) for level in LEVELS[MOVED])]
    assert np.linalg.norm(WIRE_ENDS_MM[0] - WIRE_ENDS_MM[1]) == pytest.approx(97.5, abs=0.1)


def test_the_summary_counts_endings_and_wrong_goes():
    def outcome(ended: str, error: float = 0.0, over: bool = False) -> dict:
        return {"ended": ended, "why": "" if ended == "GO" else "gap", "error_mm": error, "over": over}

    names = [UNDISTURBED, *(key(MOVED, level) for level in LEVELS[MOVED])]
    each = [outcome("GO", 0.2), outcome("GO", 1.4, over=True), outcome("NO-GO", 3.0)]
    trials = [dict.fromkeys(names, one) for one in [*each, {"ended": "refused", "why": "CalibrationRefusedError"}]]
    summary = SMALL.summary(trials)
    row = summary.tables[0].rows[0]
    assert row[:4] == (UNDISTURBED, "25.0%", "25.0%", "50.0%")
    assert row[4].startswith("0.80 / ")
    assert row[5:7] == ("25.0%", "50.0%")  # of all set-ups; of the GO
    assert len(summary.plots) == 1
