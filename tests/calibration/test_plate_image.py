"""Images of a solid on an intensifier with a plate on its detector: derivatives, stated errors, what is refused."""

from dataclasses import replace

import numpy as np
import pytest
from calibration_scenes import choose
from scipy.stats import chi2
from tests.calibration.solid_scenes import camera

import sightline as sl
from sightline.calibration import CArm, calibrate
from sightline.calibration.solids.adjustment import image_of, solid_of
from sightline.calibration.solids.calibrate_together import adjustment_of, calibrate_together
from sightline.calibration.solids.images import MIN_PLATE_BALLS
from sightline.common.checks import failed
from sightline.errors import CalibrationRefusedError
from sightline.frame import Frame, Plate, Tolerances
from sightline.studies.scenes import draw_scene, measure
from sightline.twin import draw_setup

FRAME = replace(Frame.load("block40+detector-plate"), tolerances=Tolerances(0.02, 0.0, 0.0, 0.0, 0.0))
PICK_PX = 0.1


def _drawn(seed, **drawn):
    """Views of a scene, and the scene."""
    rng = np.random.default_rng(seed)
    scene = draw_scene(rng, FRAME, 0.1, targets=1, reach_mm=0.0, **drawn)
    arms = [CArm(view.chain.sdd_mm) for view in scene.setup.views.values()]
    return calibrate_together(list(scene.observations.values()), FRAME, arms), scene, rng


def _image(rng):
    solid = solid_of(FRAME)
    seen = measure(rng, draw_setup(rng, FRAME), 0.1)["pa"]
    return image_of(seen, FRAME, solid, CArm(1000.0)), solid


def test_derivatives_of_the_shadows_on_the_plate_are_those_of_differences():
    """The plate's balls lie up to 1 mm off their plane here, so that the camera moves their shadows too."""
    rng = np.random.default_rng(1)
    image, solid = _image(rng)
    off = np.zeros_like(solid.xyz_mm)
    off[solid.count :, 2] = rng.uniform(-1.0, 1.0, len(off) - solid.count)
    solid = replace(solid, xyz_mm=solid.xyz_mm + off)
    one = replace(camera(rng, "pa", mirrored=True), focal_px=980.0, centre_px=np.array([3.0, -2.0]))
    rows, e = image.rows, rng.standard_normal(solid.factor.shape[1])
    model = image.shadows(one, solid, e, rows)
    for k, size in enumerate((1e-6, 1e-6, 1e-6, 1e-3, 1e-3, 1e-3, 1e-6, 1e-3, 1e-3)):
        step = size * np.eye(9)[k]
        there, back = (image.shadows(one.moved(sign * step), solid, e, rows).at for sign in (1, -1))
        np.testing.assert_allclose(model.by_camera[:, :, k], (there - back) / (2 * size), rtol=1e-5, atol=1e-5)
    for k in (5, 3 * solid.count + 1, 3 * solid.count + 2):
        step = 1e-2 * np.eye(len(e))[k]
        there, back = (image.shadows(one, solid, e + sign * step, rows).at for sign in (1, -1))
        np.testing.assert_allclose(model.by_e[:, :, k], (there - back) / 2e-2, rtol=1e-5, atol=1e-9)


def test_the_data_are_blind_to_cubics_and_white_otherwise():
    image, _ = _image(np.random.default_rng(2))
    contrasts = image._contrasts
    assert contrasts.shape == (2 * len(image.rows) - 20, 2 * len(image.rows))
    np.testing.assert_allclose(contrasts @ image._design, 0.0, atol=1e-8)
    np.testing.assert_allclose(contrasts @ image._covariance @ contrasts.T, np.eye(len(contrasts)), atol=1e-8)


def test_pixels_of_balls_are_mapped_to_their_shadows_and_back():
    """To 0.1 mm, five times the error of a ball; back to the pixel to 1e-3 px, 1e-4 of the map's error there."""
    (pa, lateral), scene, _ = _drawn(3)
    for view in (pa, lateral):
        truth = scene.setup.views[view.name]
        shadows = view.plane.central_projection(truth.focal_point_mm, scene.setup.hip_mm[None])
        uv = truth.project(scene.setup.hip_mm[None])
        np.testing.assert_allclose(view.plane_map.to_plane(uv), shadows, atol=0.3)
        np.testing.assert_allclose(view.plane_map.to_image(view.plane_map.to_plane(uv)), uv, atol=1e-3)
        np.testing.assert_allclose(view.project(scene.setup.hip_mm[None]), uv, atol=2.0)
        # The plate's balls stand where this view puts them: 380 mm behind the block, 10 mm s.d. along the beam.
        places = {f.id: np.array(f.xyz_mm) for f in view.fiducials}
        true = {f.id: np.array(f.xyz_mm) for f in scene.setup.frame_in(view.name).fiducials}
        across = np.cross(places["d-5-5"] - true["d-5-5"], truth.detector.normal)
        assert np.linalg.norm(across) < 15.0 and not failed(view.checks)


@pytest.mark.slow
def test_the_stated_error_of_a_target_is_the_scatter_about_the_truth():
    """20 set-ups: the mean of the squared Mahalanobis length of three coordinates is 3 ± 4 s.d. of such a mean."""
    squares, chi_squares, away = [], [], []
    for seed in range(20):
        views, scene, rng = _drawn(seed)
        uv = scene.target_px + PICK_PX * rng.standard_normal(scene.target_px.shape)
        found = sl.reconstruct(views, uv, np.broadcast_to(PICK_PX**2 * np.eye(2), (2, 1, 2, 2)))
        off = (found.xyz_mm - scene.target_mm)[0]
        squares.append(off @ np.linalg.solve(found.covariance_mm2[0], off))
        chi_squares.append(next(c.figure for c in views[0].checks if c.name == "chi-square"))
        away.append(off @ off)
    assert abs(np.mean(squares) - 3.0) < 4 * np.sqrt(6.0 / 20)
    assert np.mean(np.array(squares) < chi2.ppf(0.95, 3)) > 0.95 - 3.5 * np.sqrt(0.95 * 0.05 / 20)
    assert abs(np.mean(chi_squares) - 1.0) < 0.07
    assert np.sqrt(np.mean(away)) < 0.12


def test_what_views_share_are_balls_and_not_the_map():
    """The same numbers in both views; the map's error is positive and its own, so that it is not in `shared`."""
    (pa, lateral), scene, _ = _drawn(4)
    one, other = (view.lines_of_sight(uv) for view, uv in zip((pa, lateral), scene.target_px, strict=True))
    assert one.sources_shared_with(other) == ["beads", "focal_point", "frame"]
    for lines in (one, other):
        for source, response in lines.shared.items():
            np.testing.assert_allclose(response @ response.T, lines.covariance[source], atol=1e-12)
        assert np.trace(lines.covariance["map"][3:, 3:]) > 0
        assert not lines.covariance["map"][:3].any()


def test_a_wrong_ball_is_left_out_by_name():
    """One of the plate and one of the solid, 1 px off: ten standard deviations. At the plate's rim the map follows."""
    _, scene, _ = _drawn(5)
    given = list(scene.observations.values())
    uv = given[0].uv_px.copy()
    of_plate = next(k for k, name in enumerate(given[0].ids) if name in ("d-4-5", "d-5-5"))
    uv[[2, of_plate]] += [[0.7, -0.7], [-0.7, 0.7]]
    views = calibrate_together([replace(given[0], uv_px=uv), given[1]], FRAME, [CArm(1000.0)] * 2)
    assert set(views[0].residuals.left_out) == {given[0].ids[2], given[0].ids[of_plate]}
    assert not views[1].residuals.left_out


def test_a_flat_panels_image_with_the_plate_fails_with_the_evidence():
    views, _, _ = _drawn(6, chain="flat-panel")
    for view in views:
        (check,) = (one for one in view.checks if one.name == "intensifier distortion")
        assert not check.passed and check.figure < 0.7 and "flat panel" in check.sentence
    views, _, _ = _drawn(6)
    for view in views:
        (check,) = (one for one in view.checks if one.name == "intensifier distortion")
        assert check.passed and check.figure > 4.0


def test_an_intensifiers_image_of_the_block_alone_fails_with_the_evidence():
    """Or the images cannot be adjusted at all."""
    _, scene, _ = _drawn(7)
    alone = replace(FRAME, detector=None, name="block40")
    given = [choose(seen, alone.solid.ids.__contains__) for seen in scene.observations.values()]
    try:
        views = calibrate_together(given, alone, [CArm(1000.0, 0.21)] * 2)
    except CalibrationRefusedError as refusal:
        assert "plate on the detector" in str(refusal) or "contradict the others" in str(refusal)
    else:
        assert any("panel distortion" in [check.name for check in failed(view.checks)] for view in views)


def test_too_few_balls_and_a_plate_put_on_back_to_front_are_refused():
    rng = np.random.default_rng(8)
    seen = measure(rng, draw_setup(rng, FRAME), 0.1)["pa"]
    of_plate = [name for name in seen.ids if name in FRAME.detector.ids]
    with pytest.raises(CalibrationRefusedError, match="11 balls of the plate"):
        calibrate(choose(seen, lambda name: name not in of_plate[MIN_PLATE_BALLS - 1 :]), FRAME)
    with pytest.raises(CalibrationRefusedError, match="0 balls of the solid"):
        calibrate(choose(seen, of_plate.__contains__), FRAME)
    turned = tuple(replace(f, xyz_mm=(-f.xyz_mm[0], *f.xyz_mm[1:])) for f in FRAME.detector.fiducials)
    with pytest.raises(CalibrationRefusedError, match="the right way round"):
        calibrate(seen, replace(FRAME, detector=Plate(turned)), c_arm=CArm(1000.0))
    assert adjustment_of(calibrate(seen, FRAME)).images[0].unit == "mm"
