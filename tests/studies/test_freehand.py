"""The simulated operator: what is seen, what is done about it, and when it ends."""

import json

import numpy as np
import pytest

from sightline.frame import Frame
from sightline.studies.scenes import VIEWS, draw_showing
from sightline.studies.study_freehand import (
    GUIDE,
    MAX_ATTEMPTS,
    Freehand,
    PlainEyes,
    across_wire,
    assumed_scale,
    insert,
    key,
    within,
)
from sightline.studies.study_robustness import WIRE_ENDS_MM
from sightline.twin import SetUp

SMALL = Freehand(hands=("steady hand",), matches_mm=(2.0,))


@pytest.fixture(scope="module")
def setup() -> SetUp:
    return draw_showing(np.random.default_rng([6, 0]), Frame.load("gamma"), WIRE_ENDS_MM)


def test_believed_views_are_nearly_the_true_ones_and_know_nothing_along_the_beam(setup):
    for name, beam in zip(VIEWS, np.eye(3)[[2, 0]], strict=True):
        mine = assumed_scale(setup, name, 0.0)
        steps = 5 * np.eye(3)
        true = (setup.views[name].project(steps) - setup.views[name].project(-steps)).T / 10
        assert np.abs(mine @ beam).max() < 1e-9
        across = np.eye(3)[np.abs(beam) < 0.5].T
        assert np.linalg.norm((mine - true) @ across) < 0.2 * np.linalg.norm(true @ across)  # tilts and distortion


def test_plain_eyes_see_an_error_of_the_wire(setup):
    eyes = PlainEyes(setup, 0.0, np.random.default_rng(1))
    off = across_wire(np.array([[3.0, -2.0, 4.0], [-5.0, 1.0, 2.0]]))
    np.testing.assert_allclose(eyes.error_mm(WIRE_ENDS_MM + off), off, atol=1.2)  # readings 0.1 mm, geometry a tenth


def test_a_wrong_match_is_seen_as_an_error_along_the_patient(setup):
    right, wrong = (PlainEyes(setup, match, np.random.default_rng(1)) for match in (0.0, 10.0))
    seen = wrong.error_mm(WIRE_ENDS_MM) - right.error_mm(WIRE_ENDS_MM)
    assert np.abs(seen[:, 1]).min() > 3 * np.abs(seen[:, [0, 2]]).max()


def test_limits_hold_for_what_lies_across_the_wire():
    along = (WIRE_ENDS_MM[1] - WIRE_ENDS_MM[0]) / np.linalg.norm(WIRE_ENDS_MM[1] - WIRE_ENDS_MM[0])
    side = np.cross(along, [0.0, 0.0, 1.0])
    side /= np.linalg.norm(side)
    assert within(np.array([5 * along, 5 * along]))
    assert within(np.array([0.9 * side, 0.9 * side]))
    assert not within(np.array([1.1 * side, 1.1 * side]))
    assert not within(np.array([0 * side, 1.1 * side]))  # 0.65° over 97.5 mm


def test_a_perfect_hand_needs_a_second_attempt_and_a_wild_one_gives_up(setup):
    eyes = PlainEyes(setup, 0.0, np.random.default_rng(2))
    assert insert(eyes, (0.0, 0.0), 1)["attempts"] in (2, 3, 4)
    wild = insert(eyes, (50.0, 20.0), 1)
    assert (wild["attempts"], wild["stopped"]) == (MAX_ATTEMPTS, False)


def test_a_trial_repeats_and_is_plain():
    trial = SMALL.trial(np.random.default_rng([3, 1]))
    assert json.loads(json.dumps(trial)) == trial
    assert trial == SMALL.trial(np.random.default_rng([3, 1]))
    assert trial[GUIDE]["attempts"] == 1
    assert trial[GUIDE]["entry_mm"] < 1.5  # 0.3 mm rms


def test_the_summary_counts_attempts_exposures_and_what_was_right():
    def outcome(attempts: int, entry: float, *, stopped: bool = True) -> dict:
        return {"attempts": attempts, "stopped": stopped, "entry_mm": entry, "direction_deg": 0.3}

    names = (GUIDE, key("plain, match 2 mm", "steady hand"))
    each = [outcome(1, 0.5), outcome(3, 0.8), outcome(3, 1.2), outcome(MAX_ATTEMPTS, 0.1, stopped=False)]
    summary = SMALL.summary([*(dict.fromkeys(names, one) for one in each), {}])
    assert summary.estimates[0].value == pytest.approx(0.2)
    row = summary.tables[0].rows[0]
    assert row[0] == GUIDE
    assert row[1].startswith("3 / ")
    assert row[2:6] == ("8", "25%", "75%", "50%")
