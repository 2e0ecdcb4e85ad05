"""The paper's figure 8 as a study."""

import json

import numpy as np
import pytest

from sightline.detection import Observations
from sightline.errors import LabellingRefusedError
from sightline.studies import study_fig8
from sightline.studies.study_fig8 import Figure8, shadows


@pytest.fixture(scope="module")
def trial() -> dict:
    return Figure8().trial(np.random.default_rng([8, 0]))


def test_a_registration_image_is_found_and_named(trial):
    assert json.loads(json.dumps(trial)) == trial
    assert trial["wrong"] == 0
    for role in ("xrii", "source"):
        assert 0.8 * trial["shown"][role] < trial["named"][role] <= trial["shown"][role]
    assert np.median(trial["error_px"]) < 0.1  # 0.05 px at the medium dose


@pytest.mark.slow
def test_a_wrong_name_is_counted_as_one(monkeypatch):
    def confused(image, frame, view):
        true = shadows(setup)
        ids = [i for i, one in true.items() if one.whole][:3]
        places = np.array([true[i].uv_px for i in (ids[1], ids[0], ids[2])])
        return Observations("pa", tuple(ids), places)

    rng = np.random.default_rng([8, 1])
    _, setup, _ = Figure8().scene(int(np.random.default_rng([8, 1]).integers(2**32)))
    monkeypatch.setattr(study_fig8, "image_of", lambda *_: None)
    monkeypatch.setattr(study_fig8, "observed", confused)

    out = Figure8().trial(rng)
    assert (out["wrong"], sum(out["named"].values()), out["error_px"]) == (2, 1, [0.0])


@pytest.mark.slow
def test_a_refused_image_is_counted(monkeypatch):
    def refuse(*_):
        raise LabellingRefusedError("none")

    monkeypatch.setattr(study_fig8, "image_of", lambda *_: None)
    monkeypatch.setattr(study_fig8, "observed", refuse)
    assert Figure8().trial(np.random.default_rng(1))["refused"] == "LabellingRefusedError"


@pytest.mark.slow
def test_the_summary_counts_and_shows_the_image(trial):
    summary = Figure8().summary([trial, {**trial, "refused": "LabellingRefusedError"}])
    assert summary.estimates[0].value == 0.5
    assert summary.tables[0].rows[0][1:3] == (str(trial["shown"]["xrii"]), str(trial["named"]["xrii"]))
    assert "data:image/jpeg" in summary.plots[0].svg
