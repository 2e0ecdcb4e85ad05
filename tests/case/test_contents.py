"""What was asked of a plan or a check shot, written as JSON and asked again."""

import json

import numpy as np
import pytest

from sightline.case.canonical import canonical
from sightline.case.contents import CheckRequest, PlanRequest
from sightline.planning.check.shot import Landmarks


@pytest.mark.parametrize("landmarks", [np.zeros((2, 0, 2)), None, np.array([[[400.5, 500.25]], [[450.0, 520.5]]])])
def test_a_plan_is_asked_for_again_with_and_without_landmarks(report, truth, landmarks: np.ndarray | None) -> None:
    """In JSON an array without landmarks is two empty lists."""
    asked = PlanRequest(truth.uv_px[:, 0], truth.uv_px[:, 1], 0.5, [True, False], landmarks)
    again = PlanRequest.of(json.loads(canonical(asked)))
    then, now = (one.plan(report.images) for one in (asked, again))
    assert now.trajectory.document() == then.trajectory.document()
    assert now.landmarks_document() == then.landmarks_document()


@pytest.mark.parametrize("count", [0, 3])
def test_a_check_shot_is_asked_for_again(count: int) -> None:
    uv_px = np.random.default_rng(1).uniform(0, 1000, (2, 2, count, 2))
    again = CheckRequest.of(json.loads(canonical(CheckRequest(3.2, Landmarks(*uv_px)))))
    assert again.wire_mm == 3.2
    np.testing.assert_array_equal([again.landmarks.planned_uv_px, again.landmarks.checked_uv_px], uv_px)
