"""Wrong lengths of a frame file: what the balls' own size, the C-arm's distance and earlier images say of them."""

from dataclasses import replace

import numpy as np
import pytest
from tests.worked import Worked

import sightline as sl
from sightline.calibration import CArm, calibrate
from sightline.calibration.lengths import MAX_FLEX, BallSize, FocalLength, ball_size_check
from sightline.calibration.solids.calibrate_together import calibrate_together
from sightline.detection import Observations
from sightline.errors import UnusableInputError
from sightline.frame import Frame
from sightline.twin import SetUp, Variation, bead_images, draw_setup
from sightline.twin.xray.setup import shadow_radius_px

GAMMA = Frame.load("gamma")
BIAS = 1.012  # by which detection sees balls too large in the twin (calibration/lengths.py)


@pytest.fixture(scope="module")
def panel() -> SetUp:
    return draw_setup(np.random.default_rng(21), GAMMA, chain="flat-panel")


@pytest.fixture(scope="module")
def tube() -> SetUp:
    return draw_setup(np.random.default_rng(22), GAMMA, chain="9in-1k")


def measured(setup: SetUp, name: str = "pa", seed: int = 0, larger: float = BIAS) -> Observations:
    """Beads with 0.05 px noise, radii with 2 % of scatter: as seen, but where nothing tells what was rejected."""
    rng = np.random.default_rng(seed)
    ids, uv = bead_images(setup, name, rng, 0.05)
    known = {bead.id: bead for bead in setup.true_frame.fiducials_of(name)}
    xyz, mm = (np.array([getattr(known[i], what) for i in ids]) for what in ("xyz_mm", "diameter_mm"))
    radius = shadow_radius_px(setup.views[name], xyz, mm / 2) * larger * np.exp(0.02 * rng.standard_normal(len(ids)))
    covariance = np.repeat(0.0025 * np.eye(2)[None], len(ids), axis=0)
    shape = setup.views[name].chain.shape
    return Observations(name, tuple(ids), uv, covariance, image_shape=shape, radius_px=radius)


def told(factor: float = 1.0, source_by_mm: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Frame:
    """A file of another scale, its balls as they are; or with the source plate of the PA view elsewhere."""
    moved = set(GAMMA.view("pa").source.ids)

    def plate(one):
        places = [
            tuple((factor * np.array(f.xyz_mm) + (source_by_mm if f.id in moved else 0.0)).tolist())
            for f in one.fiducials
        ]
        return replace(one, fiducials=tuple(replace(f, xyz_mm=at) for f, at in zip(one.fiducials, places, strict=True)))

    views = {name: replace(v, xrii=plate(v.xrii), source=plate(v.source)) for name, v in GAMMA.views.items()}
    return replace(GAMMA, views=views)


def check(view, name: str):
    return next(one for one in view.checks if one.name == name)


@pytest.mark.parametrize("method", ["smooth", "localized"])
@pytest.mark.parametrize(
    ("factor", "passes"),
    [(0.5, False), (0.957, False), (0.97, True), (1.04, True), (1.08, False)],
)
def test_the_balls_tell_a_frame_file_of_another_scale(panel, method, factor, passes):
    found = check(calibrate(measured(panel), told(factor), method=method), "ball size")
    assert found.passed is passes
    assert found.figure == pytest.approx(100 * np.log(factor * BIAS), abs=0.8)  # 3 s.d. of the median
    assert ("larger" in found.sentence) == (factor * BIAS > 1)


def test_balls_that_look_smaller_in_both_images_are_better_evidence_than_in_one():
    """A harder beam makes them smaller in one image; blur and a display's curve enlarge them in all."""
    for larger, one, both in ((-0.024, True, False), (-0.021, True, True), (0.05, True, True), (0.065, False, False)):
        size = BallSize(larger, 0.0)
        assert [ball_size_check([size]).passed, ball_size_check([size, size]).passed] == [one, both]
    assert ball_size_check([BallSize(-0.027, 0.0), BallSize(-0.01, 0.0)]).passed


@pytest.mark.parametrize(("factor", "go"), [(1.0, True), (0.957, False)])
def test_rendered_balls_tell_a_file_that_is_4_percent_too_small(worked: Worked, factor, go):
    views = [calibrate(view.inputs.observations, told(factor)) for view in worked.views]
    first, second = (sl.Circle.through(rim) for rim in worked.rehearsal.head_rim)
    plan = sl.plan(views, *worked.wire_px.swapaxes(0, 1), procedure="free-wire", aids=sl.Aids(head=(first, second)))
    sizes = [one.passed for one in plan.verdict.checks if one.name == "ball size"]
    assert sizes == 3 * [go]  # in each image, and in both together


def test_the_balls_of_a_solid_tell_its_scale():
    block = Frame.load("block60")
    setup = draw_setup(np.random.default_rng(3), block)
    seen = [measured(setup, name) for name in setup.views]
    for factor, passes in ((1.0, True), (0.95, False)):
        scaled = block.with_beads_at(factor * block.xyz_mm)
        for view in calibrate_together(seen, scaled):
            found = check(view, "ball size")
            assert found.passed is passes
            assert found.figure == pytest.approx(100 * np.log(factor * BIAS), abs=2.5)  # 3 s.d. of the median of 16


def test_a_tilted_detector_and_distortion_do_not_change_the_balls_size(tube):
    """Detector and plates lie at up to 10° to each other, and the image is distorted by 5 %."""
    for name in ("pa", "lateral"):
        found = check(calibrate(measured(tube, name, larger=1.0), GAMMA), "ball size")
        assert found.figure == pytest.approx(0.0, abs=0.8)


def test_washers_and_beads_without_radii_say_nothing_of_size(panel):
    seen = measured(panel)
    assert "ball size" not in [one.name for one in calibrate(replace(seen, radius_px=None), GAMMA).checks]

    def plate(one):
        return replace(one, fiducials=tuple(replace(f, shape="washer") for f in one.fiducials))

    views = {name: replace(v, xrii=plate(v.xrii), source=plate(v.source)) for name, v in GAMMA.views.items()}
    assert "ball size" not in [one.name for one in calibrate(seen, replace(GAMMA, views=views)).checks]


def test_the_focal_length_is_that_of_the_detector_within_its_stated_error(panel):
    """On a flat panel the pinhole's, over 12 noises; its s.d. is that of the values."""
    view = panel.views["pa"]
    truth = abs(view.detector.height_mm(view.focal_point_mm)) / view.chain.pitch_mm
    found = [calibrate(measured(panel, seed=s), GAMMA).focal_length for s in range(12)]
    values = np.log([one.value_px for one in found])
    assert values.mean() == pytest.approx(np.log(truth), abs=3 * found[0].sd)  # the frame's errors, which all share
    assert values.std(ddof=1) == pytest.approx(np.sqrt(found[0].variance), rel=0.55)  # 2.5 s.d. of a s.d. of 12
    assert found[0].low_px <= found[0].value_px * 1.003
    assert found[0].high_px >= found[0].value_px * 0.997


def test_the_known_distance_tells_plates_at_another_distance_but_no_scale(panel):
    """1 mm between plates 150 mm apart is 0.66 % of the focal length; a scale leaves it as it is."""
    chain = panel.views["pa"].chain
    arm = CArm(chain.sdd_mm, chain.pitch_mm)
    seen = measured(panel)
    alone = calibrate(seen, GAMMA, c_arm=arm)
    stated = check(alone, "focal length")
    assert stated.passed
    assert stated.limit == pytest.approx(100 * (MAX_FLEX + 3.2905 * alone.focal_length.sd), rel=1e-4)  # 99.9 %
    assert f"up to {stated.limit:.1f} % may be flex" in stated.sentence
    for by_mm, passes in ((0.5, True), (4.0, False), (-4.0, False)):
        view = calibrate(seen, told(source_by_mm=(0.0, 0.0, by_mm)), c_arm=arm)
        assert check(view, "focal length").passed is passes
        change = np.log(view.focal_length.value_px / alone.focal_length.value_px)
        assert change == pytest.approx(-0.0066 * by_mm, rel=0.08)
    scaled = calibrate(seen, told(1.03), c_arm=arm)
    assert scaled.focal_length.value_px == pytest.approx(alone.focal_length.value_px, rel=1e-4)
    assert check(scaled, "focal length").passed


@pytest.mark.parametrize(("factor", "passes"), [(0.4, False), (0.97, True), (1.05, True), (1.2, False)])
def test_the_known_distance_bounds_that_to_the_plate(panel, factor, passes):
    """The plate is 920 mm from the source, the detector 1020 mm."""
    found = check(calibrate(measured(panel), told(factor), c_arm=CArm(1020.0)), "source distance")
    assert found.passed is passes
    assert found.figure == pytest.approx(920.0 * factor, rel=0.02)


def test_a_distorted_image_has_no_one_focal_length(tube):
    """The size of a pixel is the mean over the field: the middle's focal length alone would be 5 % off."""
    chain = tube.views["pa"].chain
    for name in ("pa", "lateral"):
        view = calibrate(measured(tube, name), GAMMA, c_arm=CArm(chain.sdd_mm, chain.pitch_mm))
        assert check(view, "focal length").passed
        assert view.focal_length.value_px * chain.pitch_mm < 0.985 * chain.sdd_mm
    assert not check(calibrate(measured(tube), GAMMA, c_arm=CArm(600.0, chain.pitch_mm)), "focal length").passed


def test_a_plate_that_moved_since_an_earlier_image_is_noticed(panel):
    """The source plate is 2.5 mm elsewhere, in truth, at the second image; other views and sizes are not compared."""
    first, again = (calibrate(measured(panel, seed=s), GAMMA) for s in (1, 2))
    later = calibrate(measured(panel, seed=3), told(source_by_mm=(0.0, 0.0, 2.5)))
    assert check(again.steady_since([first]), "focal length before").passed
    found = check(replace(later, frame_key=first.frame_key).steady_since([again, first]), "focal length before")
    assert not found.passed
    assert found.figure == pytest.approx(100 * 0.0066 * 2.5, rel=0.1)
    lateral = calibrate(measured(panel, "lateral"), GAMMA)
    other_size = replace(first, image_shape=(768, 768))
    for one in (lateral, other_size, later):
        assert again.steady_since([one]).checks == again.checks


@pytest.mark.parametrize("seed", range(2))
def test_a_c_arm_that_is_brought_anew_is_the_same(seed):
    """Its flex passes on a flat panel; what an intensifier's own magnification does is not judged."""
    rng = np.random.default_rng([31, seed])
    for chain, names in (("flat-panel", ["focal length before"]), ("9in-1k", [])):
        then = draw_setup(rng, GAMMA, chain=chain)
        anew = draw_setup(rng, GAMMA, chain=chain, variation=Variation(tube=then.tube))
        setups = then, replace(anew, true_frame=then.true_frame)
        first, later = (calibrate(measured(one, seed=k), GAMMA) for k, one in enumerate(setups))
        added = later.steady_since([first]).checks[len(later.checks) :]
        assert [one.name for one in added] == names and all(one.passed for one in added)


def test_without_an_image_the_middle_of_the_beads_counts(panel):
    seen = measured(panel)
    view = calibrate(replace(seen, image_shape=None), GAMMA, c_arm=CArm(1020.0, panel.views["pa"].chain.pitch_mm))
    assert check(view, "focal length").passed
    expected = FocalLength.of(view.joint, view.residuals.uv_px.mean(axis=0)).value_px
    assert view.focal_length.value_px == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize("lengths", [(0.0, None), (-5.0, None), (np.inf, None), (1000.0, 0.0), (1000.0, np.nan)])
def test_lengths_that_no_c_arm_has_are_refused(lengths):
    with pytest.raises(UnusableInputError, match="above zero"):
        CArm(*lengths)
