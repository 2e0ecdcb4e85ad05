"""The study of registered bones: images alone lead to a pose, and a result counts every way in which a trial ends."""

import json

import numpy as np
import pytest

from sightline.errors import LabellingRefusedError
from sightline.studies.rendered import register_bone as study_register_bone
from sightline.studies.rendered.register_bone import RegisterBone
from sightline.studies.runs.study import Values

SOLID = RegisterBone(frames=("block60",))


@pytest.mark.slow
def test_a_bone_is_registered_to_the_images_of_its_hip(few_pixels: None) -> None:
    trial = SOLID.trial(np.random.default_rng([2, 1]))
    assert json.loads(json.dumps(trial)) == trial
    pose = trial["block60"]
    assert pose["ended"] == "trusted", pose["why"]
    assert max(pose["error_mm"]) < 0.5  # 0.2 mm is usual; starts are up to 17 mm off
    assert pose["turn_deg"] < 1.0
    assert max(pose["chi2_3"]) < 16.27 / 3  # 99.9 % of three numbers


def test_a_refused_image_ends_the_trial_as_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise LabellingRefusedError("none")

    monkeypatch.setattr(study_register_bone, "specimen", refuse)
    outcome = SOLID.trial(np.random.default_rng([2, 0]))["block60"]
    assert outcome == {"ended": "refused", "why": "LabellingRefusedError"}


def test_the_summary_counts_endings_and_what_is_within_the_stated_error() -> None:
    def outcome(ended: str, entry: float, stated: float) -> Values:
        over = {"over_95": [entry / stated, 0.5], "chi2_3": [4.0, 1.0]}
        return {"ended": ended, "why": "", "error_mm": [entry, 0.2], "turn_deg": 0.3, **over}

    refused = {"ended": "refused", "why": "LabellingRefusedError"}
    each = [outcome("trusted", 0.3, 0.4), outcome("trusted", 2.5, 0.4), outcome("not trusted", 9.0, 0.4), refused]
    summary = SOLID.summary([{"block60": one} for one in each])
    values = [estimate.value or 0.0 for estimate in summary.estimates]
    # no pose, not trusted of those with a pose, then of the trusted: quantiles, coverage, ratio, wrong ones
    np.testing.assert_allclose(values, [0.25, 1 / 3, 0.25, 2.17, 0.3, 0.3, 0.75, 2.5**0.5, 0.5], atol=1e-9)
    assert SOLID.summary([{"block60": refused}]).findings == ("block60, flat panel: no pose is trusted.",)
