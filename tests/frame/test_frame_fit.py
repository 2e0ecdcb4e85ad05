from dataclasses import replace

import numpy as np
import pytest
from fit_scenes import FRAME, IDS, NOMINAL_MM, SD_MM, made, measured
from scipy.stats import chi2

from sightline.common.geometry.rigid import rigid_fit
from sightline.errors import FrameError
from sightline.frame.measured.fit import Circumstances, FittedFrame, fit_frame
from sightline.frame.tables import Series

STILL = Circumstances(drift_mm=0.0)


def failing(fitted: FittedFrame) -> dict[str, str]:
    return {check.name: check.sentence for check in fitted.checks if not check.passed}


def positions(fitted: FittedFrame) -> np.ndarray:
    assert fitted.frame is not None, failing(fitted)
    return np.array([f.xyz_mm for f in fitted.frame.fiducials])


def in_gauge(xyz_mm: np.ndarray) -> np.ndarray:
    """True places laid on the nominal frame, as the adjustment lays its own."""
    return rigid_fit(xyz_mm, NOMINAL_MM).apply(xyz_mm)


def squares(error: np.ndarray, covariance: np.ndarray) -> tuple[float, int]:
    """Squared Mahalanobis length in the directions that have an error, and their number."""
    values, vectors = np.linalg.eigh(covariance)
    kept = values > 1e-9 * values[-1]
    return float(((vectors.T @ error)[kept] ** 2 / values[kept]).sum()), int(kept.sum())


def test_exact_measurements_give_the_frame_back_whole():
    rng = np.random.default_rng(1)
    true = made(rng)
    series = [
        replace(measured(true, rng, name, sd_mm=0.0, stated=False), covariance_mm2=1e-6 * np.eye(96)) for name in "12"
    ]
    fitted = fit_frame(FRAME, series, STILL)
    np.testing.assert_allclose(positions(fitted), in_gauge(true), atol=2e-6)  # six decimals are written
    assert fitted.adjusted is not None
    assert fitted.adjusted.freedom == 90


@pytest.mark.slow
@pytest.mark.parametrize("count", [1, 3])
def test_the_covariance_is_that_of_the_errors(count):
    """Pooled chi-square of 60 frames within what chance gives it 999 times in 1,000; rank all but the gauge's six."""
    rng = np.random.default_rng(2)
    total, freedom = 0.0, 0
    for _ in range(60):
        true = made(rng)
        fitted = fit_frame(FRAME, [measured(true, rng, str(k)) for k in range(count)], STILL)
        assert fitted.frame is not None
        assert fitted.frame.covariance_mm2 is not None
        square, rank = squares((positions(fitted) - in_gauge(true)).ravel(), fitted.frame.covariance_mm2)
        assert rank == 90
        total, freedom = total + square, freedom + rank
    assert chi2.ppf(0.0005, freedom) < total < chi2.ppf(0.9995, freedom)


def test_correlated_errors_weigh_as_they_are_stated():
    """An instrument whose x has a common scale error: given its covariance, the adjustment's covariance holds."""
    rng = np.random.default_rng(3)
    total, freedom = 0.0, 0
    for _ in range(60):
        true = made(rng)
        series = measured(true, rng)
        stretch = series.xyz_mm * np.array([2e-4, 0.0, 0.0])
        wrong = replace(
            series,
            xyz_mm=series.xyz_mm + rng.standard_normal() * stretch,
            covariance_mm2=SD_MM**2 * np.eye(96) + np.outer(stretch, stretch),
        )
        fitted = fit_frame(FRAME, [wrong], STILL)
        assert fitted.frame is not None
        assert fitted.frame.covariance_mm2 is not None
        square, rank = squares((positions(fitted) - in_gauge(true)).ravel(), fitted.frame.covariance_mm2)
        total, freedom = total + square, freedom + rank
    assert chi2.ppf(0.0005, freedom) < total < chi2.ppf(0.9995, freedom)


def test_balls_that_were_not_measured_are_placed_with_the_error_that_they_then_have():
    rng = np.random.default_rng(4)
    gone = {"px1", "ls6", "ls7"}
    keep = np.array([i not in gone for i in IDS])
    total, freedom = 0.0, 0
    for _ in range(80):
        true = made(rng)
        fitted = fit_frame(FRAME, [measured(true, rng).where(keep)], STILL)
        assert set(fitted.missing) == gone
        assert fitted.frame is not None
        assert fitted.frame.covariance_mm2 is not None
        rows = np.repeat(~keep, 3)
        theirs = rigid_fit(true[keep], NOMINAL_MM[keep]).apply(true)
        error = (positions(fitted) - theirs).ravel()[rows]
        square, rank = squares(error, fitted.frame.covariance_mm2[np.ix_(rows, rows)])
        total, freedom = total + square, freedom + rank
    assert freedom == 80 * 9
    assert chi2.ppf(0.0005, freedom) < total < chi2.ppf(0.9995, freedom)


def exchanged(series: Series, names: dict[str, str]) -> Series:
    return replace(series, ids=tuple(names.get(i, i) for i in series.ids))


def test_two_exchanged_balls_are_found_and_nothing_is_made_of_them():
    rng = np.random.default_rng(5)
    fitted = fit_frame(FRAME, [exchanged(measured(made(rng), rng), {"px1": "px4", "px4": "px1"})], STILL)
    assert fitted.frame is None
    assert "px1 and px4 are exchanged" in failing(fitted)["measured ids"]
    assert fitted.identified[0].renamed == {"px1": "px4", "px4": "px1"}


def test_a_chain_of_wrong_ids_is_found_across_plates():
    rng = np.random.default_rng(6)
    chain = {"px1": "ps2", "ps2": "lx3", "lx3": "px1"}
    fitted = fit_frame(FRAME, [exchanged(measured(made(rng), rng), chain)], STILL)
    assert fitted.identified[0].renamed == {wrong: right for right, wrong in chain.items()}
    assert "ps2 fits the place of px1" in failing(fitted)["measured ids"]


def test_a_wrong_id_among_balls_that_were_not_measured_is_found():
    rng = np.random.default_rng(7)
    series = measured(made(rng), rng).where(np.array([i != "px5" for i in IDS]))
    fitted = fit_frame(FRAME, [exchanged(series, {"px2": "px5"})], STILL)
    assert fitted.identified[0].renamed == {"px5": "px2"}


def test_a_mirrored_series_is_told():
    rng = np.random.default_rng(8)
    series = measured(made(rng), rng)
    fitted = fit_frame(FRAME, [replace(series, xyz_mm=series.xyz_mm * np.array([1.0, -1.0, 1.0]))], STILL)
    assert fitted.identified[0].mirrored
    assert "mirror image" in failing(fitted)["measured ids"]


def test_a_wrong_number_is_named():
    rng = np.random.default_rng(9)
    series = measured(made(rng), rng)
    wrong = series.xyz_mm.copy()
    wrong[4] += (20.0, 0.0, 9.0)
    fitted = fit_frame(FRAME, [replace(series, xyz_mm=wrong)], STILL)
    assert list(fitted.identified[0].astray_mm) == ["px4"]
    assert fitted.identified[0].astray_mm["px4"] == pytest.approx(np.hypot(20, 9), abs=0.6)


@pytest.mark.parametrize(("scale", "unit"), [(1e-3, "metres"), (1 / 25.4, "inches"), (0.1, "centi"), (1e3, "micro")])
def test_other_units_are_told(scale, unit):
    rng = np.random.default_rng(10)
    series = measured(made(rng), rng)
    with pytest.raises(FrameError, match=unit):
        fit_frame(FRAME, [replace(series, xyz_mm=scale * series.xyz_mm)], STILL)


def test_another_frame_is_refused():
    rng = np.random.default_rng(11)
    shuffled = exchanged(measured(made(rng), rng), dict(zip(IDS, rng.permutation(IDS).tolist(), strict=True)))
    with pytest.raises(FrameError, match="are those of this frame"):
        fit_frame(FRAME, [shuffled], STILL)


def displaced(series: Series, ball: str, mm: float) -> Series:
    xyz = series.xyz_mm.copy()
    xyz[series.ids.index(ball)] += mm / np.sqrt(3)
    return replace(series, xyz_mm=xyz)


def test_a_ball_that_sits_wrong_is_taken_once_two_series_see_it():
    rng = np.random.default_rng(12)
    true = made(rng)
    true[13] += (0.3, -0.2, 0.0)
    once = fit_frame(FRAME, [measured(true, rng)], STILL)
    assert once.frame is None
    assert "ps5" in failing(once)["measured deviation"]
    twice = fit_frame(FRAME, [measured(true, rng, name) for name in "ab"], STILL)
    np.testing.assert_allclose(positions(twice), in_gauge(true), atol=5 * SD_MM)


def test_of_three_series_the_wrong_one_is_left_out_and_of_two_neither_is_used():
    rng = np.random.default_rng(13)
    true = made(rng)
    series = [measured(true, rng, name) for name in "abc"]
    series[1] = displaced(series[1], "lx2", 0.2)
    fitted = fit_frame(FRAME, series, STILL)
    assert fitted.adjusted is not None
    assert fitted.adjusted.left_out == (("b", "lx2"),)
    np.testing.assert_allclose(positions(fitted), in_gauge(true), atol=5 * SD_MM)
    assert "Measure lx2 once more" in failing(fit_frame(FRAME, series[:2], STILL))["measured series"]


def test_repeats_show_the_instrument_whether_it_is_stated_or_not():
    rng = np.random.default_rng(14)
    true = made(rng)
    for stated in (True, False):
        fitted = fit_frame(FRAME, [measured(true, rng, str(k), stated=stated) for k in range(4)], STILL)
        assert fitted.adjusted is not None
        assert fitted.adjusted.instrument_mm == pytest.approx(SD_MM, rel=0.15)  # 270 degrees of freedom: 4.3 % s.d.
        spread = np.sqrt(np.diag(fitted.adjusted.covariance_mm2).mean())
        assert spread == pytest.approx(SD_MM / 2, rel=0.2)


def test_an_instrument_with_a_larger_error_than_stated_is_refused():
    rng = np.random.default_rng(15)
    true = made(rng)
    series = [measured(true, rng, name) for name in "ab"]
    small = [replace(one, covariance_mm2=one.covariance_mm2 / 4) for one in series if one.covariance_mm2 is not None]
    assert "State the larger error" in failing(fit_frame(FRAME, small, STILL))["measured series"]


def test_displaced_plates_are_distinguished_from_displaced_balls():
    rng = np.random.default_rng(16)
    true = made(rng)
    true[8:16] += (0.4, 0.0, -0.3)
    fitted = fit_frame(FRAME, [measured(true, rng)], STILL)
    assert fitted.frame is not None
    shift = {(p.view, p.plate): p.shift_mm for p in fitted.plates}
    apart = shift["pa", "source"] - shift["pa", "xrii"]
    np.testing.assert_allclose(apart, (0.4, 0.0, -0.3), atol=0.3)  # both plates' own tolerances, 0.07 mm, and rotations
    assert all(p.manufacturing_mm < 0.035 for p in fitted.plates)  # drawn with 0.02 mm


def test_nothing_stated_and_nothing_repeated_is_refused():
    rng = np.random.default_rng(17)
    with pytest.raises(FrameError, match="sd_mm"):
        fit_frame(FRAME, [measured(made(rng), rng, stated=False)], STILL)


def test_a_plate_that_was_hardly_measured_is_refused():
    rng = np.random.default_rng(18)
    thin = measured(made(rng), rng).where(np.array([not i.startswith("ls") or i in ("ls0", "ls1", "ls2") for i in IDS]))
    with pytest.raises(FrameError, match="3 balls of the lateral source plate"):
        fit_frame(FRAME, [thin], STILL)


def test_series_that_share_too_little_are_refused():
    rng = np.random.default_rng(19)
    true = made(rng)
    pa = np.array([i[0] == "p" for i in IDS])
    halves = [measured(true, rng, "a").where(pa), measured(true, rng, "b").where(~pa)]
    with pytest.raises(FrameError, match="series b shares too few balls"):
        fit_frame(FRAME, halves, STILL)
    bridged = [halves[0], measured(true, rng, "b").where(~pa | np.isin(IDS, ["px0", "px2", "ps6"]))]
    np.testing.assert_allclose(positions(fit_frame(FRAME, bridged, STILL)), in_gauge(true), atol=0.06)


@pytest.mark.parametrize("keep", [(), ("px0",), ("px0", "px2")])
def test_too_few_balls_are_refused(keep):
    rng = np.random.default_rng(20)
    with pytest.raises(FrameError, match="three that"):
        fit_frame(FRAME, [measured(made(rng), rng).where(np.isin(IDS, keep))], STILL)


def test_wrong_diameters_are_named():
    rng = np.random.default_rng(21)
    series = measured(made(rng), rng)
    right = np.array([f.diameter_mm for f in FRAME.fiducials]) + 0.02
    assert fit_frame(FRAME, [replace(series, diameter_mm=right)], STILL).frame is not None
    wrong = right.copy()
    wrong[[2, 3]] = wrong[[3, 2]]
    said = failing(fit_frame(FRAME, [replace(series, diameter_mm=wrong)], STILL))["measured diameters"]
    assert "px2" in said
    assert "px3" in said


def test_plates_grow_to_the_temperature_of_use():
    rng = np.random.default_rng(22)
    series = [measured(made(rng), rng)]
    cold = positions(fit_frame(FRAME, series, STILL))
    told = Circumstances("07", "2024-05-17", 20.0, 30.0, 0.0)
    fitted = fit_frame(FRAME, series, told)
    assert fitted.frame is not None
    assert (fitted.frame.temperature_c, fitted.frame.serial, fitted.frame.measured_on) == (30.0, "07", "2024-05-17")
    for rows in (slice(0, 8), slice(8, 16)):
        middle = cold[rows].mean(axis=0)
        np.testing.assert_allclose(positions(fitted)[rows], middle + (1 + 7e-4) * (cold[rows] - middle), atol=2e-6)


def test_what_may_move_before_use_is_added():
    rng = np.random.default_rng(23)
    series = [measured(made(rng), rng)]
    still, drifting = (fit_frame(FRAME, series, told).frame for told in (STILL, Circumstances()))
    assert still is not None
    assert drifting is not None
    assert still.covariance_mm2 is not None
    assert drifting.covariance_mm2 is not None
    more = np.diag(drifting.covariance_mm2 - still.covariance_mm2)
    assert (more > 0.05**2 - 1e-9).all()
    assert more.max() < 0.0515**2  # 0.2 mrad over 57 mm reach 0.0114 mm


@pytest.mark.parametrize(
    ("told", "words"),
    [
        ({"use_temperature_c": 20.0}, "together with"),
        ({"temperature_c": 293.0}, "293 °C"),
        ({"drift_mm": -0.1}, "drift"),
        ({"drift_mm": float("nan")}, "drift"),
    ],
)
def test_circumstances_that_cannot_be(told, words):
    with pytest.raises(FrameError, match=words):
        Circumstances(**told)
