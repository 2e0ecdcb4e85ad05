"""Further image chains: the field, the pitch and the distortion follow; a flat panel has neither tube nor veil."""

import numpy as np
import pytest

from sightline.twin import Scene, draw_setup
from sightline.twin.objects.things import frame_solids
from sightline.twin.xray.distributions import Distortion
from sightline.twin.xray.intensifier import disc_mm
from sightline.twin.xray.presets import PRESETS, preset
from sightline.twin.xray.render import DOSES, expose
from sightline.twin.xray.tubes import draw_earth, draw_tube


def detector(chain: str, seed: int):
    rng, spread = np.random.default_rng(seed), Distortion()
    return draw_tube(rng, preset(chain), spread).expose(rng, np.eye(3), draw_earth(rng, spread))


@pytest.mark.parametrize(
    ("chain", "pitch_mm", "white"),
    [
        ("9in-1k", 0.21, 4095),
        ("9in-pal", 0.373, 255),
        ("17cm-1k", 0.156, 4095),
        ("flat-panel", 0.194, 65535),
        *((f"flat-panel-{pitch_mm}", pitch_mm, 65535) for pitch_mm in (0.1, 0.2, 0.3)),
    ],
)
def test_pitch_and_depth(chain, pitch_mm, white):
    assert preset(chain).pitch_mm == pytest.approx(pitch_mm, abs=5e-4)
    assert preset(chain).white == white


@pytest.mark.parametrize("chain", PRESETS)
def test_the_field_fills_the_height_and_pixels_go_there_and_back(chain):
    one = detector(chain, 3)
    across = 2 * preset(chain).mask_px / preset(chain).shape[0]
    assert 0.98 < across <= 1.0
    uv = one.centre_px + disc_mm(0.97 * preset(chain).mask_px, 9)
    xi = one.to_detector(uv)
    assert np.abs(one.to_image(xi) - uv).max() < 1e-8
    rim = np.linalg.norm(one.to_detector(one.centre_px + preset(chain).shape[0] / 2 * np.eye(2)), axis=-1)
    assert rim == pytest.approx(preset(chain).field_mm / 2, rel=0.03)  # asymmetry and shift: up to 3 mm


@pytest.mark.parametrize("chain", ["9in-pal", "flat-panel-0.3"])
def test_images_have_the_field_and_the_quanta_of_their_chain(frame, chain):
    optics = preset(chain)
    setup = draw_setup(np.random.default_rng(41), frame, chain=chain)
    exposure = expose(setup.views["pa"], Scene(solids=frame_solids(setup.true_frame)))
    image = exposure.read_out(np.random.default_rng(1))
    assert image.shape == optics.shape
    assert image.white == optics.white
    assert (image.pixels[~exposure.field] == 0).all()
    assert (image.pixels[exposure.field] > 0).mean() > 0.999
    off = np.abs(np.mgrid[: optics.shape[0], : optics.shape[1]] - optics.centre_px[::-1, None, None])
    inside = np.hypot(*off) <= optics.mask_px if optics.tube_mm else off.max(axis=0) <= optics.mask_px
    assert np.array_equal(exposure.field, inside)
    lit = exposure.open_quanta[exposure.field]
    assert np.median(lit) == pytest.approx(DOSES["medium"].quanta(optics), rel=0.15)
    # A ball's shadow lies where its centre projects to, in every chain.
    bead = setup.true_frame.view("pa").xrii.xyz_mm
    uv = np.rint(setup.views["pa"].project(bead)).astype(int)
    seen = setup.views["pa"].in_field(uv, 20)
    assert seen.sum() > 10
    taken = exposure.quanta / np.where(exposure.field, exposure.open_quanta, 1)
    assert taken[uv[seen, 1], uv[seen, 0]].max() < 0.75


def test_a_zoom_shows_the_middle_of_the_same_tube():
    xi = disc_mm(75.0, 9)
    wide, zoom = detector("9in-1k", 5), detector("17cm-1k", 5)
    wide_mm, zoom_mm = ((one.to_image(xi) - one.centre_px) / one.px_per_mm for one in (wide, zoom))
    assert np.abs(wide_mm - zoom_mm).max() < 1e-9
    assert zoom.px_per_mm > 1.25 * wide.px_per_mm


def test_nothing_distorts_a_flat_panel():
    panel = detector("flat-panel", 6)
    xi = np.array([[-148.3, 12.7], [31.1, -140.9], [0.0, 0.0]])
    assert np.allclose(panel.to_image(xi), panel.centre_px + xi / 0.19401, rtol=0, atol=0.01)
    assert np.array_equal(
        panel.beyond_cubic_factor(panel.centre_px + xi), np.zeros((6, panel.response_px(xi).shape[2]))
    )


def test_a_panel_has_square_corners_and_no_veil(frame):
    setup = draw_setup(np.random.default_rng(43), frame, chain="flat-panel-0.3")
    view = setup.views["pa"]
    corner = view.intensifier.centre_px + 490.0
    assert view.in_field(corner)
    assert not view.in_field(corner + np.array([8.0, 0.0]))
    exposure = expose(view, Scene())
    lit = exposure.mean_pixels() - exposure.black
    (v, u), (row, column) = np.rint(corner[::-1]).astype(int), np.array(lit.shape) // 2
    # Scattered light falls off by what smoothing finds beyond the edge, nothing else.
    assert lit[v, u] / lit[row, column] == pytest.approx(1.0, abs=0.02)
