"""The paper's Table 1 as a study."""

import json

import numpy as np
import pytest

from sightline.studies.table1 import BIPLANE, GAMMA, PLATES, Table1, frame_with, key

SMALL = Table1(
    plates=(BIPLANE, GAMMA), methods=("smooth", "localized", "polynomial 1", "OpenCV 5"), picks_px=(0.1, 1.0)
)


@pytest.fixture(scope="module")
def trial() -> dict:
    return SMALL.trial(np.random.default_rng([3, 0]))


def test_a_trial_is_plain_numbers_and_repeats(trial):
    assert json.loads(json.dumps(trial)) == trial
    assert set(trial) == {key(p, m, sd) for p in SMALL.plates for m in SMALL.methods for sd in SMALL.picks_px}
    one = Table1(plates=(BIPLANE,), methods=("localized",), picks_px=(0.1,))
    first, again, other = (one.trial(np.random.default_rng([3, k])) for k in (0, 0, 1))
    assert first == again != other


def test_errors_are_of_the_size_that_frame_and_method_allow(trial):
    smooth = np.array(trial[key(GAMMA, "smooth", 0.1)])
    affine = np.array(trial[key(GAMMA, "polynomial 1", 0.1)])
    assert smooth.shape == (4,)
    # Plates displaced by 0.05 mm and turned by 0.2 mrad leave 0.25 mm (median of the largest), 0.46 mm (95 %).
    assert 0.01 < smooth.max() < 0.8
    assert affine.max() > 2 * smooth.max()  # distortion of some percent is no affine map
    rougher = np.array(trial[key(GAMMA, "smooth", 1.0)])
    assert (rougher != smooth).all()


def test_plates_stand_where_their_names_say():
    for name, (_, source, xrii) in PLATES.items():
        view = frame_with(name).view("pa")
        np.testing.assert_allclose(view.source.xyz_mm[:, 2], source)
        np.testing.assert_allclose(view.xrii.xyz_mm[:, 2], xrii)
        assert frame_with(name).tolerances is not None


def made_up(largest: np.ndarray, refused: int = 0) -> list[dict]:
    """Trials whose every result has the largest errors given."""
    names = [key(p, m, sd) for p in SMALL.plates for m in SMALL.methods for sd in SMALL.picks_px]
    answers: list[list[float] | None] = [[v / 2, v, v / 4, v / 8] for v in largest]
    return [dict.fromkeys(names, answer) for answer in answers + [None] * refused]


def test_the_papers_figure_is_placed_among_the_largest_errors():
    spread = np.linspace(0.5, 1.5, 400)  # central 90 %: 0.55 to 1.45
    summary = SMALL.summary(made_up(spread, refused=100))
    table = {row[:2]: row[2:] for row in summary.tables[0].rows}
    assert table[BIPLANE, "localized"] == ("0.48", "0.55 to 1.45: below", "0.55 to 1.45: below")
    assert table[GAMMA, "localized"] == ("0.88", "0.55 to 1.45: inside", "0.55 to 1.45: inside")
    assert table[GAMMA, "polynomial 1"] == ("3.40", "0.55 to 1.45: above", "0.55 to 1.45: above")
    assert (BIPLANE, "polynomial 1") not in table  # of which the paper says nothing
    assert any("0.88 mm" in finding and "inside" in finding for finding in summary.findings)
    by_name = {figure.name: figure for figure in summary.estimates}
    refused = by_name[f"{key(GAMMA, 'smooth', 0.1)}: refused"]
    assert refused.value == pytest.approx(0.2)
    assert refused.low < 0.2 < refused.high
    middle = by_name[f"{key(GAMMA, 'smooth', 0.1)}: 50% of the largest of four"]
    assert middle.value == pytest.approx(1.0)
    assert middle.number == 400


def test_few_trials_decide_nothing():
    table = {row[:2]: row[2:] for row in SMALL.summary(made_up(np.array([0.2, 0.3, 0.4]))).tables[0].rows}
    assert table[GAMMA, "localized"][1].endswith("undecided")


def test_a_method_that_never_answers_is_shown_as_refused():
    summary = SMALL.summary(made_up(np.zeros(0), refused=3))
    assert summary.tables[0].rows == ()
    assert all(cell == "refused" for row in summary.tables[1].rows for cell in row[1:3])
    assert summary.plots == ()
