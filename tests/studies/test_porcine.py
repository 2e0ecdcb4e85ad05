"""The porcine study: images alone lead to a plan, and plans are judged by what they are."""

import json

import numpy as np
import pytest

from sightline.errors import LabellingRefusedError
from sightline.studies.rendered import porcine as study_porcine
from sightline.studies.rendered.porcine import Porcine
from sightline.studies.scenes import PHANTOMS

PIG = Porcine(phantoms=("porcine",))


def test_wires_run_through_the_origin_and_a_pigs_is_shorter():
    lengths = {name: np.linalg.norm(one.wire_mm[1] - one.wire_mm[0]) for name, one in PHANTOMS.items()}
    assert lengths["porcine"] < lengths["plastic, bored"]
    for one in PHANTOMS.values():
        np.testing.assert_allclose(one.wire_mm.mean(axis=0), 0.0, atol=1e-9)


@pytest.mark.slow
def test_a_wire_is_planned_from_images_of_a_pigs_femur():
    trial = PIG.trial(np.random.default_rng([2, 0]))
    assert json.loads(json.dumps(trial)) == trial
    pig = trial["porcine"]
    assert pig["ended"] == "GO" or pig["why"]
    assert min(pig["beads"]) > 70  # of 113
    assert max(pig["error_mm"]) < 1.5  # 0.34 mm rms for picks of 1 px and the frame's tolerances
    assert pig["direction_deg"] < 1.5


def test_a_refused_image_ends_the_trial_as_refused(monkeypatch):
    def refuse(*_):
        raise LabellingRefusedError("none")

    monkeypatch.setattr(study_porcine, "calibrated_images", refuse)
    outcome = PIG.trial(np.random.default_rng([2, 0]))["porcine"]
    assert outcome == {"ended": "refused", "why": "LabellingRefusedError"}


def test_the_summary_counts_endings_and_what_is_within_the_papers_figures():
    def outcome(ended: str, entry: float, direction: float = 0.3) -> dict:
        errors = {"error_mm": [entry, 0.3], "stated_mm": [0.3, 0.3], "direction_deg": direction}
        return {"ended": ended, "why": "", "beads": [100, 104], **errors}

    refused = {"ended": "refused", "why": "LabellingRefusedError"}
    each = [outcome("GO", 0.3), outcome("GO", 0.3, 0.7), outcome("GO", 1.2), outcome("NO-GO", 3.0), refused]
    summary = PIG.summary([{"porcine": one} for one in each])
    row = summary.tables[0].rows[0]
    assert row[:5] == ("porcine", "1 px", "20%", "20%", "102")
    assert row[5].startswith("0.75 / ")
    assert row[8] == "33%"
    assert PIG.summary([{"porcine": refused}]).findings == ("porcine: every image is refused.",)
