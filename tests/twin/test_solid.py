"""Set-ups of a solid on a flat panel: what stands where, how the cameras spread, and what is refused."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import ConvexHull
from tests.twin.test_render import coarse

from sightline.errors import SetUpError
from sightline.frame import Fiducial, Frame, RigidBody
from sightline.twin import SetUp, Variation, bead_images, draw_setup, hip_scene
from sightline.twin.anatomy.femur import LONG_HIGH_MM, Femur, to_cfcs
from sightline.twin.objects.things import Ball, frame_scene
from sightline.twin.scenes.hip_scene import draw_head
from sightline.twin.scenes.specimens import SetUpSpec, nominal_tags
from sightline.twin.xray.distributions import HipPlace, SolidPlace, beam_at
from sightline.twin.xray.render import expose
from sightline.twin.xray.setup import BEAMS, Handling, displaced, in_use

BLOCK = Frame.load("block60")
IDS = tuple(f"b{n}" for n in range(1, 17))


@pytest.fixture(scope="module")
def drawn() -> list[SetUp]:
    """Set-ups of both sides with three views."""
    rng = np.random.default_rng(61)
    return [draw_setup(rng, BLOCK, side=side, views=BEAMS) for side in ("right", "left") for _ in range(60)]


def _pinhole_mm(setup: SetUp, name: str) -> np.ndarray:
    """The principal point from the panel's middle, and the focal length (3,), mm."""
    view = setup.views[name]
    return np.array([*view.detector.to_plane(view.focal_point_mm), -view.detector.height_mm(view.focal_point_mm)])


def test_every_view_shows_every_ball_of_one_solid(drawn):
    rng = np.random.default_rng(62)
    for setup in drawn[::10]:
        by_id = setup.true_frame.xyz_mm_by_id
        for name, view in setup.views.items():
            ids, uv = bead_images(setup, name, rng, sd_px=0.0)
            assert ids == IDS
            centres = view.project(np.array([by_id[i] for i in ids]))
            off, out = uv - centres, centres - view.project(view.focal_point_mm + 500.0 * view.detector.normal)
            # the ellipse of a ball's shadow lies outwards of its centre's image, for 5 mm by 0.012 px at most
            assert (np.einsum("ij,ij->i", off, out) > 0).all()
            assert 0.005 < np.linalg.norm(off, axis=1).max() < 0.015
        assert setup.frame is BLOCK


def test_balls_err_alone_by_the_tolerance(drawn):
    moves = np.array([setup.true_frame.bodies[0].xyz_mm - BLOCK.bodies[0].xyz_mm for setup in drawn])
    assert moves.std() == pytest.approx(0.02, rel=0.04)  # 5760 numbers: s.d. of the estimate 1 %
    # The mean of 16 errors has a quarter of their s.d.; a shift of the whole block would add its own.
    assert moves.mean(axis=1).std() == pytest.approx(0.005, rel=0.2)


def test_the_hip_lies_beside_the_block_on_its_own_side(drawn):
    for setup in (drawn[0], drawn[-1]):
        caudal = 1.0 if setup.side == "right" else -1.0
        np.testing.assert_allclose(setup.hip_mm, [0.0, -76.8 * caudal, -22.4])
        assert np.linalg.norm(setup.hip_mm) == pytest.approx(80.0)
    near = Variation(place=SolidPlace(solid_mm=(30.0, 40.0, 0.0), aim=0.0))
    setup = draw_setup(np.random.default_rng(63), BLOCK, side="left", variation=near)
    np.testing.assert_allclose(setup.hip_mm, [-30.0, 40.0, 0.0])


def test_beams_pass_between_hip_and_block_at_their_angles(drawn):
    """Offsets of up to 10 mm per axis; s.d. of a beam's direction 3.6° per axis; the mean of 60 has 0.47°."""
    for side in ("right", "left"):
        chosen = [setup for setup in drawn if setup.side == side]
        for name, beam in BEAMS.items():
            aim = 0.6 * chosen[0].hip_mm  # 0.4 of the way from the hip to the block, which is the origin
            # the detector's sag shifts its middle by 4 mm per axis, so the axis is not drawn through that
            towards = np.array([-s.views[name].detector.height_mm(s.views[name].focal_point_mm) for s in chosen])
            assert towards.mean() == pytest.approx(1020.0, abs=2.0)
            middle = np.array([s.views[name].detector.origin_mm - s.views[name].focal_point_mm for s in chosen])
            middle /= np.linalg.norm(middle, axis=1)[:, None]
            assert np.degrees(np.linalg.norm(np.cross(middle.mean(axis=0), beam))) < 2.0
            source = np.array([s.views[name].focal_point_mm for s in chosen])
            reach = np.linalg.norm(aim - source, axis=1)
            assert abs(reach - 620.0).max() < 0.5  # 14 mm across 620 mm lengthen it by 0.16 mm
            across = np.linalg.norm(np.cross(aim - source, middle), axis=1)
            assert across.max() < 14.2 + 620 * 5 * 4.0 / 1020  # the offset, and 5 s.d. of the detector's sag


def test_a_panel_is_a_camera_as_spread_as_an_estimator_believes(drawn):
    """Focal length 3 mm (an estimator believes 10), principal point 5 mm: 360 cameras, s.d. of the estimates 4 %."""
    cameras = np.array([_pinhole_mm(setup, name) for setup in drawn for name in setup.views])
    assert cameras[:, 2].mean() == pytest.approx(1020.0, abs=0.7)
    assert cameras[:, 2].std() == pytest.approx(3.0, rel=0.15)
    assert cameras[:, :2].std() == pytest.approx(5.0, rel=0.12)
    panel = drawn[0].views["pa"].intensifier
    mm = np.array([[0.0, 0.0], [31.3, -77.1]])
    np.testing.assert_allclose(np.diff(panel.to_image(mm), axis=0), np.diff(mm, axis=0) / (298 / 1536), rtol=1e-9)


def test_the_block_hides_no_wire_and_no_shaft_ends_in_the_image(drawn):
    """Measured on 1500 set-ups: 90 % show the whole wire in both views (87 % in three), the block's shadow more than 10
    pixels off the wire in 98 % of them; 120 set-ups here, of which the wire shows in some 100: 3 s.d. are 4 %."""
    rng, femur = np.random.default_rng(64), Femur()
    low, high = -30.0 * np.ones(3), 30.0 * np.ones(3)
    corners = np.array(np.meshgrid(*zip(low, high, strict=True))).reshape(3, -1).T
    shown, free = [], []
    for setup in drawn:
        head = setup.hip_mm + draw_head(setup.side, femur, rng)
        entry, end = to_cfcs(np.stack(femur.wire_mm()), setup.side, head)
        wire = entry + np.linspace(0.0, 1.0, 20)[:, None] * (end - entry)
        shaft = femur.base_mm * [1.0, 0.0, 1.0] + [0.0, LONG_HIGH_MM[1], 0.0]
        shown.append(all(v.in_field(v.project(wire), HipPlace().margin_px).all() for v in setup.views.values()))
        free.append(all(_beside(v.project(wire), v.project(corners)) > 10.0 for v in setup.views.values()))
        for view in setup.views.values():
            assert not view.in_field(view.project(to_cfcs(shaft, setup.side, head)))
    assert np.mean(shown) > 0.8
    assert np.mean(np.array(free)[shown]) > 0.93


def _beside(uv_px: np.ndarray, outline_px: np.ndarray) -> float:
    """The least distance of points from a convex outline, negative inside."""
    sides = ConvexHull(outline_px).equations
    return float((uv_px @ sides[:, :2].T + sides[:, 2]).max(axis=1).min())


def test_any_beams_can_be_named():
    beams = {"a": beam_at(0.2), "b": 3.0 * beam_at(0.2 + np.radians(30.0))}
    setup = draw_setup(np.random.default_rng(65), BLOCK, views=beams)
    one, two = (-setup.views[name].detector.normal for name in beams)
    assert np.degrees(np.arccos(one @ two)) == pytest.approx(30.0, abs=12.0)
    assert list(setup.views) == ["a", "b"]


@pytest.mark.parametrize(
    ("name", "place"), [("block30", SolidPlace()), ("cube120", SolidPlace(solid_mm=(0.0, 0.0, 0.0)))]
)
def test_other_solids_have_set_ups_where_they_fit(name, place):
    """A cube of 120 mm fits alone: beside a hip it is cut off."""
    solid = Frame.load(name)
    setup = draw_setup(np.random.default_rng(69), solid, variation=Variation(place=place))
    for view in setup.views:
        assert bead_images(setup, view, np.random.default_rng(70))[0] == solid.bodies[0].ids


def test_the_block_is_a_cube_of_perspex_with_its_balls():
    scene = frame_scene(BLOCK)
    (block,) = scene.boxes
    np.testing.assert_allclose(block.half_mm, 30.0)
    np.testing.assert_allclose(block.centre_mm, 0.0, atol=1e-12)
    assert block.material == "pmma"
    assert [one.radius_mm for one in scene.solids] == [2.5] * 5 + [1.5] * 11
    assert all(isinstance(one, Ball) and one.within == "pmma" for one in scene.solids)


def test_the_image_shows_balls_in_a_darker_block(drawn):
    setup = drawn[1]
    view = coarse(setup.views["lateral"], 768)
    exposure = expose(view, frame_scene(setup.true_frame))
    at = np.rint(view.project(np.array([bead.xyz_mm for bead in setup.true_frame.fiducials]))).astype(int)
    assert (
        exposure.quanta[at[:, 1], at[:, 0]] < 0.75 * exposure.open_quanta[at[:, 1], at[:, 0]]
    ).all()  # 3 to 5 mm of steel; scatter fills the shadow
    middle = np.rint(view.project(np.zeros(3))).astype(int)
    inside, outside = (exposure.open_quanta[v, u] for u, v in (middle, np.rint(view.project([0, 0, 60.0])).astype(int)))
    assert inside < 0.6 * outside


def test_moves_go_to_balls_in_the_order_of_the_factor():
    moves = np.arange(48.0).reshape(16, 3)
    np.testing.assert_allclose(displaced(BLOCK, moves).bodies[0].xyz_mm, BLOCK.bodies[0].xyz_mm + moves)
    warm = in_use(BLOCK, Handling(warmer_k=10.0, drape_n=20.0)).bodies[0].xyz_mm
    xyz = BLOCK.bodies[0].xyz_mm
    np.testing.assert_allclose(warm - xyz, 700e-6 * (xyz - xyz.mean(axis=0)), atol=1e-12)  # no drape bends it


def test_an_image_of_a_block_has_the_tags_of_a_panel(drawn):
    tags = nominal_tags(drawn[0].views["lateral"], "right")
    assert tags.source_detector_mm == 1020.0
    assert tags.imager_pixel_spacing_mm == pytest.approx((0.194, 0.194), abs=1e-4)
    assert tags.intensifier_size_mm is None


@pytest.mark.slow
def test_the_body_and_the_bone_lie_at_the_hip(drawn):
    setup = replace(drawn[0], views={})
    hip = hip_scene(setup, np.random.default_rng(67))
    assert np.linalg.norm(hip.wire_mm.mean(axis=0) - setup.hip_mm) < 20.0
    assert hip.still.tissue is not None
    np.testing.assert_allclose(hip.still.tissue.centre_mm, [setup.hip_mm[0] - 35.0, setup.hip_mm[2] - 5.0])


def test_bad_input(frame):
    rng = np.random.default_rng(68)
    with pytest.raises(SetUpError, match="distortion of the intensifier of '9in-1k'"):
        draw_setup(rng, BLOCK, chain="9in-1k")
    with pytest.raises(SetUpError, match="those of its plates"):
        draw_setup(rng, frame, views=BEAMS)
    for beam in (np.zeros(3), np.array([np.nan, 0, 1.0]), np.ones(2)):
        with pytest.raises(SetUpError, match="three finite numbers"):
            draw_setup(rng, BLOCK, views={"pa": beam})
    with pytest.raises(SetUpError, match="three finite numbers"):
        draw_setup(rng, BLOCK, views={})
    with pytest.raises(SetUpError, match="along the body"):
        draw_setup(rng, BLOCK, views={"axial": np.array([0.0, 1.0, 0.0])}, variation=Variation())
    with pytest.raises(SetUpError, match="all beads"):
        draw_setup(rng, BLOCK, variation=Variation(place=SolidPlace(aim=-2.0)))
    with pytest.raises(SetUpError, match="all beads"):
        draw_setup(rng, Frame.load("cube120"))
    washer = RigidBody((Fiducial("w", (0.0, 0.0, 0.0), 5.0, shape="washer"),))
    with pytest.raises(SetUpError, match="washer 'w'"):
        frame_scene(Frame("washers", {}, solid=washer))


def test_a_specimen_has_a_third_image_of_a_block_only() -> None:
    drawn, shown = SetUpSpec(BLOCK, oblique=True).draw(np.random.default_rng(1), np.zeros((1, 3)))
    assert shown and list(drawn.views) == ["pa", "lateral", "oblique"]
    with pytest.raises(SetUpError, match="give views only for a solid"):
        SetUpSpec(Frame.load("gamma"), oblique=True).draw(np.random.default_rng(1), np.zeros((1, 3)))
