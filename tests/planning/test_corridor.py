"""The corridor of the wire in an image, by sampling; and the shares of its error's sources."""

from dataclasses import replace

import numpy as np
import pytest

from sightline.errors import ErrorUnknownError, OutsideRegionError
from sightline.planning import Trajectory, corridor, error_shares, error_shares_of, reconstruct
from sightline.planning.points.results import BUDGET

from .standin import END_MM, ENTRY_MM, StandInView, pair, wire_px

VIEWS = pair(0.5)


def _trajectory(views: list[StandInView]) -> Trajectory:
    return Trajectory(reconstruct(views, wire_px(views)))


@pytest.mark.parametrize("which", [0, 1])
def test_the_middle_is_the_wires_image_and_its_width_is_the_wires(which):
    trajectory = _trajectory(VIEWS)
    made = corridor(VIEWS[which], trajectory, wire_mm=2.5, beyond_mm=4.0)
    assert made.along_mm[0] == 0.0
    assert made.along_mm[-1] == pytest.approx(trajectory.length_mm + 4.0)
    at = trajectory.entry_mm + made.along_mm[:, None] * trajectory.direction
    np.testing.assert_allclose(made.uv_px, VIEWS[which].project(at), atol=1e-9)
    # A round wire's outline: the rays that touch it.
    ray = at - VIEWS[which].focal_point_mm
    side = np.cross(ray, trajectory.direction)
    edge = VIEWS[which].project(at + 1.25 * side / np.linalg.norm(side, axis=1, keepdims=True)) - made.uv_px
    np.testing.assert_allclose(np.abs(np.sum(edge * made.across_px, axis=1)), made.wire_half_px, rtol=3e-3)


@pytest.mark.parametrize("which", [0, 1])
def test_the_wire_runs_within_the_corridor_95_times_in_a_hundred(which):
    views, rng, draws = pair(0.5), np.random.default_rng(31), 400
    trajectory = _trajectory(views)
    made = corridor(views[which], trajectory, beyond_mm=10.0)
    ends = rng.multivariate_normal(np.r_[ENTRY_MM, END_MM], trajectory.covariance_mm2, draws)
    share = (made.along_mm / trajectory.length_mm)[None, :, None]
    drilled = (1 - share) * ends[:, None, :3] + share * ends[:, None, 3:]
    seen = views[which].project(drilled.reshape(-1, 3)).reshape(draws, -1, 2)
    beside = np.abs(np.einsum("nsk,sk->ns", seen - made.uv_px, made.across_px))
    inside = (beside < made.half_95_px).mean(axis=0)
    np.testing.assert_allclose(inside, 0.95, atol=4 * np.sqrt(0.95 * 0.05 / draws))


def test_only_what_the_view_sees_is_drawn():
    trajectory = _trajectory(VIEWS)
    made = corridor(VIEWS[0], trajectory, beyond_mm=60.0)
    step = made.along_mm[1]
    assert made.along_mm[-1] < trajectory.length_mm + 60.0 - step
    ahead = trajectory.entry_mm + (made.along_mm[-1] + step) * trajectory.direction
    with pytest.raises(OutsideRegionError):
        VIEWS[0].project(ahead[None])
    aside = replace(VIEWS[0], focal_point_mm=VIEWS[0].focal_point_mm + np.array([0.0, 3000.0, 0.0]))
    with pytest.raises(OutsideRegionError, match="no part of the plan"):
        corridor(aside, trajectory)


def test_an_unknown_error_has_no_corridor_and_no_shares():
    trajectory = _trajectory([VIEWS[0], replace(VIEWS[1], factors=None)])
    assert corridor(VIEWS[0], trajectory).half_95_px is None
    with pytest.raises(ErrorUnknownError):
        error_shares(trajectory)


def test_shares_add_up_and_are_those_of_the_budget():
    trajectory = _trajectory(pair(0.5))
    shares = error_shares(trajectory)
    assert tuple(shares) == ("entry", "end", "direction")
    for name, key, scale in (
        ("entry", "entry_mm", 1.0),
        ("end", "end_mm", 1.0),
        ("direction", "direction_rad", 57.29578),
    ):
        rms = {source: one[key] * scale for source, one in trajectory.budget_rms().items()}
        assert tuple(shares[name].percent) == BUDGET
        assert sum(shares[name].percent.values()) == pytest.approx(100.0)
        assert shares[name].rms == pytest.approx(np.sqrt(sum(r**2 for r in rms.values())), rel=1e-6)
        for source in BUDGET:
            assert shares[name].percent[source] == pytest.approx(100 * (rms[source] / shares[name].rms) ** 2, rel=1e-5)
    assert (shares["entry"].unit, shares["direction"].unit) == ("mm", "°")


def test_a_robot_takes_its_share():
    trajectory = _trajectory(pair(0.5))
    plain = error_shares(trajectory)["end"]
    robot = plain.rms**2 / 3 * np.eye(6)
    shared = error_shares(trajectory, robot)["end"]
    assert shared.percent["robot"] == pytest.approx(50.0)
    assert shared.rms == pytest.approx(np.sqrt(2) * plain.rms)
    named = error_shares(trajectory, {"skiving": robot, "hand-eye": 2 * robot})["end"]
    assert named.percent["hand-eye"] == pytest.approx(50.0)
    turn = np.kron(np.eye(2), np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]))
    ends = np.stack([ENTRY_MM, END_MM]) @ turn[:3, :3].T
    budget = {s: turn @ c @ turn.T for s, c in trajectory.points.budget_mm2.items()}
    moved = error_shares_of(ends, budget)
    for name, share in error_shares(trajectory).items():
        assert moved[name].percent == pytest.approx(share.percent)
