"""Frame design as a study: designs differ by themselves alone, and the recommendation follows from the figures."""

import json
from typing import Any

import numpy as np
import pytest

from sightline.frame import Frame
from sightline.studies.scenes import BEADS_20UM, EXACT, WHOLE, draw_showing
from sightline.studies.study import Values
from sightline.studies.study_frame_design import (
    AS_MADE,
    AS_MEASURED,
    DEFAULT,
    Design,
    FrameDesignStudy,
    bead_sd_px,
    covered_share,
    error_of,
    obstacle,
)
from sightline.studies.study_robustness import WIRE_ENDS_MM
from sightline.twin import SetUp
from sightline.twin.handling import Handling

NEAR = Design(120, 300)
SMALL = FrameDesignStudy(geometries=(DEFAULT, NEAR), tolerances=(), handlings=())


def stand(k: int) -> SetUp:
    return draw_showing(np.random.default_rng([5, k]), Frame.load("gamma"), WIRE_ENDS_MM, frame_errors=False)


def answer(*case: Any) -> Values:
    out = error_of(*case)
    assert out is not None
    return out


def test_the_default_design_is_the_built_in_frame():
    built_in, mine = Frame.load("gamma"), DEFAULT.frame(WHOLE)
    for name, view in built_in.views.items():
        for plate, own in ((view.xrii, mine.view(name).xrii), (view.source, mine.view(name).source)):
            np.testing.assert_array_equal(plate.xyz_mm, own.xyz_mm)


@pytest.mark.parametrize(
    ("design", "why"),
    [
        (DEFAULT, ""),
        (Design(100, 300), "in the thigh"),
        (Design(150, 360), "in the intensifier"),
        (Design(pitch_mm=32), "beyond the field"),
        (Design(pitch_mm=16), "too small for the wire"),
    ],
)
def test_what_does_not_fit_around_a_hip_says_why(design, why):
    assert obstacle(design) == why


def test_smaller_balls_are_noisier_and_hide_less():
    assert bead_sd_px(3.0) == pytest.approx(0.1)
    assert bead_sd_px(2.0) > 0.12
    assert bead_sd_px(4.0) < 0.09
    assert covered_share(Design(ball_mm=2)) == pytest.approx(covered_share(DEFAULT) * 4 / 9)


def test_heat_water_and_drapes_are_errors_that_the_software_is_not_told_of():
    setup = stand(0)
    calm = answer(setup, DEFAULT, EXACT, AS_MEASURED, 3)
    hot = answer(setup, DEFAULT, EXACT, Handling(10.0, 0.01, 20.0), 3)
    assert max(calm["error"]) < 0.08  # beads of 0.1 px and the map leave 0.02 mm rms
    assert max(hot["error"]) > 3 * max(calm["error"])
    assert hot["stated"] == pytest.approx(calm["stated"], rel=0.2)


def test_a_frame_sags_whether_or_not_it_was_measured():
    setup = stand(1)
    calm, laden = (answer(setup, DEFAULT, BEADS_20UM, one, 3) for one in (AS_MEASURED, Handling(drape_n=100.0)))
    assert max(laden["error"]) > max(calm["error"]) + 0.1


def test_a_trial_repeats_and_is_plain():
    trial = SMALL.trial(np.random.default_rng([3, 1]))
    assert json.loads(json.dumps(trial)) == trial
    assert trial == SMALL.trial(np.random.default_rng([3, 1]))
    assert len(trial) == 4


@pytest.mark.parametrize(
    ("error", "recommended"),
    [(0.1, f"Recommended of those that fit: {NEAR.name}"), (0.19, "Recommended: the default frame")],
)
def test_another_frame_is_recommended_only_for_a_clear_gain(error, recommended):
    def outcome(mm: float) -> dict:
        return {"error": [mm, mm], "stated": [mm, mm]}

    names = [f"{design.name}, {made}" for design in (DEFAULT, NEAR) for made in ("as made", "plates and arms measured")]
    trials = [
        {name: outcome((0.2 if DEFAULT.name in name else error) * size) for name in names} for size in (0.9, 1.0, 1.1)
    ]
    summary = SMALL.summary([*trials, {**trials[0], f"{NEAR.name}, as made": None}])
    assert summary.findings[-1].startswith(recommended)
    assert "25% refused" in summary.tables[0].rows[1][1]
    assert AS_MADE in summary.tables[1].rows[0]
