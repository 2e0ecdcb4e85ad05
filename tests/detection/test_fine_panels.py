"""Balls that are large in pixels: found at the scale that suits them, and stated in the image's own pixels."""

from dataclasses import replace

import numpy as np
import pytest
from tests.detection.bead_images import Bead, grid, normalised, quanta, radiograph
from tests.detection.panel_images import hip, middle_of, scattered, shown, view_of

from sightline.detection import Detections, detect
from sightline.errors import DetectionRefusedError
from sightline.twin.objects.things import Scene
from sightline.twin.xray.presets import preset
from sightline.twin.xray.render import DOSES, Dose

CHAIN = "flat-panel-0.2"
FIELD_MM = 120.0


def found_of(beads: Detections, uv_px: np.ndarray, within_px: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the row of the bead nearest to each true centre (N, 2), and whether it lies within a distance (N,)."""
    apart = np.linalg.norm(beads.uv_px[None] - uv_px[:, None], axis=-1)
    return apart.argmin(axis=1), apart.min(axis=1) < within_px


@pytest.mark.slow
def test_a_blocks_balls_are_found_with_honest_covariances() -> None:
    """96 balls before a hip, each at three doses; their 192 coordinates state a ratio of s.d. to 5 % (1 s.d.)."""
    panel = middle_of(preset(CHAIN), round(FIELD_MM / preset(CHAIN).pitch_mm))
    view, around = view_of(panel), hip()
    seen: dict[str, list[np.ndarray]] = {dose: [] for dose in DOSES}
    missed = false = 0
    for seed, from_source_mm in enumerate([360.0, 450.0, 650.0] * 2):
        rng = np.random.default_rng([13, seed])
        balls = shown(view, *scattered(view, rng, 16, from_source_mm), around)
        for name, dose in DOSES.items():
            beads = detect(balls.projection.exposed(dose).read_out(rng))
            row, there = found_of(beads, balls.uv_px, 0.2 * balls.radius_px)
            missed, false = missed + np.count_nonzero(~there), false + len(beads) - np.count_nonzero(there)
            seen[name].append(
                normalised(beads.uv_px[row[there]] - balls.uv_px[there], beads.covariance_px2[row[there]])
            )
    ratio = {name: float(np.sqrt(np.concatenate(some).mean())) for name, some in seen.items()}
    assert missed + false < 0.03 * 3 * 96
    assert max(ratio.values()) < 1.15
    # At high dose the allowance for curved backgrounds, made for bone beside every bead, exceeds the noise.
    assert ratio["low"] > 0.85 and ratio["medium"] > 0.75 and ratio["high"] > 0.6, ratio


def test_a_panel_of_half_the_pitch_shows_the_same_centres() -> None:
    """Hardly any noise, so that only sampling and scale differ; 0.02 px are 4 micrometres."""
    coarse = middle_of(preset("flat-panel"), 600)
    pitch_mm = coarse.pitch_mm
    fine = replace(coarse, shape=(1200, 1200), mask_px=2 * coarse.mask_px)
    assert fine.pitch_mm == pytest.approx(0.097, abs=1e-4)
    rng = np.random.default_rng(1)
    xyz, radius = scattered(view_of(coarse), rng, 12, 450.0)
    centres = []
    for panel in (coarse, fine):
        balls = shown(view_of(panel), xyz, radius, Scene())
        beads = detect(balls.projection.exposed(Dose(frames=4000)).read_out(rng))
        row, there = found_of(beads, balls.uv_px, 0.2 * balls.radius_px)
        assert there.all() and len(beads) == len(xyz) and beads.image_shape == panel.shape
        assert beads.radius_px[row] == pytest.approx(balls.radius_px, rel=0.03)  # a penumbra widens the rim
        centres.append((beads.uv_px[row] - balls.view.intensifier.centre_px) * panel.pitch_mm)
    assert np.abs(centres[0] - centres[1]).max() < 0.02 * pitch_mm


@pytest.mark.parametrize("radius", [30.0, 45.0, 62.0])
def test_balls_of_any_size_up_to_a_fifteenth_of_the_width_are_measured(radius: float) -> None:
    rng, size = np.random.default_rng(2), 940
    places = grid(235.0, size, rng)
    found = detect(radiograph(quanta([Bead(u, v, radius) for u, v in places], np.full((size, size), 4e3)), rng))
    row, there = found_of(found, places, np.full(len(places), 2.0))
    assert there.all() and len(found) == len(places)
    assert np.abs(found.uv_px[row] - places).max() < 0.02 * 4  # px; the fit has pixels of 4 and more
    assert found.radius_px[row] == pytest.approx(radius, rel=0.02)


def test_small_balls_stay_where_some_are_larger_than_a_fit_can_measure() -> None:
    rng, size = np.random.default_rng(3), 700
    places = grid(92.0, size, rng)
    radii = np.where(np.arange(len(places)) % 6 == 0, 33.0, 9.0)  # the median is 9 px
    beads = [Bead(u, v, r) for (u, v), r in zip(places, radii, strict=True)]
    found = detect(radiograph(quanta(beads, np.full((size, size), 4e4)), rng))
    row, there = found_of(found, places, np.full(len(places), 2.0))
    assert there.all() and len(found) == len(places)
    assert found.radius_px[row] == pytest.approx(radii, rel=0.05)


def test_one_large_disc_among_usual_balls_changes_nothing_but_is_named() -> None:
    rng, size = np.random.default_rng(4), 480
    places = grid(60.0, size, rng)
    away = np.linalg.norm(places - [250.3, 241.7], axis=1) > 90
    usual = [Bead(u, v, 8.0) for u, v in places[away]]
    open_quanta = np.full((size, size), 4e4)
    alone = detect(radiograph(quanta(usual, open_quanta), np.random.default_rng(5)))
    beside = detect(radiograph(quanta([*usual, Bead(250.3, 241.7, 40.0)], open_quanta), np.random.default_rng(5)))
    assert len(alone) == len(beside) == len(usual)
    row, there = found_of(beside, alone.uv_px, np.full(len(alone), 0.05))
    assert there.all() and beside.radius_px[row] == pytest.approx(alone.radius_px, abs=0.05)
    (why,) = (one.reason for one in beside.rejected if np.hypot(*np.subtract(one.uv_px, [250.3, 241.7])) < 5)
    assert why == "much larger than most beads"


def test_balls_too_large_for_their_image_are_refused_as_such() -> None:
    rng = np.random.default_rng(6)
    image = radiograph(quanta([Bead(79.6, 82.3, 55.0)], np.full((160, 160), 4e4)), rng)
    with pytest.raises(DetectionRefusedError, match="too large for an image of so few pixels: show more of the field"):
        detect(image)
