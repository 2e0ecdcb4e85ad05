"""Calibration of a view: perfect observations first, noise after; covariances proved by sampling; refusals."""

from dataclasses import replace

import numpy as np
import pytest
from calibration_scenes import EXACT, GAMMA, NOISE_PX, TARGETS_MM, Camera, choose, displaced, line_numbers, true_numbers
from threadpoolctl import threadpool_limits

from sightline.calibration import calibrate
from sightline.calibration.view import SOURCES
from sightline.common.geometry.planes import Plane
from sightline.errors import (
    CalibrationRefusedError,
    FrameError,
    ObservationsError,
    OutsideRegionError,
    UnusableInputError,
)
from sightline.frame import Frame

METHODS = ("smooth", "polynomial", "localized")
CLASSICAL = [("polynomial", "xrii"), ("polynomial", "source"), ("localized", "xrii"), ("localized", "source")]


@pytest.mark.parametrize("method", METHODS)
def test_a_camera_parallel_to_its_plates_is_found_exactly(method):
    camera = Camera.pa()
    view = calibrate(camera.observe(), EXACT, "pa", method)
    uv = camera.project(TARGETS_MM)
    np.testing.assert_allclose(line_numbers(view, uv), true_numbers(camera, view.plane, TARGETS_MM), atol=1e-6)
    np.testing.assert_allclose(view.project(TARGETS_MM), uv, atol=1e-6)
    assert all(check.passed for check in view.checks)


@pytest.mark.parametrize("method", METHODS)
def test_what_a_view_sees_is_what_it_projects(method):
    camera = Camera.pa(bend=0.03)
    view = calibrate(camera.observe(), EXACT, "pa", method)
    along = np.linspace([-900.0, 30.0, -5.0], [1100.0, -45.0, 12.0], 1001)  # across the beam, far beyond the beads
    behind = camera.focal_point_mm + np.array([[0.0, 0.0, 0.0], [1.0, 2.0, -30.0]])
    points = np.concatenate([along, behind])
    uv, seen = view.project_seen(points)
    assert 30 < seen.sum() < 300
    np.testing.assert_allclose(uv, view.project(points[seen]), atol=1e-9)
    for point in points[~seen][::7]:
        with pytest.raises(OutsideRegionError):
            view.project(point[None])


@pytest.mark.parametrize(("method", "plate"), CLASSICAL)
def test_lines_may_go_through_either_plate(method, plate):
    camera = Camera.pa()
    view = calibrate(camera.observe(), EXACT, method=method, plate=plate)
    height = 300.0 if plate == "xrii" else 150.0
    assert abs(view.plane.origin_mm[2] - height) < 1e-9
    lines = view.lines_of_sight(camera.project(TARGETS_MM))
    ray = TARGETS_MM - lines.focal_point_mm
    np.testing.assert_allclose(np.cross(ray, lines.directions), 0.0, atol=1e-6)


@pytest.mark.slow
def test_smooth_states_the_covariance_that_sampling_shows():
    # 200 draws of bead noise; the camera lies in the model (an affine map), so noise is all the error there is. Sample
    # variances of 200 draws scatter by 10 %; hyper-parameters learned each time add the misfit they cannot exclude.
    camera, rng = Camera.pa(), np.random.default_rng(11)
    uv = camera.project(TARGETS_MM)
    view = calibrate(camera.observe(), EXACT)
    truth = true_numbers(camera, view.plane, TARGETS_MM)
    errors, stated = [], []
    for _ in range(200):
        view = calibrate(camera.observe(rng=rng), EXACT)
        errors.append(line_numbers(view, uv) - truth)
        stated.append(sum(view.lines_of_sight(uv).covariance.values()))
    sampled, covariance = np.cov(np.array(errors).T), np.mean(stated, axis=0)
    ratio = np.diag(sampled) / np.diag(covariance)
    assert (ratio > 0.6).all()
    assert (ratio < 1.25).all()
    # The joint errors of focal point and lines are as stated in every direction of their space.
    half = np.linalg.cholesky(np.linalg.inv(covariance))
    assert np.linalg.eigvalsh(half.T @ sampled @ half).max() < 1.6


@pytest.mark.parametrize(("method", "plate"), [("smooth", "xrii"), *CLASSICAL])
def test_frame_errors_move_the_lines_as_the_frame_factor_says(method, plate):
    # The image shows the frame as it is, the software gets its nominal form: the error is the factor times e.
    camera, rng = Camera.pa(), np.random.default_rng(12)
    errors = 0.3 * rng.standard_normal(GAMMA.error_factor.shape[1])
    moves = (GAMMA.error_factor[GAMMA.rows("pa")] @ errors).reshape(-1, 3)
    uv = camera.project(TARGETS_MM)
    nominal = camera.observe(GAMMA)
    beads = np.array([f.xyz_mm for f in GAMMA.view("pa").fiducials])
    bent = replace(nominal, uv_px=camera.project(beads + moves))
    before, after = (calibrate(o, GAMMA, "pa", method, plate=plate) for o in (nominal, bent))
    predicted = before.lines_of_sight(uv).shared["frame"] @ errors
    moved = line_numbers(after, uv) - line_numbers(before, uv)
    scale = np.sqrt(np.diag(before.lines_of_sight(uv).covariance["frame"]))
    assert np.abs((moved - predicted) / scale).max() < 0.1


def test_two_views_of_one_frame_share_their_frame_errors():
    view = calibrate(Camera.pa().observe(GAMMA), GAMMA)
    lines = view.lines_of_sight(Camera.pa().project(TARGETS_MM))
    assert lines.frame_key == GAMMA.fingerprint
    assert tuple(lines.shared) == ("frame",)
    response = lines.shared["frame"]
    assert response.shape == (3 + 2 * len(TARGETS_MM), GAMMA.error_factor.shape[1])
    np.testing.assert_allclose(lines.covariance["frame"], response @ response.T)
    lateral = response[:, GAMMA.rows("lateral")]
    assert np.abs(lateral).max() == 0.0  # errors of the other view's own beads do not touch this one


@pytest.mark.parametrize(("method", "plate"), [("smooth", "xrii"), *CLASSICAL])
def test_the_budget_adds_up_and_has_no_negative_variance(method, plate):
    camera = Camera.pa(tilt_rad=0.05, bend=0.05)
    view = calibrate(camera.observe(GAMMA, np.random.default_rng(13)), GAMMA, "pa", method, plate=plate)
    uv = camera.project(TARGETS_MM)
    covariance = view.lines_of_sight(uv).covariance
    assert tuple(covariance) == SOURCES
    errors = view.posterior.line_errors(uv)
    total = errors.noise + errors.misfit + errors.frame_factor @ errors.frame_factor.T
    np.testing.assert_allclose(sum(covariance.values()), total, atol=1e-9 * np.abs(total).max())
    for part in covariance.values():
        assert np.linalg.eigvalsh(part).min() > -1e-9 * np.abs(total).max()
    assert np.abs(covariance["beads"][:3]).max() < 1e-6 * np.abs(total).max()  # given F, its error is zero


@pytest.mark.parametrize(("method", "plate"), [("smooth", "xrii"), *CLASSICAL[::2]])
@pytest.mark.parametrize("count", [1, 5])
def test_the_errors_of_lines_have_the_same_bits_with_several_threads_of_linear_algebra(method, plate, count):
    """OpenBLAS splits some products of few rows: on some processors those of one line or of five, not of four."""
    camera = Camera.pa(tilt_rad=0.05, bend=0.05)
    view = calibrate(camera.observe(GAMMA, np.random.default_rng(13)), GAMMA, "pa", method, plate=plate)
    uv = np.tile(camera.project(TARGETS_MM), (2, 1))[:count]
    covariances = []
    for threads in (1, 2):
        with threadpool_limits(threads, user_api="blas"):
            covariances.append(view.lines_of_sight(uv).total_covariance)
    assert len(uv) == count
    np.testing.assert_array_equal(*covariances)


def test_a_pick_further_out_has_a_larger_error_and_is_marked_outside():
    camera = Camera.pa(bend=0.05)
    view = calibrate(camera.observe(rng=np.random.default_rng(14)), EXACT)
    near, far = np.array([[511.0, 511.0]]), np.array([[100.0, 100.0]])
    out = [view.lines_of_sight(uv) for uv in (near, far)]
    spread = [np.trace(sum(o.covariance.values())[3:, 3:]) for o in out]
    assert out[0].inside_hull.all()
    assert not out[1].inside_hull.any()
    assert spread[1] > 4 * spread[0]
    with pytest.raises(OutsideRegionError, match=r"^pa: .*far outside .*\(3000, 0\); it spans u -\d+ to \d+, v"):
        view.lines_of_sight(np.array([[3000.0, 0.0]]))


@pytest.mark.parametrize("method", METHODS)
def test_wrong_beads_are_found_left_out_and_named(method):
    camera, rng = Camera.pa(bend=0.05), np.random.default_rng(15)
    good = camera.observe(rng=rng)
    wrong = {8: (9.0, -4.0), 30: (-5.0, 3.0), 61: (0.0, 8.0), 75: (6.0, 6.0), 90: (-12.0, 1.0)}
    view = calibrate(displaced(good, wrong), EXACT, "pa", method)
    assert set(view.residuals.left_out) == {good.ids[k] for k in wrong}
    assert (view.residuals.sigma[~view.residuals.used] > 4).all() or method != "smooth"
    check = next(c for c in view.checks if c.name == "wrong beads")
    assert check.figure == len(wrong)
    assert all(good.ids[k] in check.sentence for k in wrong)
    reference = calibrate(choose(good, lambda i: i not in view.residuals.left_out), EXACT, "pa", method)
    np.testing.assert_allclose(view.focal_point_mm, reference.focal_point_mm, atol=1e-9)


def test_good_beads_are_not_left_out():
    rng = np.random.default_rng(16)
    views = [calibrate(Camera.pa(bend=0.05).observe(rng=rng), EXACT) for _ in range(12)]
    assert not any(view.residuals.left_out for view in views)
    assert all(check.passed for view in views for check in view.checks)


def test_too_many_wrong_beads_are_refused():
    good = Camera.pa().observe()
    wrong = {k: ((-1) ** k * 9.0, 7.0) for k in range(3, 100, 9)}
    with pytest.raises(CalibrationRefusedError, match="contradict the others"):
        calibrate(displaced(good, wrong), EXACT)


def test_noise_worse_than_stated_fails_the_chi_square_check():
    noisy = Camera.pa().observe(rng=np.random.default_rng(17), sd_px=0.4)
    stated = replace(noisy, covariance_px2=noisy.covariance_px2 / 16)
    check = next(c for c in calibrate(stated, EXACT).checks if c.name == "chi-square")
    assert not check.passed
    assert check.figure > check.limit


def test_without_covariance_the_noise_is_estimated_and_said():
    for sd_px in (0.15, 0.6):
        seen = replace(Camera.pa().observe(rng=np.random.default_rng(18), sd_px=sd_px), covariance_px2=None)
        view = calibrate(seen, EXACT)
        check = next(c for c in view.checks if c.name == "measurement noise")
        assert check.figure == pytest.approx(sd_px, rel=0.25)
        assert view.lines_of_sight(np.array([[500.0, 500.0]])).covariance is not None


def test_residuals_belong_to_the_beads_given_whatever_their_order():
    seen = Camera.pa(bend=0.05).observe(rng=np.random.default_rng(19))
    order = np.random.default_rng(20).permutation(len(seen))
    shuffled = replace(
        seen,
        ids=tuple(seen.ids[k] for k in order),
        uv_px=seen.uv_px[order],
        covariance_px2=seen.covariance_px2[order],
    )
    a, b = calibrate(seen, EXACT), calibrate(shuffled, EXACT)
    assert a.residuals.ids == b.residuals.ids
    np.testing.assert_allclose(a.residuals.leave_one_out_mm, b.residuals.leave_one_out_mm, atol=1e-12)
    np.testing.assert_allclose(a.focal_point_mm, b.focal_point_mm, atol=1e-9)
    # A bead left out has a larger error than one that is used; both in the mm that 0.1 px amount to.
    assert a.residuals.leave_one_out_rms_mm > np.sqrt(np.mean(a.residuals.residual_mm**2))
    assert a.residuals.leave_one_out_rms_mm == pytest.approx(0.92 * 0.21 * NOISE_PX, rel=0.5)


def test_leave_one_out_is_what_calibrating_without_the_bead_gives():
    seen = Camera.pa(bend=0.05).observe(rng=np.random.default_rng(21))
    whole = calibrate(seen, EXACT)
    for row in (0, 24, 80):
        rest = calibrate(choose(seen, lambda i, row=row: i != seen.ids[row]), EXACT)
        xyz = np.array([f.xyz_mm for f in EXACT.view("pa").fiducials if f.id == seen.ids[row]])
        miss = rest.plane_map.to_plane(seen.uv_px[row : row + 1]) - rest.plane.central_projection(
            rest.focal_point_mm, xyz
        )
        place = whole.residuals.ids.index(seen.ids[row])
        np.testing.assert_allclose(whole.residuals.leave_one_out_mm[place], miss[0], atol=0.004)


def half(observations):
    """Only the beads with y > 10 mm."""
    xyz = {f.id: f.xyz_mm for f in EXACT.view("pa").fiducials}
    return choose(observations, lambda i: xyz[i][1] > 10.0)


def test_half_a_plate_outside_the_field_fails_the_coverage_check():
    view = calibrate(half(Camera.pa().observe()), EXACT)
    check = next(c for c in view.checks if c.name == "bead coverage")
    assert not check.passed
    assert "move the frame" in check.sentence


SEEN = Camera.pa().observe()
XRII = {f.id for f in EXACT.view("pa").xrii.fiducials}
ROW = {f.id for f in EXACT.view("pa").fiducials if abs(f.xyz_mm[0] - EXACT.view("pa").fiducials[0].xyz_mm[0]) < 1e-6}


def first(count):
    """Ids of some beads of each plate, spread over it."""
    rng = np.random.default_rng(0)
    plates = (EXACT.view("pa").xrii, EXACT.view("pa").source)
    return {i for plate in plates for i in rng.permutation(plate.ids)[:count]}


@pytest.mark.parametrize(
    ("observations", "options", "error", "words"),
    [
        (SEEN, {"view": "lateral"}, ObservationsError, "swapped"),
        (SEEN, {"method": "best"}, UnusableInputError, "smooth, polynomial, localized"),
        (SEEN, {"method": "localized", "plate": "middle"}, UnusableInputError, "'xrii' or 'source'"),
        (SEEN, {"method": "polynomial", "degree": 9}, UnusableInputError, "1 to 7"),
        (replace(SEEN, view="oblique"), {}, FrameError, "pa, lateral"),
        (replace(SEEN, ids=("nobody", *SEEN.ids[1:])), {}, ObservationsError, "'nobody'"),
        (replace(SEEN, covariance_px2=1e9 * SEEN.covariance_px2), {}, ObservationsError, "between 1e-06 and 1000 px"),
        (replace(SEEN, covariance_px2=1e-12 * SEEN.covariance_px2), {}, ObservationsError, "between 1e-06 and 1000 px"),
        (choose(SEEN, lambda i: False), {}, CalibrationRefusedError, "none of the"),
        (choose(SEEN, lambda i: i in XRII), {}, CalibrationRefusedError, "source plate"),
        (choose(SEEN, lambda i: i not in XRII), {}, CalibrationRefusedError, "XRII plate"),
        (choose(SEEN, first(3).__contains__), {}, CalibrationRefusedError, "at least 4"),
        (choose(SEEN, first(6).__contains__), {}, CalibrationRefusedError, "at least 16"),
        (choose(SEEN, lambda i: i not in XRII or i in ROW), {}, CalibrationRefusedError, "one line"),
        (choose(SEEN, first(6).__contains__), {"method": "polynomial"}, CalibrationRefusedError, "lower degree"),
    ],
)
def test_what_cannot_be_calibrated_is_refused_with_a_reason(observations, options, error, words):
    with pytest.raises(error, match=words):
        calibrate(observations, EXACT, **options)


@pytest.mark.parametrize("method", METHODS)
def test_either_beam_direction_works(method):
    # AP instead of PA: the source stands on the side of the "XRII" plate.
    pa = Camera.pa()
    camera = replace(
        pa, focal_point_mm=np.array([12.3, -7.7, 881.6]), detector=Plane([3.0, 5.0, -118.4], pa.detector.axes)
    )
    view = calibrate(camera.observe(), EXACT, "pa", method)
    np.testing.assert_allclose(view.focal_point_mm, camera.focal_point_mm, atol=1e-6)
    np.testing.assert_allclose(view.project(TARGETS_MM), camera.project(TARGETS_MM), atol=1e-6)


def test_a_source_at_infinity_is_refused():
    camera = replace(Camera.pa(), focal_point_mm=np.array([12.3, -7.7, -1e6]))
    with pytest.raises(CalibrationRefusedError, match="no parallax"):
        calibrate(camera.observe(), EXACT)


@pytest.mark.parametrize("method", METHODS)
def test_a_source_between_the_plates_is_refused(method):
    # Source beads that appear mirrored about the image's middle against the XRII beads.
    seen = Camera.pa().observe()
    uv = np.where(np.isin(seen.ids, list(XRII))[:, None], seen.uv_px, 1023.0 - seen.uv_px)
    with pytest.raises(CalibrationRefusedError, match="between the plates"):
        calibrate(replace(seen, uv_px=uv), EXACT, "pa", method)


def test_few_beads_still_serve_the_localized_method():
    by_reach = sorted(SEEN.ids, key=lambda i: np.hypot(*EXACT.view("pa").by_id[i].xyz_mm[:2]))
    near, far = [i for i in by_reach if i in XRII][:5], [i for i in by_reach if i not in XRII][-8:]
    seen = replace(choose(SEEN, {*near, *far}.__contains__), covariance_px2=None)
    view = calibrate(seen, EXACT, method="localized")
    assert any(c.name == "bead count" and not c.passed for c in view.checks)
    assert any(c.name == "measurement noise" for c in view.checks)


def test_default_tolerances_are_stated_as_assumed():
    bare = replace(GAMMA, tolerances=None)
    assert any(c.name == "frame tolerances" for c in calibrate(SEEN, bare).checks)
    assert not any(c.name == "frame tolerances" for c in calibrate(SEEN, EXACT).checks)


def test_a_calibrated_view_identifies_its_frame_file(tmp_path) -> None:
    """Serial and coordinates: the same file read again is the same, another serial or a moved bead is not."""
    plate = GAMMA.view("pa").xrii
    moved = replace(plate.fiducials[3], xyz_mm=tuple(np.add(plate.fiducials[3].xyz_mm, (0.0, 0.01, 0.0))))
    views = dict(GAMMA.views)
    views["pa"] = replace(
        views["pa"], xrii=replace(plate, fiducials=(*plate.fiducials[:3], moved, *plate.fiducials[4:]))
    )
    GAMMA.save(tmp_path / "gamma.json")
    same = Frame.load(tmp_path / "gamma.json")
    others = [replace(GAMMA, serial="04"), replace(GAMMA, views=views)]
    keys = [
        calibrate(Camera.pa().observe(frame), frame).lines_of_sight(np.array([[512.0, 512.0]])).frame_key
        for frame in (GAMMA, same, *others)
    ]
    assert keys[0] == keys[1]
    assert len(set(keys)) == 3
