from dataclasses import replace

import numpy as np
import pytest
from calibration_scenes import choose
from scipy.stats import chi2

from sightline.calibration.plates.self_check import SelfCheck, self_check
from sightline.calibration.view import Pencil
from sightline.detection.results import Observations
from sightline.errors import CalibrationRefusedError, ObservationsError
from sightline.frame import Frame
from sightline.studies.scenes import measure
from sightline.twin.xray.setup import displaced, draw_setup, with_errors

GAMMA = Frame.load("gamma")
IDS = [f.id for f in GAMMA.fiducials]
NOMINAL_MM = np.array([f.xyz_mm for f in GAMMA.fiducials])
SEEDS = (11, 12)
SD_PX = 0.1


def images(rng: np.random.Generator, true: Frame, number: int) -> list[Observations]:
    """Images of both views in turn, the C-arm and its distortion drawn afresh for each."""
    pairs = [measure(rng, draw_setup(rng, true, frame_errors=False), SD_PX) for _ in range(number)]
    return [pairs[k][("pa", "lateral")[k % 2]] for k in range(number)]


def moved_by(ball: str, mm: tuple[float, float, float]) -> np.ndarray:
    out = np.zeros((len(IDS), 3))
    out[IDS.index(ball)] = mm
    return out


@pytest.fixture(scope="module")
def checked() -> dict[tuple[int, int], tuple[np.ndarray, SelfCheck]]:
    """By seed and number of images: the frame's true errors (M, 3), and what was found."""
    out = {}
    for seed in SEEDS:
        rng = np.random.default_rng(seed)
        true = with_errors(GAMMA, rng)
        errors = np.array([f.xyz_mm for f in true.fiducials]) - NOMINAL_MM
        seen = images(rng, true, 8)
        for number in (4, 8):
            out[seed, number] = errors, self_check(seen[:number], GAMMA)
    return out


def test_shears_stretches_and_bends_along_the_beam_leave_every_image_as_it_is():
    """Why plate shifts cannot be seen: another focal point gives exactly the same projections, wherever it is."""
    view = GAMMA.view("pa")
    plane, rng = view.xrii.plane, np.random.default_rng(1)
    xyz = np.concatenate([view.xrii.xyz_mm, view.source.xyz_mm])
    x, h = plane.to_plane(xyz), plane.height_mm(xyz)[:, None]
    for _ in range(10):
        a, c, d = rng.normal(0, 1e-3, 2), 1 + rng.normal(0, 1e-3), rng.normal(0, 1e-6)
        warped = plane.to_space((x + a * h) / (1 + d * h)) + c * h / (1 + d * h) * plane.normal
        pencil = Pencil.through(plane, rng.normal([0, 0, -620], [60, 60, 40]))
        p, q = pencil.pq[:2], pencil.pq[2]
        other = Pencil(plane, np.append((p + a) / c, (q + d) / c))
        np.testing.assert_allclose(other.project(warped), pencil.project(xyz), atol=1e-9)
        assert np.abs(other.focal_point_mm - pencil.focal_point_mm).max() > 0.01


def test_the_covariance_is_that_of_the_errors(checked):
    """Each frame is one draw of 678 numbers; five together within what chance gives 999 times in 1,000."""
    for number in (4, 8):
        total = 0.0
        for seed in SEEDS:
            errors, found = checked[seed, number]
            covariance = found.frame.covariance_mm2
            assert covariance is not None
            gap = (errors - found.moved_mm).ravel()
            total += gap @ np.linalg.solve(covariance, gap)
        freedom = 678 * len(SEEDS)
        assert chi2.ppf(0.0005, freedom) < total < chi2.ppf(0.9995, freedom)


def test_the_frame_is_where_it_was_found(checked):
    errors, found = checked[SEEDS[0], 4]
    xyz = np.array([f.xyz_mm for f in found.frame.fiducials])
    np.testing.assert_allclose(xyz, NOMINAL_MM + found.moved_mm, atol=1e-6)
    assert errors.shape == found.moved_mm.shape
    assert found.frame.tolerances is None


def test_sound_frames_pass_and_no_ball_is_accused(checked):
    for _, found in checked.values():
        assert all(check.passed for check in found.checks), found.checks
        assert found.misplaced == ()


def test_more_images_show_more_of_balls_and_twists_and_nothing_of_shifts(checked):
    """Ratios of s.d. to those of the tolerances: shifts stay at 1 exactly."""
    for seed in SEEDS:
        few, many = checked[seed, 4][1], checked[seed, 8][1]
        for before, after in zip(few.pairs, many.pairs, strict=True):
            np.testing.assert_allclose(before.sd[:3] / before.prior_sd[:3], 1.0, atol=2e-3)
            np.testing.assert_allclose(after.sd[:3] / after.prior_sd[:3], 1.0, atol=2e-3)
            assert after.sd[5] < before.sd[5] < 0.35 * before.prior_sd[5]
            assert (after.sd[3:5] < before.sd[3:5]).all()
        in_plane = [found.in_plate.sd_mm[:113, :2] / found.in_plate.prior_sd_mm[:113, :2] for found in (few, many)]
        assert 0.5 < np.median(in_plane[1]) < np.median(in_plane[0]) < 0.85


def test_twists_are_found_to_what_is_stated(checked):
    sigma = []
    for seed in SEEDS:
        errors, found = checked[seed, 8]
        for pair, start in zip(found.pairs, (0, 113), strict=True):
            axis = 2 if pair.view == "pa" else 0
            turn = [_turn(errors[rows], NOMINAL_MM[rows], axis) for rows in _plates(start)]
            sigma.append((turn[1] - turn[0] - pair.moved[5]) / pair.sd[5])
    assert chi2.ppf(0.0005, len(sigma)) < np.sum(np.square(sigma)) < chi2.ppf(0.9995, len(sigma))


def _plates(start: int) -> tuple[slice, slice]:
    return slice(start, start + 49), slice(start + 49, start + 113)


def _turn(errors: np.ndarray, xyz: np.ndarray, axis: int) -> float:
    """Least-squares rotation of a plate about its normal; its grid is symmetric, so the other motions do not enter."""
    way = np.cross(np.eye(3)[axis], xyz - xyz.mean(axis=0))
    return float((way * errors).sum() / (way**2).sum())


@pytest.mark.slow
def test_balls_that_sit_wrong_are_found_named_and_measured():
    rng = np.random.default_rng(21)
    true = with_errors(GAMMA, rng)
    true = displaced(true, moved_by("pa-s-6-2", (0.0, 0.4, 0.0)) + moved_by("lateral-x-6-3", (0.0, 1.5, 0.5)))
    found = self_check(images(rng, true, 4), GAMMA)
    assert set(found.misplaced) == {"pa-s-6-2", "lateral-x-6-3"}
    assert "pa-s-6-2 by" in found.checks[2].sentence
    rows = [IDS.index(ball) for ball in ("pa-s-6-2", "lateral-x-6-3")]
    errors = np.array([f.xyz_mm for f in true.fiducials]) - NOMINAL_MM
    for row, plate in zip(rows, (slice(49, 113), slice(113, 162)), strict=True):
        others = [k for k in range(plate.start, plate.stop) if k != row]
        within = errors[row] - errors[others].mean(
            axis=0
        )  # the plate's rotation moves a ball by 0.01 mm: within the s.d.
        gap = (found.in_plate.moved_mm[row] - within) / np.hypot(found.in_plate.sd_mm[row], 0.02)
        assert np.abs(gap).max() < 3.5


def test_a_bead_found_wrong_in_one_image_is_left_out_of_that_image_alone():
    rng = np.random.default_rng(22)
    true = with_errors(GAMMA, rng)
    seen = images(rng, true, 4)
    uv = seen[0].uv_px.copy()
    uv[20] += (4.0, -3.0)
    found = self_check([replace(seen[0], uv_px=uv), *seen[1:]], GAMMA)
    assert found.misplaced == ()
    number = dict(zip(IDS, found.images, strict=True))
    assert number[seen[0].ids[20]] == sum(seen[0].ids[20] in one.ids for one in seen) - 1


def test_balls_outside_every_field_keep_their_tolerance():
    rng = np.random.default_rng(23)
    true = with_errors(GAMMA, rng)
    found = self_check([choose(seen, lambda ball: ball != "pa-x-1-1") for seen in images(rng, true, 4)], GAMMA)
    assert found.images[0] == 0
    assert (found.in_plate.sd_mm[0] > 0.9 * found.in_plate.prior_sd_mm[0]).all()


@pytest.mark.slow
def test_a_frame_with_twice_the_stated_errors_is_estimated_and_with_four_times_refused():
    rng = np.random.default_rng(24)
    found = self_check(images(rng, displaced(GAMMA, rng.normal(0.0, 0.04, NOMINAL_MM.shape)), 4), GAMMA)
    assert [check.name for check in found.checks if not check.passed] == ["self-check chi-square"]
    worse = images(rng, displaced(GAMMA, rng.normal(0.0, 0.08, NOMINAL_MM.shape)), 4)
    with pytest.raises(CalibrationRefusedError, match="beyond their tolerance"):
        self_check(worse, GAMMA)


def test_an_arm_that_did_not_move_is_told():
    rng = np.random.default_rng(25)
    setup = draw_setup(rng, GAMMA)
    seen = [one for _ in range(2) for one in measure(rng, setup, SD_PX).values()]
    movement = self_check(seen, GAMMA).checks[0]
    assert not movement.passed
    assert movement.figure is not None
    assert movement.figure < 0.1


def test_too_few_images_and_one_twice_are_refused():
    rng = np.random.default_rng(26)
    seen = images(rng, GAMMA, 4)
    with pytest.raises(CalibrationRefusedError, match="4 or more"):
        self_check(seen[:3], GAMMA)
    with pytest.raises(ObservationsError, match="twice"):
        self_check([*seen, seen[1]], GAMMA)
