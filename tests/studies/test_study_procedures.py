"""Right plans of every procedure as a study."""

import json

import numpy as np
import pytest

from sightline.rehearsal.patient import AT_HIP, BONES_OF, NAILED
from sightline.studies.study_procedures import Procedures

SMALL = Procedures(("cannulated-hip-screws", "pedicle-screw"))


def test_a_trial_repeats_and_each_wire_is_compared_with_its_own_truth() -> None:
    trial = SMALL.trial(np.random.default_rng([1, 0]))
    assert json.loads(json.dumps(trial)) == trial
    assert SMALL.trial(np.random.default_rng([1, 0])) == trial
    assert {name: len(one["errors"]) for name, one in trial.items()} == {"cannulated-hip-screws": 3, "pedicle-screw": 1}
    for one in trial.values():
        assert one["ended"] == "go", one["why"]
        # Three times the usual error of the frame; the wires lie 13 mm apart.
        assert 0.0 < np.array(one["errors"])[:, :2].max() < 1.5


def test_the_row_of_a_procedure_counts_every_wire() -> None:
    go = {"ended": "go", "why": [], "errors": [[0.1, 0.3, 0.2]], "within": [[True, True, True]]}
    refused = {"ended": "refused", "why": ["SetUpError"]}
    no_go = {"ended": "no-go", "why": ["movement"], "errors": [[0.3, 0.5, 0.4]], "within": [[True, False, False]]}
    pedicle = [go, refused, no_go, go]
    three = go | {"errors": 3 * go["errors"], "within": 3 * go["within"]}
    trials = [{"cannulated-hip-screws": three, "pedicle-screw": one} for one in pedicle]
    summary = SMALL.summary(trials)
    by_name = {one.name: one for one in summary.estimates}
    assert by_name["pedicle-screw: entry, 50%"].value == pytest.approx(0.1)
    assert by_name["pedicle-screw: within the 95 % bounds"].value == pytest.approx(7 / 9)
    assert by_name["pedicle-screw: GO"].value == 0.5
    assert by_name["cannulated-hip-screws: within the 95 % bounds"].number == 4 * 9
    (_, row) = summary.tables[0].rows
    assert row[:4] == ("pedicle-screw", "block60", "4", "0.10 / 0.28")
    assert row[-1] == "SetUpError 1, movement 1"
    assert SMALL.summary([dict.fromkeys(SMALL.procedures, refused)]).findings[0].endswith("every plan is refused.")


@pytest.mark.parametrize("nail_images", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_both_holes_of_a_nail_are_compared_with_their_own_truth(nail_images: bool) -> None:
    """Fails where the holes are exchanged (28 mm apart), where edges are drawn as on a right patient (trials 0 and 1
    have left ones), and where a click in the middle of the lens is taken for both ends of a hole (5 mm off)."""
    nailed = Procedures((NAILED,), nail_images)
    for k in range(1 if nail_images else 3):
        one = nailed.trial(np.random.default_rng([1, k]))[NAILED]
        assert one["ended"] == "go", one
        assert_within_the_drill_s_limits(np.array(one["errors"]))


def assert_within_the_drill_s_limits(errors: np.ndarray) -> None:
    assert errors.shape == (2, 3)
    # The drill's limits: 0.5 mm at both ends and 5.2°, of which the errors of a right plan take a part.
    assert 0.0 < errors[:, :2].max() < 0.5
    assert 0.0 < errors[:, 2].max() < 2.0


def test_all_patients_are_in_it() -> None:
    assert Procedures().procedures == (*AT_HIP, *BONES_OF)
    assert Procedures().configuration["frames"]["iliosacral-screw"] == "block60"
