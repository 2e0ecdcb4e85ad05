"""Measured balls become a frame file, with their covariance; wrong measurements are refused."""

import re
from dataclasses import replace

import numpy as np
import pytest
from fit_scenes import FRAME, IDS, NOMINAL_MM, SD_MM, made, measured
from scipy.stats import chi2

from sightline.common.geometry.rigid import rigid_fit
from sightline.errors import FrameError
from sightline.frame import Frame, Tolerances
from sightline.frame.measured.fit import Circumstances, FittedFrame, fit_frame
from sightline.frame.tables import Series

STILL = Circumstances(drift_mm=0.0)
BLOCK = Frame.load("block60")


def failing(fitted: FittedFrame) -> dict[str, str]:
    assert fitted.frame is None
    return {check.name: check.sentence for check in fitted.checks if not check.passed}


def positions(fitted: FittedFrame) -> np.ndarray:
    assert fitted.frame is not None, failing(fitted)
    return fitted.frame.xyz_mm


def in_gauge(xyz_mm: np.ndarray) -> np.ndarray:
    """True places laid on the nominal frame, as the adjustment lays its own."""
    return rigid_fit(xyz_mm, NOMINAL_MM).apply(xyz_mm)


def squares(error: np.ndarray, covariance: np.ndarray) -> tuple[float, int]:
    """Squared Mahalanobis length in the directions that have an error, and their number."""
    values, vectors = np.linalg.eigh(covariance)
    kept = values > 1e-9 * values[-1]
    return float(((vectors.T @ error)[kept] ** 2 / values[kept]).sum()), int(kept.sum())


def series_of(rng: np.random.Generator, names: str = "1", **stated) -> tuple[np.ndarray, list[Series]]:
    true = made(rng)
    return true, [measured(true, rng, name, **stated) for name in names]


def exchanged(series: Series, names: dict[str, str]) -> Series:
    return replace(series, ids=tuple(names.get(i, i) for i in series.ids))


def displaced(series: Series, ball: str, by_mm) -> Series:
    xyz = series.xyz_mm.copy()
    xyz[series.ids.index(ball)] += by_mm
    return replace(series, xyz_mm=xyz)


def test_exact_measurements_give_the_frame_back_whole():
    true, series = series_of(np.random.default_rng(1), "12", sd_mm=0.0, stated=False)
    fitted = fit_frame(FRAME, [replace(each, covariance_mm2=1e-6 * np.eye(96)) for each in series], STILL)
    np.testing.assert_allclose(positions(fitted), in_gauge(true), atol=2e-6)  # six decimals are written
    assert fitted.adjusted.freedom == 90


def stretched(series: Series, rng: np.random.Generator) -> Series:
    """A series by an instrument whose x has a common scale error, which it states."""
    stretch = series.xyz_mm * np.array([2e-4, 0.0, 0.0])
    covariance = SD_MM**2 * np.eye(96) + np.outer(stretch, stretch)
    return replace(series, xyz_mm=series.xyz_mm + rng.standard_normal() * stretch, covariance_mm2=covariance)


@pytest.mark.parametrize(("names", "change"), [pytest.param("123", None, marks=pytest.mark.slow), ("1", stretched)])
def test_the_covariance_is_that_of_the_errors(names, change):
    """Pooled chi-square of 30 frames within what chance gives it 999 times in 1,000; rank all but the gauge's six."""
    rng, total = np.random.default_rng(2), 0.0
    for _ in range(30):
        true, series = series_of(rng, names)
        fitted = fit_frame(FRAME, [change(each, rng) for each in series] if change else series, STILL)
        square, rank = squares((positions(fitted) - in_gauge(true)).ravel(), fitted.frame.covariance_mm2)
        assert rank == 90
        total += square
    assert chi2.ppf(0.0005, 30 * 90) < total < chi2.ppf(0.9995, 30 * 90)


@pytest.mark.slow
def test_balls_that_were_not_measured_are_placed_with_the_error_that_they_then_have():
    rng, total, freedom = np.random.default_rng(4), 0.0, 0
    keep = np.array([i not in ("px1", "ls6", "ls7") for i in IDS])
    rows = np.repeat(~keep, 3)
    for _ in range(40):
        true, (series,) = series_of(rng)
        fitted = fit_frame(FRAME, [series.where(keep)], STILL)
        assert fitted.missing == ("px1", "ls6", "ls7")
        theirs = rigid_fit(true[keep], NOMINAL_MM[keep]).apply(true)
        error = (positions(fitted) - theirs).ravel()[rows]
        square, rank = squares(error, fitted.frame.covariance_mm2[np.ix_(rows, rows)])
        total, freedom = total + square, freedom + rank
    assert freedom == 40 * 9
    assert chi2.ppf(0.0005, freedom) < total < chi2.ppf(0.9995, freedom)


@pytest.mark.slow
@pytest.mark.parametrize("gone", [(), ("b3", "b12")])
def test_the_covariance_of_a_measured_block_is_that_of_its_errors(gone):
    """As for plates, also of balls that were not measured. A drift of plates adds nothing to a block."""
    rng, total, ids, nominal = np.random.default_rng(5), 0.0, BLOCK.solid.ids, BLOCK.xyz_mm
    keep = np.array([i not in gone for i in ids])
    for _ in range(30):
        true = nominal + 0.02 * rng.standard_normal(nominal.shape)
        fitted = fit_frame(BLOCK, [measured(true, rng, ids=ids).where(keep)], Circumstances(drift_mm=0.05))
        assert fitted.missing == gone
        error = positions(fitted) - rigid_fit(true[keep], nominal[keep]).apply(true)
        square, rank = squares(error.ravel(), fitted.frame.covariance_mm2)
        assert rank == 3 * len(ids) - 6
        total += square
    assert chi2.ppf(0.0005, 30 * rank) < total < chi2.ppf(0.9995, 30 * rank)


@pytest.mark.parametrize(
    ("change", "renamed", "check", "words"),
    [
        ({"px1": "px4", "px4": "px1"}, {"px1": "px4", "px4": "px1"}, "measured ids", "px1 and px4 are exchanged"),
        ({"px1": "ps2", "ps2": "lx3", "lx3": "px1"}, {"ps2": "px1", "lx3": "ps2", "px1": "lx3"}, "measured ids",
         "ps2 fits the place of px1"),
    ],
)  # fmt: skip
def test_wrong_ids_are_named_and_nothing_is_made_of_them(change, renamed, check, words):
    _, (series,) = series_of(np.random.default_rng(5))
    fitted = fit_frame(FRAME, [exchanged(series, change)], STILL)
    assert fitted.identified[0].renamed == renamed
    assert words in failing(fitted)[check]


def test_a_wrong_id_among_balls_that_were_not_measured_a_mirrored_series_and_a_wrong_number_are_named():
    _, (series,) = series_of(np.random.default_rng(7))
    some = series.where(np.array([i != "px5" for i in IDS]))
    assert fit_frame(FRAME, [exchanged(some, {"px2": "px5"})], STILL).identified[0].renamed == {"px5": "px2"}
    fitted = fit_frame(FRAME, [replace(series, xyz_mm=series.xyz_mm * np.array([1.0, -1.0, 1.0]))], STILL)
    assert fitted.identified[0].mirrored
    assert "mirror image" in failing(fitted)["measured ids"]
    (identified,) = fit_frame(FRAME, [displaced(series, "px4", (20.0, 0.0, 9.0))], STILL).identified
    assert identified.astray_mm == {"px4": pytest.approx(np.hypot(20, 9), abs=0.6)}


def test_wrong_balls_of_a_block_are_named():
    rng = np.random.default_rng(7)
    series = measured(BLOCK.xyz_mm + 0.02 * rng.standard_normal(BLOCK.xyz_mm.shape), rng, ids=BLOCK.solid.ids)
    for change, check, words in (
        (exchanged(series, {"b2": "b9", "b9": "b2"}), "measured ids", "b2 and b9 are exchanged"),
        (replace(series, xyz_mm=series.xyz_mm * [1, 1, -1]), "measured ids", "mirror image"),
        (displaced(series, "b5", (0.5, 0.0, 0.0)), "measured deviation", "b5"),
    ):
        assert words in failing(fit_frame(BLOCK, [change], Circumstances()))[check]


def test_a_block_expands_about_its_middle_and_shows_its_growth():
    """3 K of PMMA from measurement to use; a print 0.3 % too large is found as growth."""
    series = measured(1.003 * BLOCK.xyz_mm, np.random.default_rng(6), ids=BLOCK.solid.ids)
    free = replace(BLOCK, tolerances=replace(BLOCK.effective_tolerances, bead_mm=0.2))
    fitted = fit_frame(free, [series], Circumstances(temperature_c=20.0, use_temperature_c=23.0))
    (body,) = fitted.plates
    assert body.growth_ppm == pytest.approx(3000, abs=4 * 1e6 * SD_MM / 100)  # 16 balls within 50 mm of the middle
    assert body.across_rms_mm is None and body.in_plane_rms_mm < 3 * SD_MM
    np.testing.assert_allclose(np.ptp(positions(fitted), axis=0), 1.003 * (1 + 3 * 70e-6) * 53, atol=6 * SD_MM)
    assert fitted.frame.temperature_c == 23.0


@pytest.mark.parametrize(
    ("change", "words"),
    [
        *((lambda s, scale=scale: [replace(s, xyz_mm=scale * s.xyz_mm)], unit)
          for scale, unit in ((1e-3, "metres"), (1 / 25.4, "inches"), (0.1, "centi"), (1e3, "micro"))),
        (lambda s: [exchanged(s, dict(zip(IDS, np.random.default_rng(11).permutation(IDS).tolist(), strict=True)))],
         "are those of this frame"),
        (lambda s: [replace(s, covariance_mm2=None)], "sd_mm"),
        (lambda s: [s.where(np.array([i[:2] != "ls" or i[2] in "012" for i in IDS]))],
         "3 balls of the lateral source plate"),
        (lambda s: [s.where(np.array([i[0] == side for i in IDS])) for side in "pl"], "shares too few balls"),
        *((lambda s, keep=keep: [s.where(np.isin(IDS, keep))], "three that") for keep in ([], ["px0"], ["px0", "px2"])),
    ],
)  # fmt: skip
def test_measurements_that_determine_no_frame_are_refused(change, words):
    _, (series,) = series_of(np.random.default_rng(10))
    with pytest.raises(FrameError, match=words):
        fit_frame(FRAME, change(series), STILL)


def test_balls_of_one_plane_do_not_determine_a_block():
    flatten = np.where(np.arange(16) < 6, 0.0, 1.0)[:, None] * [0, 0, 1] + [1, 1, 0]
    flat = BLOCK.with_beads_at(BLOCK.xyz_mm * flatten)
    series = measured(flat.xyz_mm, np.random.default_rng(8), ids=BLOCK.solid.ids).where(np.arange(16) < 6)
    with pytest.raises(FrameError, match=r"6 balls of the solid were measured; .* do not lie in one plane"):
        fit_frame(flat, [series], Circumstances())


def test_series_that_share_three_balls_are_joined():
    true, (a, b) = series_of(np.random.default_rng(19), "ab")
    pa = np.array([i[0] == "p" for i in IDS])
    bridged = [a.where(pa), b.where(~pa | np.isin(IDS, ["px0", "px2", "ps6"]))]
    np.testing.assert_allclose(positions(fit_frame(FRAME, bridged, STILL)), in_gauge(true), atol=0.06)


def test_a_ball_that_sits_wrong_is_taken_once_two_series_see_it():
    rng = np.random.default_rng(12)
    true = made(rng)
    true[13] += (0.3, -0.2, 0.0)
    assert "ps5" in failing(fit_frame(FRAME, [measured(true, rng)], STILL))["measured deviation"]
    twice = fit_frame(FRAME, [measured(true, rng, name) for name in "ab"], STILL)
    np.testing.assert_allclose(positions(twice), in_gauge(true), atol=5 * SD_MM)


def test_a_frame_made_less_exactly_than_its_file_says_is_told_its_tolerance_and_a_wrong_number_apart_from_it():
    rng = np.random.default_rng(23)
    true = BLOCK.xyz_mm + 0.08 * rng.standard_normal(BLOCK.xyz_mm.shape)
    once, again = (measured(true, rng, name, sd_mm=0.02, ids=BLOCK.solid.ids) for name in "ab")
    ((name, sentence),) = failing(fit_frame(BLOCK, [once], STILL)).items()
    assert name == "measured tolerance" and "frame new NEW.json --like block60 --bead-sd 0.0" in sentence
    told = float(sentence.partition("--bead-sd ")[2].partition(",")[0])
    assert told == pytest.approx(0.08, rel=0.5)  # of the median of 16 balls: 17 % s.d. over 100 seeds
    stated = replace(BLOCK, tolerances=Tolerances(bead_mm=told))
    assert fit_frame(stated, [once], STILL).frame is not None
    assert fit_frame(BLOCK, [once, again], STILL).frame is not None  # a second series confirms the places
    wrong = failing(fit_frame(BLOCK, [displaced(once, "b7", (1.0, 0.0, 0.0))], STILL))
    assert set(wrong) == {"measured tolerance", "measured deviation"}
    assert re.search(r"in brackets\): b7 \([\d.]+\)\. A number is wrong", wrong["measured deviation"])


def test_of_three_series_the_wrong_one_is_left_out_and_of_two_neither_is_used():
    true, series = series_of(np.random.default_rng(13), "abc")
    series[1] = displaced(series[1], "lx2", 0.2 / np.sqrt(3))
    fitted = fit_frame(FRAME, series, STILL)
    assert fitted.adjusted.left_out == (("b", "lx2"),)
    np.testing.assert_allclose(positions(fitted), in_gauge(true), atol=5 * SD_MM)
    assert "Measure lx2 once more" in failing(fit_frame(FRAME, series[:2], STILL))["measured series"]


@pytest.mark.parametrize("stated", [True, False])
def test_repeats_show_the_instrument_whether_it_is_stated_or_not(stated):
    _, series = series_of(np.random.default_rng(14), "0123", stated=stated)
    adjusted = fit_frame(FRAME, series, STILL).adjusted
    assert adjusted.instrument_mm == pytest.approx(SD_MM, rel=0.15)  # 270 degrees of freedom: 4.3 % s.d.
    assert np.sqrt(np.diag(adjusted.covariance_mm2).mean()) == pytest.approx(SD_MM / 2, rel=0.2)


def test_an_instrument_with_a_larger_error_than_stated_is_refused():
    _, series = series_of(np.random.default_rng(15), "ab")
    small = [replace(each, covariance_mm2=each.covariance_mm2 / 4) for each in series]
    assert "State the larger error" in failing(fit_frame(FRAME, small, STILL))["measured series"]


def test_displaced_plates_are_distinguished_from_displaced_balls():
    rng = np.random.default_rng(16)
    true = made(rng)
    true[8:16] += (0.4, 0.0, -0.3)
    fitted = fit_frame(FRAME, [measured(true, rng)], STILL)
    shift = {(p.view, p.plate): p.shift_mm for p in fitted.plates}
    apart = shift["pa", "source"] - shift["pa", "xrii"]
    np.testing.assert_allclose(apart, (0.4, 0.0, -0.3), atol=0.3)  # both plates' own tolerances, 0.07 mm, and rotations
    assert fitted.frame is not None
    assert all(p.manufacturing_mm < 0.035 for p in fitted.plates)  # drawn with 0.02 mm


def test_wrong_diameters_are_named():
    _, (series,) = series_of(np.random.default_rng(21))
    right = np.array([f.diameter_mm for f in FRAME.fiducials]) + 0.02
    assert fit_frame(FRAME, [replace(series, diameter_mm=right)], STILL).frame is not None
    wrong = right.copy()
    wrong[[2, 3]] = wrong[[3, 2]]
    sentence = failing(fit_frame(FRAME, [replace(series, diameter_mm=wrong)], STILL))["measured diameters"]
    assert "px2" in sentence and "px3" in sentence


def test_plates_grow_to_the_temperature_of_use():
    _, series = series_of(np.random.default_rng(22))
    cold = positions(fit_frame(FRAME, series, STILL))
    fitted = fit_frame(FRAME, series, Circumstances("07", "2024-05-17", 20.0, 30.0, 0.0))
    warm = positions(fitted)
    assert (fitted.frame.temperature_c, fitted.frame.serial, fitted.frame.measured_on) == (30.0, "07", "2024-05-17")
    for rows in (slice(0, 8), slice(8, 16)):
        middle = cold[rows].mean(axis=0)
        np.testing.assert_allclose(warm[rows], middle + (1 + 7e-4) * (cold[rows] - middle), atol=2e-6)


def test_what_may_move_before_use_is_added():
    _, series = series_of(np.random.default_rng(23))
    still, drifting = (fit_frame(FRAME, series, told).frame for told in (STILL, Circumstances()))
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
