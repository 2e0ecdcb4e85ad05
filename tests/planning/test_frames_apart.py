"""Views of two frames are not combined, by whatever computes from two views; a view from a matrix is."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from sightline.calibration import view_from_matrix
from sightline.errors import ReconstructionRefusedError
from sightline.planning import Aids, Circle, locate, matching_curve, plan, reconstruct
from sightline.planning.check.shot import check_shot

from .shots import Wire
from .standin import END_MM, ENTRY_MM, StandInView, stand_in

THIRD, FOURTH, AGAIN = "gamma/03#1111", "gamma/04#2222", "gamma/03#3333"
POINTS_MM = np.stack([ENTRY_MM, END_MM])


def _views(pa: str | None, lateral: str | None) -> list[StandInView]:
    return [replace(stand_in(name, scale=0.05), frame_key=key) for name, key in (("pa", pa), ("lateral", lateral))]


@pytest.mark.parametrize(
    "combine",
    [
        reconstruct,
        lambda views, uv: matching_curve(views[0], uv[0, 0], views[1]),
        lambda views, uv: plan(views, uv[:, 0], uv[:, 1], snapped=True),
        lambda views, uv: locate(views, Aids(head=(Circle.of(uv[0, 0], 60.0), Circle.of(uv[1, 0], 60.0)))),
    ],
    ids=["points", "curve", "plan", "aids"],
)
def test_views_of_two_frames_or_of_two_files_of_one_are_refused(combine: Callable) -> None:
    uv = np.array([view.project(POINTS_MM) for view in _views(THIRD, THIRD)])
    with pytest.raises(ReconstructionRefusedError, match=r"the frames gamma/03 and gamma/04, .* calibrate all views"):
        combine(_views(THIRD, FOURTH), uv)
    with pytest.raises(ReconstructionRefusedError, match="two files of the frame gamma/03"):
        combine(_views(THIRD, AGAIN), uv)
    combine(_views(THIRD, THIRD), uv)


@pytest.mark.parametrize("keys", [(THIRD, None), (None, THIRD)])
def test_a_view_without_a_frame_may_be_combined(keys: tuple[str | None, str | None]) -> None:
    views = _views(*keys)
    uv = np.array([view.project(POINTS_MM) for view in views])
    np.testing.assert_allclose(reconstruct(views, uv).xyz_mm, POINTS_MM, atol=1e-6)
    lens = np.array([[2000.0, 0.0, 512.0], [0.0, 2000.0, 512.0], [0.0, 0.0, 1.0]])
    assert view_from_matrix(lens @ np.column_stack([np.eye(3), [0, 0, 620.0]])).lines_of_sight(uv[0]).frame_key is None


def test_a_check_shot_through_another_frame_is_refused() -> None:
    planned = _views(THIRD, THIRD)
    uv = np.array([view.project(POINTS_MM) for view in planned])
    made = plan(planned, uv[:, 0], uv[:, 1])
    along = np.linspace(0.0, 1.0, 30)[:, None]
    wire = POINTS_MM[0] + along * (POINTS_MM[1] - POINTS_MM[0])
    wires = [Wire(view.project(wire), np.full(30, 0.04), view.project(POINTS_MM[1:])[0], 0.25) for view in planned]
    for checked in (_views(FOURTH, FOURTH), _views(THIRD, FOURTH)):
        with pytest.raises(ReconstructionRefusedError, match="gamma/03 and gamma/04"):
            check_shot(made.to_check(planned), checked, wires)
    assert check_shot(made.to_check(planned), _views(THIRD, THIRD), wires).tip_deviation_mm < 0.1
