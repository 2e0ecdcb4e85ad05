"""Reconstruction: exact on perfect picks, its covariance proved by sampling, and what it refuses."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from sightline.errors import ErrorUnknownError, OutsideRegionError, ReconstructionRefusedError
from sightline.planning import matching_curve, reconstruct, snap
from sightline.planning.points.results import BUDGET

from .standin import StandInView, estimates, stand_in

TARGETS_MM = np.array([[3.7, -11.2, 18.3], [-24.1, 27.9, -6.6]])


def _views(**kwargs: float) -> list[StandInView]:
    return [stand_in("pa", 0.4, **kwargs), stand_in("lateral", -0.2, **kwargs)]


def _seen(views: list[StandInView], xyz_mm: np.ndarray) -> np.ndarray:
    return np.array([view.project(xyz_mm) for view in views])


VIEWS = _views()
UV = _seen(VIEWS, TARGETS_MM)


def test_weighted_beats_nearest_where_the_views_differ_in_quality():
    views = [stand_in("pa", scale=0.05), stand_in("lateral", scale=1.0)]
    uv = _seen(views, TARGETS_MM)
    tight = np.broadcast_to(1e-3 * np.eye(2), (2, 2, 2, 2))
    weighted, nearest = (reconstruct(views, uv, tight, m) for m in ("weighted", "nearest"))
    trace = [np.trace(p.joint_covariance_mm2) for p in (weighted, nearest)]
    assert trace[0] < 0.9 * trace[1]


def test_a_point_does_not_depend_on_the_others():
    rng = np.random.default_rng(4)
    uv = _seen(VIEWS, TARGETS_MM) + rng.normal(0.0, 1.0, (2, 2, 2))
    both, first = reconstruct(VIEWS, uv), reconstruct(VIEWS, uv[:, :1])
    np.testing.assert_allclose(both.xyz_mm[0], first.xyz_mm[0], atol=1e-10)
    np.testing.assert_allclose(both.covariance_mm2[0], first.covariance_mm2[0], rtol=1e-9)


def test_frames_error_is_shared_between_views_of_the_frame():
    shared = reconstruct(VIEWS, UV, method="nearest")
    alone = StandInView.lines_of_sight

    class WithoutFactor(StandInView):
        def lines_of_sight(self, uv_px):
            return replace(alone(self, uv_px), shared={}, frame_key=None)

    fields = {name: getattr(VIEWS[1], name) for name in StandInView.__dataclass_fields__}
    apart = reconstruct([VIEWS[0], WithoutFactor(**fields)], UV, method="nearest")
    np.testing.assert_array_equal(shared.budget_mm2["map"], apart.budget_mm2["map"])
    assert not np.allclose(shared.budget_mm2["frame"], apart.budget_mm2["frame"], rtol=0.05)


def test_errors_of_one_adjustment_are_shared_by_its_views_alone():
    """With "map" an error of both views the points' covariance changes, by exactly the cross-covariance of the two."""

    class Adjusted(StandInView):
        adjustment = "first"

        def lines_of_sight(self, uv_px):
            lines = StandInView.lines_of_sight(self, uv_px)
            by_map = self.response(uv_px) @ self.factors["map"]
            return replace(lines, shared={**lines.shared, "map": by_map}, adjustment=self.adjustment)

    class AdjustedLater(Adjusted):
        adjustment = "second"

    def budget(*kinds):
        views = [kind(**vars(view)) for kind, view in zip(kinds, _views(), strict=True)]
        return reconstruct(views, UV, method="nearest").budget_mm2

    alone, together, apart = (
        budget(StandInView, StandInView),
        budget(Adjusted, Adjusted),
        budget(Adjusted, AdjustedLater),
    )
    for source in BUDGET:
        np.testing.assert_array_equal(apart[source], alone[source])
        assert np.array_equal(together[source], alone[source]) == (source != "map")


def test_snapped_pick_is_one_number():
    """A snapped pick says nothing across its curve: the point stays on the PA line, and its covariance is right."""
    truth = _seen(VIEWS, TARGETS_MM[:1])
    rng = np.random.default_rng(7)
    sd, squares, draws = 0.5, [], 60
    for _ in range(draws):
        estimated = estimates(VIEWS, rng)
        clicks = truth[:, 0] + rng.normal(0.0, sd, (2, 2))
        pick = snap(matching_curve(estimated[0], clicks[0], estimated[1]), clicks[1], sd)
        uv = np.array([clicks[0], pick.uv_px])[:, None]
        covariance = np.array([sd**2 * np.eye(2), pick.covariance_px2])[:, None]
        points = reconstruct(estimated, uv, covariance, across_px=np.array([np.zeros(2), pick.across_px])[:, None])
        line = estimated[0].lines_of_sight(uv[0])
        off_line = np.cross(points.xyz_mm - line.focal_point_mm, line.directions)
        assert np.linalg.norm(off_line) < 0.02
        error = points.xyz_mm[0] - TARGETS_MM[0]
        squares.append(error @ np.linalg.solve(points.covariance_mm2[0], error))
        if len(squares) == 1:
            assert not points.gap_tested[0]
            assert points.gap_sigma[0] is np.ma.masked
            free = reconstruct(estimated, uv, np.full((2, 1, 1, 1), sd**2) * np.eye(2))
            excess = points.covariance_mm2[0] - free.covariance_mm2[0]
            assert np.linalg.eigvalsh(excess).min() > -1e-4
            assert np.linalg.eigvalsh(excess).max() > 1e-3
    for probability in (0.5, 0.95):
        inside = np.mean(np.array(squares) < chi2.ppf(probability, 3))
        assert inside == pytest.approx(probability, abs=4 * np.sqrt(probability * (1 - probability) / draws))


def test_unknown_error_stays_unknown():
    views = [_views()[0], replace(_views()[1], factors=None)]
    points = reconstruct(views, _seen(views, TARGETS_MM))
    np.testing.assert_allclose(points.xyz_mm, TARGETS_MM, atol=1e-8)
    assert points.method == "nearest"
    assert points.joint_covariance_mm2 is None
    assert points.budget_mm2 is None
    assert points.gap_sigma is None
    with pytest.raises(ErrorUnknownError, match="unknown"):
        _ = points.covariance_mm2


def test_nearly_parallel_lines_are_refused_with_their_angle():
    pa = stand_in("pa")
    moved = replace(pa, name="again", focal_point_mm=pa.focal_point_mm + np.array([20.0, 0.0, 0.0]))
    with pytest.raises(ReconstructionRefusedError, match=r"parallel \(1\.\d°"):
        reconstruct([pa, moved], _seen([pa, moved], TARGETS_MM))


def test_points_behind_a_source_are_refused():
    uv = _seen(VIEWS, TARGETS_MM[:1])
    turned = replace(VIEWS[1], focal_point_mm=np.array([100.0, 2.0, 1.0]))
    with pytest.raises(ReconstructionRefusedError, match="behind"):
        reconstruct([VIEWS[0], turned], uv)


def test_pixels_outside_the_region_are_refused():
    uv = UV.copy()
    uv[1, 0] = (1023.0, 1023.0)
    with pytest.raises(OutsideRegionError, match="lateral"):
        reconstruct(VIEWS, uv)
