"""Three views and more: covariances proved by sampling, points that a view misses, small angles, what is refused."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2, norm

import sightline as sl
from sightline.calibration import view_from_matrix
from sightline.common.checks import failed
from sightline.common.geometry.lines import meeting_point
from sightline.errors import ReconstructionRefusedError, UnusableInputError
from sightline.planning import kind, matching_curve, plan, reconstruct
from sightline.planning.points.results import BUDGET, SpacePoints

from .standin import END_MM, ENTRY_MM, StandInView, estimates, stand_in, turned

TARGETS_MM = np.array([[3.7, -11.2, 18.3], [-24.1, 27.9, -6.6], [11.8, 7.3, -14.2], [-8.6, -19.4, 5.9]])
# Which view shows which point: all of them the first two, two of them each of the others.
SEEN = np.array([[1, 1, 1, 0], [1, 1, 0, 1], [1, 1, 1, 1]], dtype=bool)
PICK_PX2 = np.array([[0.25, 0.05], [0.05, 0.16]])


def _views(scale: float = 1.0, degrees: float = 40.0) -> list[StandInView]:
    pa = stand_in("pa", 0.4, scale)
    oblique = turned(turned(stand_in("pa", 0.1, scale, seed=9), "y", degrees, ""), "x", 13.0, "oblique")
    return [pa, stand_in("lateral", -0.2, scale), oblique]


def _picks(views: list[StandInView], xyz_mm: np.ndarray, seen: np.ndarray) -> np.ndarray:
    uv = np.array([view.project(xyz_mm) for view in views])
    return np.where(seen[..., None], uv, np.nan)


VIEWS = _views()


@pytest.mark.parametrize(
    ("method", "count"),
    [
        ("weighted", 3),
        ("nearest", 2),
        pytest.param("weighted", 2, marks=pytest.mark.slow),
        pytest.param("nearest", 3, marks=pytest.mark.slow),
    ],
)
def test_the_covariance_of_two_and_three_views_by_sampling(method, count):
    views, draws = _views()[:count], 200
    seen = SEEN if count == 3 else np.ones((2, 4), dtype=bool)
    covariance = np.broadcast_to(PICK_PX2, (count, 4, 2, 2))
    truth, half = _picks(views, TARGETS_MM, seen), np.linalg.cholesky(PICK_PX2)
    predicted = reconstruct(views, truth, covariance, method)
    rng = np.random.default_rng(6)
    errors, sigmas, squares, shifts = [], [], [], []
    for _ in range(draws):
        picks = truth + rng.standard_normal(truth.shape) @ half.T
        points = reconstruct(estimates(views, rng), picks, covariance, method)
        errors.append((points.xyz_mm - TARGETS_MM).ravel())
        sigmas.append(points.gap_sigma)
        squares.append(points.gap_chi2)
        shifts.append(points.movement.chi2 if count == 3 else (points.shift_mm / predicted.shift_sd_mm) ** 2)
    whitened = np.linalg.solve(np.linalg.cholesky(predicted.joint_covariance_mm2), np.transpose(errors))
    # The sample covariance scatters by sqrt(2 / draws) on the diagonal; 4.5 of these.
    np.testing.assert_allclose(np.cov(whitened), np.eye(12), atol=4.5 * np.sqrt(2 / draws))
    # Whatever its degrees of freedom, the gap of each point is inside 1 and 1.96 s.d. as often as a normal number.
    for limit in (1.0, 1.96):
        share = 2 * norm.cdf(limit) - 1
        inside = (np.array(sigmas) < limit).mean(axis=0)
        np.testing.assert_allclose(inside, share, atol=4.5 * np.sqrt(share * (1 - share) / draws))
    if count == 3:
        assert (predicted.movement.redundancy, predicted.movement.freedom) == (3 + 3 + 1 + 1, 3)
    for values, freedom in ((squares, 8 if count == 3 else 4), (shifts, 3 if count == 3 else 1)):
        for share in (0.5, 0.95):
            inside = np.mean(np.array(values) < chi2.ppf(share, freedom))
            assert inside == pytest.approx(share, abs=4.5 * np.sqrt(share * (1 - share) / draws))


@pytest.mark.parametrize("method", ["weighted", "nearest"])
def test_perfect_picks_give_the_points_though_views_miss_some(method):
    picks = _picks(VIEWS, TARGETS_MM, SEEN)
    points = reconstruct(VIEWS, picks, method=method)
    np.testing.assert_allclose(points.xyz_mm, TARGETS_MM, atol=1e-7)
    assert not failed(points.checks)
    stated = reconstruct(VIEWS, picks, np.full((3, 4, 1, 1), 0.25) * np.eye(2), method)  # a careful click's
    np.testing.assert_array_equal(points.joint_covariance_mm2, stated.joint_covariance_mm2)
    assert tuple(points.budget_mm2) == BUDGET
    np.testing.assert_allclose(sum(points.budget_mm2.values()), points.joint_covariance_mm2, rtol=1e-12, atol=1e-15)
    assert all(np.linalg.eigvalsh(share).min() > -1e-12 for share in points.budget_mm2.values())


def test_a_point_that_two_views_show_is_the_point_of_these_two():
    """The third view changes neither the point nor its error nor its gap."""
    views, seen = _views(), np.array([[1, 1], [1, 1], [1, 0]], dtype=bool)
    uv = _picks(views, TARGETS_MM[:2], seen) + np.random.default_rng(3).normal(0.0, 0.7, (3, 2, 2))
    both, pair = reconstruct(views, uv), reconstruct(views[:2], uv[:2])
    np.testing.assert_allclose(both.xyz_mm[1], pair.xyz_mm[1], atol=1e-12)
    np.testing.assert_allclose(both.covariance_mm2[1], pair.covariance_mm2[1], rtol=1e-10)
    assert both.gap_mm[1] == pytest.approx(pair.gap_mm[1])
    assert both.gap_sigma[1] == pytest.approx(pair.gap_sigma[1])
    assert np.linalg.norm(both.xyz_mm[0] - pair.xyz_mm[0]) > 1e-3
    # A third view makes a point more certain in every direction but that of its beam.
    exact = [reconstruct(views[:count], _picks(views, TARGETS_MM[:2], seen)[:count]) for count in (2, 3)]
    gained = np.linalg.eigvalsh(exact[0].covariance_mm2[0] - exact[1].covariance_mm2[0])
    assert gained[0] > -1e-12
    assert gained[1] > 0.01


def test_the_nearest_point_of_three_lines():
    uv = _picks(VIEWS, TARGETS_MM[:1], SEEN[:, :1]) + np.random.default_rng(4).normal(0.0, 2.0, (3, 1, 2))
    lines = [view.lines_of_sight(one) for view, one in zip(VIEWS, uv, strict=True)]
    expected = meeting_point([one.focal_point_mm for one in lines], np.concatenate([one.directions for one in lines]))
    # Gauss-Newton with the distances' weights held: off by the residuals, 0.5 mm, times their share of the distance.
    np.testing.assert_allclose(reconstruct(VIEWS, uv, method="nearest").xyz_mm[0], expected, atol=2e-3)


def test_views_of_one_direction_need_a_third_from_another():
    """PA and a view 4° from it determine no point; with the lateral view both count."""
    pa, lateral, _ = _views()
    beside = turned(stand_in("pa", 0.2, seed=7), "y", 4.0, "beside")
    uv = _picks([pa, beside, lateral], TARGETS_MM, np.ones((3, 4), dtype=bool))
    with pytest.raises(ReconstructionRefusedError, match=r"parallel \([34]\.\d°"):
        reconstruct([pa, beside], uv[:2])
    three, two = reconstruct([pa, beside, lateral], uv), reconstruct([pa, lateral], uv[[0, 2]])
    np.testing.assert_allclose(three.xyz_mm, TARGETS_MM, atol=1e-7)
    assert (three.error_95_mm < two.error_95_mm).all()
    missed = uv.copy()
    missed[2, 1] = np.nan  # only the two parallel views show this point
    with pytest.raises(ReconstructionRefusedError, match="parallel"):
        reconstruct([pa, beside, lateral], missed)


def test_a_wrong_pick_in_the_third_view_fails_its_points_gap_alone():
    views = _views(0.3)
    uv = _picks(views, TARGETS_MM, SEEN)
    uv[2, 1] += (14.0, -9.0)
    points = reconstruct(views, uv)
    assert points.gap_failed.tolist() == [False, True, False, False]
    assert np.isnan(points.error_95_mm).tolist() == [False, True, False, False]


def test_a_snapped_pick_of_three_is_one_number():
    """As in the limit of a huge variance across the curve, and with one redundant residual less."""
    views, across = _views(), np.zeros((3, 2, 2))
    uv = _picks(views, TARGETS_MM[:2], np.ones((3, 2), dtype=bool)) + 0.3
    across[1, 0] = 0.6, 0.8
    spread = np.broadcast_to(0.25 * np.eye(2), (3, 2, 2, 2)).copy()
    exact = reconstruct(views, uv, spread, across_px=across)
    spread[1, 0] += 1e6 * np.outer(across[1, 0], across[1, 0])
    huge = reconstruct(views, uv, spread)
    np.testing.assert_allclose(exact.xyz_mm, huge.xyz_mm, atol=1e-4)
    np.testing.assert_allclose(exact.covariance_mm2, huge.covariance_mm2, rtol=1e-4, atol=1e-6)
    assert exact.movement.redundancy == huge.movement.redundancy - 1
    assert exact.gap_chi2 == pytest.approx(huge.gap_chi2, rel=1e-3)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"uv_px": np.full((2, 4, 2), 512.0)}, r"give \(3, N, 2\)"),
        ({"uv_px": np.full((4, 3, 2), 512.0)}, r"give \(3, N, 2\)"),
        ({"uv_px": np.where(SEEN[[0, 0, 0], :, None], [512.0, 512.0], np.nan)}, "point 4 has finite picks in 0 views"),
        ({"uv_px": np.full((3, 4, 2), np.inf)}, "finite"),
        ({"uv_px": np.full((3, 4, 2), (np.nan, 512.0))}, "finite"),
        ({"uv_px": {"pa": np.zeros((4, 2)), "lateral": np.zeros((4, 2))}}, "an entry for each view"),
        (
            {"uv_px": {"pa": np.zeros((4, 2)), "lateral": np.zeros((4, 2)), "oblique": np.zeros((3, 2))}},
            "the same points in each",
        ),
        ({"uv_covariance_px2": np.ones((2, 4, 2, 2))}, "covariances"),
        ({"across_px": np.ones((3, 4, 2))}, "snapped in two"),
        ({"uv_px": np.zeros((3, 0, 2))}, "shape"),
        ({"uv_covariance_px2": np.broadcast_to(-np.eye(2), (3, 4, 2, 2))}, "symmetric and positive"),
        ({"method": "midpoint"}, "weighted"),
    ],
)
def test_bad_arguments_are_refused(change, message):
    good = {"uv_px": _picks(VIEWS, TARGETS_MM, SEEN)}
    assert np.isfinite(reconstruct(VIEWS, **good).xyz_mm).all()
    with pytest.raises(UnusableInputError, match=message):
        reconstruct(VIEWS, **(good | change))


def test_one_view_is_not_enough_and_none_counts_twice():
    uv = _picks(VIEWS, TARGETS_MM, np.ones((3, 4), dtype=bool))
    with pytest.raises(UnusableInputError, match="two or more"):
        reconstruct(VIEWS[:1], uv[:1])
    for again in (VIEWS[0], replace(VIEWS[0]), replace(VIEWS[0], name="copy")):
        with pytest.raises(ReconstructionRefusedError, match="twice"):
            reconstruct([*VIEWS[:2], again], uv[[0, 1, 0]])


def _planned(views: list[StandInView], uv: np.ndarray, **given: object) -> SpacePoints:
    return plan(views, uv[:, 0], uv[:, 1], landmarks_uv_px=uv[:, 2:], procedure=kind("free-wire"), **given)


def test_a_plan_takes_a_third_view_and_may_lack_its_picks():
    views = _views(0.3)
    uv = _picks(views, TARGETS_MM, np.ones((3, 4), dtype=bool)) + np.random.default_rng(5).normal(0.0, 0.3, (3, 4, 2))
    made = _planned(views, uv)
    assert (made.entry_curve.from_view, made.entry_curve.to_view) == ("pa", "lateral")
    np.testing.assert_array_equal(
        made.seen.xyz_mm, reconstruct(views, uv, np.full((3, 4, 1, 1), 0.25) * np.eye(2)).xyz_mm
    )
    uv[2, 0] = np.nan
    lacking = _planned(views, uv)
    assert lacking.trajectory.entry_error_95_mm > made.trajectory.entry_error_95_mm
    assert lacking.trajectory.end_error_95_mm == pytest.approx(made.trajectory.end_error_95_mm)
    assert len(lacking.plot()) == 3
    uv[1, 0] = np.nan
    with pytest.raises(UnusableInputError, match="finite in the first two"):
        _planned(views, uv)


def test_a_plan_on_three_views_is_saved_with_the_picks_that_it_lacks(tmp_path):
    lens = np.array([[2000.0, 0.0, 512.0], [0.0, 2000.0, 512.0], [0.0, 0.0, 1.0]])
    views = []
    for name, turns in (("pa", (0.0, 0.0)), ("lateral", (90.0, 0.0)), ("oblique", (40.0, 15.0))):
        rotation = Rotation.from_euler("yx", turns, degrees=True).as_matrix()
        views.append(view_from_matrix(lens @ np.column_stack([rotation, [0.0, 0.0, 620.0]]), 1e-8 * np.eye(12), name))
    uv = _picks(views, TARGETS_MM, SEEN) + np.random.default_rng(7).normal(0.0, 0.3, (3, 4, 2))
    made = _planned(views, uv)
    sl.save(made, tmp_path / "plan.json")
    back = sl.load(tmp_path / "plan.json")
    np.testing.assert_allclose(back.seen.joint_covariance_mm2, made.seen.joint_covariance_mm2, rtol=1e-6)
    np.testing.assert_array_equal(back.arguments["landmarks_uv_px"], uv[:, 2:])
    sl.save(made.seen, tmp_path / "points.json")
    kept = sl.load(tmp_path / "points.json").movement
    assert (kept.chi2, kept.freedom, kept.redundancy) == (made.seen.movement.chi2, 3, 8)
    assert kept.shown.tolist() == [3, 3, 4]
    np.testing.assert_array_equal(kept.noticed_mm, made.seen.movement.noticed_mm)


# The bone shifts once, by 2 mm. Errors of the views about those of a block: 0.1 mm rms at the target.
ENDS_MM = np.stack([ENTRY_MM, END_MM])
MARKS_MM = np.array([[-20.0, -12.0, 9.0], [14.0, 22.0, -11.0], [8.0, -19.0, 16.0]])
SHIFT_MM, OFF_MM = 2.0, 1.0


def _wrong_go(views: list[StandInView], shifts_mm: np.ndarray) -> np.ndarray:
    """For shifts (n, 3) before the last image: whether the plan says GO though it is off by over 1 mm at that pose."""
    rng, points = np.random.default_rng(12), np.concatenate([ENDS_MM, MARKS_MM])
    curve = matching_curve(views[0], views[0].project(ENDS_MM[:1])[0], views[1])  # free picks do not depend on it
    wrong = np.zeros(len(shifts_mm), dtype=bool)
    for k, shift in enumerate(shifts_mm):
        images = [view.project(points + (shift if i >= 2 else 0.0)) for i, view in enumerate(views)]
        uv = np.array(images) + rng.normal(0.0, 0.5, (len(views), len(points), 2))
        made = _planned(estimates(views, rng), uv, curve=lambda *_: curve)
        off = np.linalg.norm(made.trajectory.points.xyz_mm - ENDS_MM - shift, axis=1).max()
        wrong[k] = made.verdict.go and off > OFF_MM
    return wrong


def test_of_a_shift_before_the_last_image_the_part_along_its_beam_is_not_shown():
    views = _views(0.15, 45.0)
    uv = np.array([view.project(np.concatenate([ENDS_MM, MARKS_MM])) for view in views])
    made = _planned(views, uv)
    beam = views[2].lines_of_sight(views[2].project(np.zeros((1, 3)))).directions[0]
    information = made.seen.movement.information[-1]
    assert abs(np.linalg.eigh(information)[1][:, 0] @ beam) > 0.999
    first, last = made.seen.movement.noticed_mm
    assert np.isinf(last[2])
    said = next(check.sentence for check in made.verdict.checks if check.name == "movement")
    assert f"After the first image (pa) one of {first[1]:.1f} mm across its beam" in said
    assert f"before the last image (oblique) one of {last[1]:.1f} mm across its beam" in said
    assert "along the beam of the last image, before that image, would not be detected" in said
    across = np.random.default_rng(13).normal(size=(20, 3)) @ (np.eye(3) - np.outer(beam, beam))
    across *= SHIFT_MM / np.linalg.norm(across, axis=1, keepdims=True)
    assert last[1] < SHIFT_MM / 2
    assert not _wrong_go(views, across).any()
    assert _wrong_go(views, np.repeat([SHIFT_MM * beam], 10, axis=0)).mean() > 0.7


def test_landmarks_that_the_last_image_does_not_show_leave_the_plan_incomplete():
    views = _views(0.15, 45.0)
    uv = np.array([view.project(np.concatenate([ENDS_MM, MARKS_MM])) for view in views])
    uv[2, 1:] = np.nan
    made = _planned(views, uv)
    assert made.verdict.state == "incomplete"
    assert [check.name for check in made.verdict.unmade] == ["movement"]
    assert "pick 2 landmarks freely in all of them" in made.verdict.missing[0]
