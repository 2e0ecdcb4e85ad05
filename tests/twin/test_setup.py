"""Set-ups: poses, the frame's errors, what projects where."""

from dataclasses import replace

import numpy as np
import pytest

from sightline.errors import OutsideRegionError, SetUpError, UnusableInputError
from sightline.frame import Frame
from sightline.twin import Variation, bead_images, draw_setup
from sightline.twin.xray.distributions import Pose
from sightline.twin.xray.setup import shadow_radius_px


def test_projection_is_the_ray_through_the_focal_point(frame):
    setup = draw_setup(np.random.default_rng(5), frame)
    for name, view in setup.views.items():
        xyz = setup.true_frame.view(name).source.xyz_mm
        on_detector = view.points_on_detector(view.project(xyz))
        a, b = xyz - view.focal_point_mm, on_detector - view.focal_point_mm
        miss = np.linalg.norm(np.cross(a, b), axis=-1) / np.linalg.norm(b, axis=-1)
        assert miss.max() < 1e-9


def test_the_source_stands_where_it_should(frame):
    rng = np.random.default_rng(6)
    for _ in range(10):
        setup = draw_setup(rng, frame)
        for name, view in setup.views.items():
            beam = frame.view(name).axis
            assert view.focal_point_mm @ beam == pytest.approx(-620.0, abs=25.0)
            assert view.detector.height_mm(view.focal_point_mm) == pytest.approx(-1000.0, abs=15.0)
            assert view.in_field(view.project(np.zeros(3)))


def test_an_unturned_pa_image_is_seen_from_the_source(frame):
    still = Variation(pose=Pose(frame_tilt=0.0, orbit=0.0, in_plane=0.0, hip_offset_mm=0.0))
    for side, lateral_is_right in (("right", True), ("left", False)):
        setup = draw_setup(np.random.default_rng(7), frame, side=side, variation=still)
        hip, lateral, caudal = setup.views["pa"].project(
            np.array([[0, 0, 0], [20.0, 0, 0], [0, 20.0 if side == "right" else -20.0, 0]])
        )
        assert (lateral[0] > hip[0]) == lateral_is_right
        assert caudal[1] > hip[1] + 50


def test_frame_errors_come_from_the_tolerances_given(frame):
    rng = np.random.default_rng(8)
    assert draw_setup(rng, frame, frame_errors=False).true_frame is frame
    only_beads = replace(
        frame, tolerances=replace(frame.effective_tolerances, plate_mm=0, plate_rad=0, arm_mm=0, arm_rad=0)
    )
    setup = draw_setup(rng, only_beads)
    moves = np.concatenate([setup.true_frame.view(v).xrii.xyz_mm - frame.view(v).xrii.xyz_mm for v in frame.views])
    assert moves.std() == pytest.approx(0.02, rel=0.15)  # 294 numbers: s.d. of the estimate 4 %


def test_bead_images_are_the_true_beads_with_the_noise_stated(frame):
    rng = np.random.default_rng(9)
    setup = draw_setup(rng, frame)
    view = setup.views["lateral"]
    ids, uv = bead_images(setup, "lateral", rng, sd_px=0.2)
    by_id = setup.true_frame.view("lateral").by_id
    true = view.project(np.array([by_id[i].xyz_mm for i in ids]))
    assert len(ids) > 0.6 * len(by_id)
    assert (uv - true).std() == pytest.approx(0.2, rel=0.2)
    assert view.in_field(true, 3.0).all()
    exact, clean = bead_images(setup, "lateral", rng, sd_px=0.0)
    assert exact == ids
    assert np.allclose(clean, true, atol=1e-12)


def test_shadow_radius_is_that_of_the_cone_of_tangent_rays(frame):
    setup = draw_setup(np.random.default_rng(10), frame)
    view, centre, radius = setup.views["pa"], np.array([12.3, -31.7, 150.0]), 2.5
    towards = centre - view.focal_point_mm
    distance = np.linalg.norm(towards)
    across = np.linalg.svd(towards[None])[2][1:]
    angle = np.linspace(0, 2 * np.pi, 73)[:-1, None]
    ring = centre + radius * (np.cos(angle) * across[0] + np.sin(angle) * across[1]) / np.sqrt(
        1 - (radius / distance) ** 2
    )
    rim = view.project(ring) - view.project(centre)
    area = 0.5 * abs(np.sum(rim[:, 0] * np.roll(rim[:, 1], -1) - rim[:, 1] * np.roll(rim[:, 0], -1)))
    estimate = shadow_radius_px(view, centre[None], np.array([radius]))[0]
    assert estimate == pytest.approx(np.sqrt(area / np.pi), rel=0.01)


@pytest.mark.parametrize("name", ["gamma", "biplane", "stereo"])
def test_every_built_in_frame_has_set_ups(name):
    frame, rng = Frame.load(name), np.random.default_rng(12)
    setup = draw_setup(rng, frame)
    for view in frame.views:
        assert len(bead_images(setup, view, rng)[0]) > 0.6 * len(frame.view(view).fiducials)


def test_bad_input(frame):
    rng = np.random.default_rng(11)
    with pytest.raises(SetUpError, match="'right' or 'left'"):
        draw_setup(rng, frame, side="both")
    with pytest.raises(UnusableInputError, match="9in-1k"):
        draw_setup(rng, frame, chain="flat")
    with pytest.raises(SetUpError, match="none of"):
        draw_setup(rng, frame, variation=Variation(pose=Pose(beads_in_field=1.01)))
    view = draw_setup(rng, frame).views["pa"]
    for wrong in (view.focal_point_mm - [0, 0, 50.0], np.array([np.nan, 0, 0])):
        with pytest.raises(OutsideRegionError):
            view.project(wrong)
