"""Image-matching curves: on the true line, whatever its direction, with a band that covers."""

from dataclasses import replace

import numpy as np
import pytest

from sightline.errors import OutsideRegionError, UnusableInputError
from sightline.planning import matching_curve, snap

from .standin import CENTRE_PX, LIMIT_PX, StandInView, estimates, stand_in

TARGET_MM = np.array([4.3, -12.6, 9.1])


def _drawn(turn_rad: float = -0.2) -> tuple[StandInView, StandInView, np.ndarray]:
    pa, lateral = stand_in("pa", 0.4), stand_in("lateral", turn_rad)
    return pa, lateral, pa.project(TARGET_MM[None])[0]


@pytest.mark.parametrize("turn_rad", np.linspace(0.0, np.pi, 9))
def test_the_curve_passes_through_the_target_in_any_direction(turn_rad):
    """Vertical too, where a curve v(u) breaks."""
    pa, lateral, uv = _drawn(turn_rad)
    curve = matching_curve(pa, uv, lateral)
    pick = snap(curve, lateral.project(TARGET_MM[None])[0])
    np.testing.assert_allclose(pick.uv_px, lateral.project(TARGET_MM[None])[0], atol=0.02)


def test_the_curve_bends_with_the_distortion():
    pa, lateral, uv = _drawn()
    curve = matching_curve(pa, uv, lateral)
    start, end = curve.uv_px[0], curve.uv_px[-1]
    along = (end - start) / np.linalg.norm(end - start)
    off_chord = (curve.uv_px - start) @ np.array([-along[1], along[0]])
    assert np.abs(off_chord).max() > 1.0
    np.testing.assert_allclose(curve.uv_px, lateral.project(curve.xyz_mm), atol=1e-9)
    steps = np.gradient(curve.uv_px, axis=0)
    steps /= np.linalg.norm(steps, axis=1, keepdims=True)
    np.testing.assert_allclose(np.sum(steps * curve.tangent_px, axis=1), 1.0, atol=1e-5)
    np.testing.assert_allclose(np.sum(curve.across_px * curve.tangent_px, axis=1), 0.0, atol=1e-12)


def test_samples_stand_every_two_millimetres_and_ticks_every_ten():
    pa, lateral, uv = _drawn()
    curve = matching_curve(pa, uv, lateral)
    np.testing.assert_allclose(np.linalg.norm(np.diff(curve.xyz_mm, axis=0), axis=1), 2.0, atol=1e-9)
    np.testing.assert_allclose(np.diff(curve.depth_mm[curve.is_tick]), 10.0, atol=1e-9)
    assert curve.is_tick.sum() >= 10
    line = pa.lines_of_sight(uv[None])
    np.testing.assert_allclose(np.linalg.norm(curve.xyz_mm - line.points_mm[0], axis=1), curve.depth_mm, atol=1e-9)


def test_the_curve_ends_where_the_other_view_is_calibrated():
    pa, lateral, uv = _drawn()
    curve = matching_curve(pa, uv, lateral)
    step = np.linalg.norm(np.diff(curve.uv_px[:2], axis=0))
    for end in (curve.uv_px[0], curve.uv_px[-1]):
        assert LIMIT_PX - 1.1 * step < np.linalg.norm(end - CENTRE_PX) < LIMIT_PX


@pytest.mark.slow
def test_the_band_covers_the_true_line():
    """Over many estimates of both views, the frame's errors shared, the target lies within the band in 95 %."""
    pa, lateral, uv = _drawn()
    truth = lateral.project(TARGET_MM[None])[0]
    rng = np.random.default_rng(8)
    draws, inside = 100, 0
    for _ in range(draws):
        first, second = estimates((pa, lateral), rng)
        curve = matching_curve(first, uv + rng.normal(0.0, 0.5, 2), second)
        nearest = np.argmin(np.linalg.norm(curve.uv_px - truth, axis=1))
        distance = (truth - curve.uv_px[nearest]) @ curve.across_px[nearest]
        inside += abs(distance) < curve.half_width_px[nearest]
    assert inside / draws == pytest.approx(0.95, abs=4 * np.sqrt(0.95 * 0.05 / draws))


def test_the_pick_widens_the_band():
    pa, lateral, uv = _drawn()
    careful = matching_curve(pa, uv, lateral)
    hasty = matching_curve(pa, uv, lateral, 4.0 * np.eye(2))
    pick = np.sqrt(hasty.half_width_px**2 - careful.half_width_px**2)  # of sqrt(4 - 0.25) px, seen at about equal scale
    np.testing.assert_allclose(pick, 1.96 * np.sqrt(3.75), rtol=0.2)


def test_no_band_where_a_view_has_no_covariance():
    pa, lateral, uv = _drawn()
    curve = matching_curve(pa, uv, replace(lateral, factors=None))
    assert curve.half_width_px is None
    np.testing.assert_allclose(curve.uv_px, matching_curve(pa, uv, lateral).uv_px)


def test_a_snapped_pick_is_one_number():
    pa, lateral, uv = _drawn()
    pick = snap(matching_curve(pa, uv, lateral), lateral.project(TARGET_MM[None])[0] + np.array([2.0, 1.0]), 0.7)
    assert np.linalg.matrix_rank(pick.covariance_px2, tol=1e-9) == 1
    assert np.trace(pick.covariance_px2) == pytest.approx(0.49)
    np.testing.assert_allclose(pick.covariance_px2 @ pick.across_px, 0.0, atol=1e-12)


def test_clicks_far_from_the_curve_are_refused():
    pa, lateral, uv = _drawn()
    curve = matching_curve(pa, uv, lateral)
    middle = len(curve.uv_px) // 2
    assert np.isfinite(snap(curve, curve.uv_px[middle] + 10.0 * curve.across_px[middle]).uv_px).all()
    with pytest.raises(UnusableInputError, match="40 px from the matching curve"):
        snap(curve, curve.uv_px[middle] + 40.0 * curve.across_px[middle])
    for end, outward in ((0, -30.0), (-1, 30.0)):
        with pytest.raises(OutsideRegionError, match="30 px beyond the end"):
            snap(curve, curve.uv_px[end] + outward * curve.tangent_px[end])
    with pytest.raises(UnusableInputError, match="positive"):
        snap(curve, curve.uv_px[middle], 0.0)
    with pytest.raises(UnusableInputError, match="px from the matching curve"):
        snap(curve, np.array([np.nan, 0.0]))


def test_lines_the_other_view_does_not_see_are_refused():
    pa, lateral, uv = _drawn()
    aside = replace(lateral, focal_point_mm=lateral.focal_point_mm + np.array([0.0, 3000.0, 0.0]))
    with pytest.raises(OutsideRegionError, match="no part of the line of sight"):
        matching_curve(pa, uv, aside)
    with pytest.raises(UnusableInputError, match="finite"):
        matching_curve(pa, np.array([np.nan, 1.0]), lateral)
