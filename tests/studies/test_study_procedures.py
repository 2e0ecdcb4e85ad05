"""Right plans of every procedure as a study."""

import json

import numpy as np
import pytest

from sightline.rehearsal.patient import AT_HIP, BONE_OF
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


def test_all_patients_are_in_it() -> None:
    assert Procedures().procedures == (*AT_HIP, *BONE_OF)
    assert Procedures().configuration["frames"]["iliosacral-screw"] == "block60"
