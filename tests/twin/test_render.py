"""Images: balls where they project to, noise as its physics has it, the same again from the same seed."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from scipy.stats import norm

from sightline.errors import SetUpError
from sightline.frame import Frame
from sightline.imaging.volumes.beam import THREE, WEIGHTS, attenuation_per_mm, spectrum
from sightline.twin import DOSES, Dose, Scene, Variation, draw_setup, render, shown_hip_scene
from sightline.twin.objects.things import Ball, Box, Rod, frame_boxes, frame_solids
from sightline.twin.xray.distributions import Pose
from sightline.twin.xray.presets import preset
from sightline.twin.xray.render import (
    ELECTRONIC_SD,
    HIP_MM,
    MAX_TISSUE_MM,
    expose,
    pixel_rays,
    primary,
    render_views,
    tissue_mm,
)
from sightline.twin.xray.setup import shadow_centres_px, shadow_radius_px

CHAIN = preset("9in-1k")


@pytest.fixture(scope="module")
def setup(frame):
    return draw_setup(np.random.default_rng(31), frame)


@pytest.fixture(scope="module")
def bare(setup):
    return expose(setup.views["pa"], Scene(), DOSES["medium"])


@pytest.fixture(scope="module")
def frame_exposure(setup):
    return expose(setup.views["pa"], Scene(solids=frame_solids(setup.true_frame)))


def test_ball_centres_are_where_they_project_to(setup, frame_exposure):
    """Centroid, on the input plane, of what a ball takes from the image before noise: within 0.02 px.

    In the image itself it is not: distortion bends a shadow, see the next test."""
    view = setup.views["pa"]
    misses = [view.intensifier.to_image(on_plane) - at for _, at, on_plane, _ in _shadows(setup, frame_exposure)]
    assert len(misses) > 10
    assert np.abs(misses).max() < 0.02


def test_distortion_moves_a_shadow_as_its_outline_says(setup, frame_exposure):
    """Centroids in the image lie where the outline's does to 0.015 px (a ball is darkest in its middle: its centroid
    moves a little less), and outside the image of the centre by less than 0.1 px."""
    view = setup.views["pa"]
    shadows = list(_shadows(setup, frame_exposure))
    at, centroid = (np.array([one[k] for one in shadows]) for k in (1, 3))
    by_place = {tuple(uv): bead for bead, uv in _beads(setup)}
    beads = [by_place[tuple(one)] for one in at]
    xyz, radius = np.array([b.xyz_mm for b in beads]), np.array([b.diameter_mm / 2 for b in beads])
    outline = shadow_centres_px(view, xyz, radius)
    assert np.abs(centroid - outline).max() < 0.015
    outward = ((outline - at) * (at - view.intensifier.centre_px)).sum(axis=-1)
    assert (outward > 0).mean() > 0.8
    assert 0.02 < np.linalg.norm(outline - at, axis=-1).max() < 0.1


def _beads(setup):
    plate = setup.true_frame.view("pa").xrii
    return list(zip(plate.fiducials, setup.views["pa"].project(plate.xyz_mm), strict=True))


def _shadows(setup, exposure):
    """Radius (mm), true pixel, centroid on the input plane (mm) and in the image of the balls that stand alone."""
    view, plate = setup.views["pa"], setup.true_frame.view("pa").xrii
    every = view.project(np.concatenate([setup.true_frame.view("pa").source.xyz_mm, plate.xyz_mm]))
    taken = 1 - exposure.quanta / np.where(exposure.open_quanta > 0, exposure.open_quanta, 1)
    for bead, at in _beads(setup):
        reach = shadow_radius_px(view, np.array([bead.xyz_mm]), np.array([bead.diameter_mm / 2]))[0] + 4
        if np.sort(np.linalg.norm(every - at, axis=-1))[1] < 3 * reach or not view.in_field(at, reach + 2):
            continue
        u, v = np.meshgrid(*[np.arange(np.rint(c) - int(reach), np.rint(c) + int(reach) + 1) for c in at])
        part = taken[v.astype(int), u.astype(int)] * (np.hypot(u - at[0], v - at[1]) < reach)
        pixels = np.stack([u, v], -1)[part > 0]
        weight = part[part > 0]
        xi = view.intensifier.to_detector(pixels)
        on_plane = weight / np.linalg.det(view.intensifier.jacobian(xi))
        yield bead.diameter_mm / 2, at, on_plane @ xi / on_plane.sum(), weight @ pixels / weight.sum()


def test_a_ball_takes_what_steel_takes(setup):
    """Middle of a 5 mm ball in a PMMA plate, three energies, before scatter and blur."""
    view = setup.views["pa"]
    scene = Scene(solids=(Ball((0.0, 0.0, 150.0), 2.5),))
    exposure = expose(replace_chain(view, scatter_to_primary=0.0), scene)
    u, v = np.rint(view.project(np.array([0.0, 0.0, 150.0]))).astype(int)
    left = exposure.quanta[v, u] / exposure.open_quanta[v, u]
    excess = attenuation_per_mm("steel") - attenuation_per_mm("pmma")
    assert left == pytest.approx(float(WEIGHTS @ np.exp(-5.0 * excess)), rel=0.01)


def coarse(view, side=256):
    """The view by a chain with larger pixels: what scatters is told in mm."""
    return replace_chain(view, shape=(side, side), mask_px=0.494 * side)


def replace_chain(view, **changes):
    tube = view.intensifier
    return replace(view, intensifier=type(tube)(replace(tube.chain, **changes), tube.distortion, tube.prior))


@pytest.mark.parametrize("beam", [THREE, "70kVp-3Al"])
def test_tissue_of_a_transmission_is_the_tissue_that_leaves_it(beam):
    """Between the table's entries, to 0.05 mm; thicker things count as the thickest."""
    mm = np.array([0.0, 3.3, 101.7, 250.4, 599.0])
    left = np.exp(-mm[:, None] * attenuation_per_mm("tissue", beam)) @ spectrum(beam).weights
    assert tissue_mm(left, beam) == pytest.approx(mm, abs=0.05)
    assert tissue_mm(np.array([0.0, 1e-30, 1.0]), beam) == pytest.approx([MAX_TISSUE_MM, MAX_TISSUE_MM, 0.0])


def test_scatter_follows_what_lies_in_the_beam(setup):
    """Behind a ball in an open beam nothing is scattered, behind one in a block of tissue the share of its thickness.

    A block far wider than scatter reaches; the ball takes a little of what scatters."""
    view = coarse(setup.views["pa"])
    ball = Ball((0.0, 0.0, 0.0), 4.0, within=None)
    u, v = np.rint(view.project(np.zeros(3))).astype(int)
    alone = expose(replace_chain(view, scatter_to_primary=0.0), Scene(solids=(ball,)))
    steel = alone.quanta[v, u] / alone.open_quanta[v, u]
    for thick_mm in (0.0, 40.0, 250.0):
        block = Box(np.array([0.0, 0.0, -100.0]), np.eye(3), np.array([300.0, 300.0, thick_mm / 2]), "tissue")
        scene = Scene(solids=(ball,), boxes=(block,) if thick_mm else ())
        for even, share in ((False, 0.6 * thick_mm / HIP_MM), (True, 0.6)):
            seen = expose(view, scene, even_scatter=even)
            expected = (steel + share) / (1 + share)
            assert seen.quanta[v, u] / seen.open_quanta[v, u] == pytest.approx(expected, abs=0.03), (thick_mm, even)


@pytest.mark.slow
def test_a_drawn_hip_has_the_chain_s_scatter_in_the_mean_of_its_views():
    """Against even scatter: the light in the middle of both views, to 10 %; less in PA, more in the lateral view."""
    setup, hip = shown_hip_scene(np.random.default_rng(4), Frame.load("gamma"))
    middle = (slice(96, 160), slice(96, 160))
    shares = []
    for name in ("pa", "lateral"):
        view = coarse(setup.views[name])
        rays, area = pixel_rays(view)
        arriving, without = primary(view, hip.scene, rays)
        hidden = ((without - arriving) * area)[middle]
        light = []
        for even in (False, True):
            seen = expose(view, hip.scene, even_scatter=even)
            scale = (seen.open_quanta - seen.quanta)[middle].sum() / hidden.sum()
            light.append((seen.quanta / scale - arriving * area)[middle].mean())
        shares.append(light[0] / light[1])
    assert shares[0] < 1 < shares[1]
    assert np.mean(shares) == pytest.approx(1.0, abs=0.1)


def test_plates_show_where_they_are(setup, bare):
    view = setup.views["pa"]
    boxes = frame_boxes(setup.true_frame)
    assert len(boxes) == 4
    assert all(isinstance(box, Box) for box in boxes)
    plated = expose(view, Scene(boxes=boxes[:1]))
    corners = boxes[0].centre_mm + np.array([[0.97, 0.0], [1.03, 0.0]]) * boxes[0].half_mm[:2] @ boxes[0].axes[:2]
    shade = plated.quanta / np.where(bare.quanta > 0, bare.quanta, 1)
    (u_in, v_in), (u_out, v_out) = np.rint(view.project(corners)).astype(int)
    assert view.in_field(np.array([u_out, v_out]))
    taken = float(WEIGHTS @ np.exp(-8.0 * attenuation_per_mm("pmma")))
    assert shade[v_in, u_in] / shade[v_out, u_out] == pytest.approx(taken, abs=0.02)  # 3 % of scatter in both


def test_counts_are_those_of_the_dose(bare):
    for dose, quanta in ((DOSES["low"], 15.1), (DOSES["medium"], 121.0), (Dose(0.11, 1), 3.8)):
        assert dose.quanta(CHAIN) == pytest.approx(quanta, rel=0.01)
    u, v = np.meshgrid(np.arange(1024) - 511.5, np.arange(1024) - 511.5)
    middle = np.hypot(u, v) < 253
    assert bare.quanta[middle].mean() == pytest.approx(DOSES["medium"].quanta(CHAIN), rel=0.01)


@pytest.fixture(scope="module")
def bare_noise(bare):
    """Noise of 6 images of nothing at the middle dose: the middle 400 x 400 pixels."""
    part = (slice(312, 712), slice(312, 712))
    mean = bare.mean_pixels()[part]
    rng = np.random.default_rng(33)
    return np.stack([bare.read_out(rng).pixels[part] - mean for _ in range(6)]), part


def blur_power(sd_px: float) -> np.ndarray:
    """Noise autocovariance (lags 0-5 along a row) of unit-variance white noise after the detector's Gaussian core,
    found by blurring an impulse."""
    kernel = np.zeros((65, 65))
    kernel[32, 32] = 1.0
    kernel = gaussian_filter(kernel, sd_px)
    return np.array([(kernel * np.roll(kernel, lag, axis=1)).sum() for lag in range(6)])


def test_noise_variance_is_that_of_blurred_counts(bare, bare_noise):
    noise, part = bare_noise
    white = bare.quanta[part].mean() * bare.gain**2
    expected = (1 - CHAIN.glare) ** 2 * blur_power(bare.core_px)[0] * white
    expected += (ELECTRONIC_SD * CHAIN.white) ** 2 + 1 / 12
    assert noise.var() == pytest.approx(expected, rel=0.03)  # veiling glare adds under 1 %
    assert abs(noise.mean()) < 0.02 * noise.std()


def test_noise_is_correlated_as_the_blur_makes_it(bare, bare_noise):
    noise, _ = bare_noise
    shape = blur_power(bare.core_px)
    measured = np.array([(noise[:, :, : 400 - lag] * noise[:, :, lag:]).mean() for lag in range(6)])
    added = (ELECTRONIC_SD * CHAIN.white) ** 2 + 1 / 12
    measured[0] -= added
    assert np.abs(measured / measured[0] - shape / shape[0]).max() < 0.02
    assert shape[1] / shape[0] > 0.5  # it is correlated


def test_the_field_is_round_and_black_outside(bare):
    image = bare.read_out(np.random.default_rng(7))
    v, u = np.mgrid[:1024, :1024]
    outside = np.hypot(u - 511.5, v - 511.5) > CHAIN.mask_px
    assert (image.pixels[outside] == 0).all()
    assert (image.pixels[~outside] > 0).all()
    assert image.white == 4095


def test_the_rim_is_darker_by_what_vignetting_takes(bare):
    mean = bare.mean_pixels()
    rim = [mean[512 + int(480 * np.sin(a)), 512 + int(480 * np.cos(a))] for a in np.linspace(0, 6.2, 24)]
    assert 0.60 < np.mean(rim) / mean[480:544, 480:544].mean() < 0.90


def test_bright_parts_saturate(setup):
    scene = Scene(boxes=(Box(np.array([0.0, 0, 0]), np.eye(3), np.array([40.0, 200.0, 150.0])),))
    image = render(setup, "pa", scene, np.random.default_rng(8), replace(DOSES["medium"], level=0.6))
    assert 0.05 < (image.pixels == 4095).mean() < 0.6


def test_nothing_left_to_expose_with_is_refused(setup):
    wall = Rod((0.0, 0.0, 0.0), (0.0, 0.0, 1.0), 300.0, 250.0)
    with pytest.raises(SetUpError, match="no radiation passes"):
        expose(coarse(setup.views["pa"]), Scene(solids=(wall,)))


def test_scatter_spreads_as_wide_as_its_kernel(frame):
    """Behind opaque balls beside a block of tissue: how much of its scatter is there.

    Even scatter is the same everywhere, to 0.005. Else it is as bright as the field is near by, to 0.045 of what it is
    within the block: its sides do not lie along all rays, and the balls take a little of what scatters."""
    upright = Variation(
        Pose(frame_tilt=0.0, orbit=0.0, in_plane=0.0, hip_offset_mm=0.0, piercing_mm=0.0, detector_tilt=0.0)
    )
    view = coarse(draw_setup(np.random.default_rng(0), frame, variation=upright).views["pa"], 512)
    at = np.array([[-45.0, 0.0, 20.0], [8.0, 0.0, 20.0], [16.0, 0.0, 20.0]])
    block = Box(np.array([-150.0, 0.0, 0.0]), np.eye(3), np.array([150.0, 300.0, 5.0]), "tissue")
    scene = Scene(solids=tuple(Ball((x, y, z), 4.0, within=None) for x, y, z in at.tolist()), boxes=(block,))
    u, v = np.rint(view.project(at)).astype(int).T
    beside_mm = (view.project(at) - view.project(np.zeros(3)))[1:] * view.chain.pitch_mm
    tissue = float(WEIGHTS @ np.exp(-10.0 * attenuation_per_mm("tissue")))
    scattered = expose(view, scene, scatter_mm=np.inf).quanta[v, u]
    assert scattered[1:] / scattered[0] == pytest.approx(1.0, abs=0.005)
    for width_mm in (8.0, 12.0):
        seen = expose(view, scene, scatter_mm=width_mm)
        scattered, open_field = seen.quanta[v, u], seen.open_quanta[v, u] / [tissue, 1.0, 1.0]
        shares = scattered / open_field
        expected = norm.sf(np.linalg.norm(beside_mm, axis=1) / width_mm)
        assert shares[1:] / shares[0] == pytest.approx(expected, abs=0.045), width_mm


def test_views_drawn_at_once_are_those_drawn_one_after_another(frame):
    """Fails for noise that is drawn in the threads, whose order is left to chance, and for swapped views."""
    setup = draw_setup(np.random.default_rng(31), frame, chain="9in-pal")
    scene, views = Scene(solids=frame_solids(setup.true_frame)), ("pa", "lateral")
    in_turn = np.random.default_rng(4)
    expected = {view: render(setup, view, scene, in_turn) for view in views}
    got = render_views(setup, views, scene, np.random.default_rng(4))
    assert tuple(got) == views
    for view in views:
        np.testing.assert_array_equal(got[view].pixels, expected[view].pixels)
