"""The bound as a study."""

import json

import numpy as np
import pytest

from sightline.studies.study_bound import BOUND, KNOWN, AgainstBound, key

SMALL = AgainstBound(methods=("smooth", "localized"), frames=("frame exact",), picks_px=(0.1, 1.0))


@pytest.mark.slow
def test_a_trial_has_both_bounds_and_the_errors():
    trial = SMALL.trial(np.random.default_rng([4, 0]))
    assert json.loads(json.dumps(trial)) == trial
    for sd in SMALL.picks_px:
        part = trial[key("frame exact", sd)]
        assert (np.array(part[KNOWN]) < np.array(part[BOUND])).all()
        assert len(part["smooth"]) == 4
    near, far = (np.array(trial[key("frame exact", sd)][BOUND]) for sd in SMALL.picks_px)
    # 1 px is 0.13 to 0.15 mm at the hip; three coordinates from four such numbers.
    assert ((far > 0.15) & (far < 0.35)).all()
    assert (near < far / 3).all()


def test_the_figure_is_the_root_of_the_mean_square_ratio():
    name = key("frame exact", 0.1)
    parts = [
        {BOUND: [0.1, 0.2, 0.1, 0.2], KNOWN: [0.05, 0.1, 0.05, 0.1], "smooth": [0.1, 0.2, 0.3, 0.2], "localized": None},
        {BOUND: [0.1, 0.1, 0.1, 0.1], KNOWN: [0.05] * 4, "smooth": [0.2, 0.1, 0.1, 0.1], "localized": [0.3] * 4},
    ]
    summary = AgainstBound(methods=("smooth", "localized"), frames=("frame exact",), picks_px=(0.1,)).summary(
        [{name: part} for part in parts]
    )
    by_name = {figure.name: figure for figure in summary.estimates}
    ratio = by_name[f"{name}: smooth, error over bound"]
    assert ratio.value == pytest.approx(np.sqrt((1 + 1 + 9 + 1 + 4 + 1 + 1 + 1) / 8))
    assert ratio.low < ratio.value < ratio.high
    assert by_name[f"{name}: localized, error over bound"].value == pytest.approx(3.0)
    assert by_name[f"{name}: {KNOWN}, error over bound"].value == pytest.approx(0.5)
    assert by_name[f"{name}: localized refused"].value == 0.5
