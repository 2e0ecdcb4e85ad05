"""Centroids of shadows, which distortion shifts, become the images of the balls' centres."""

from dataclasses import replace

import numpy as np
import pytest
from calibration_scenes import choose

from sightline.calibration import calibrate
from sightline.calibration.plates.beads import at_centres
from sightline.detection.results import Observations
from sightline.frame import Frame
from sightline.studies.scenes import EXACT
from sightline.twin import SetUp, draw_setup
from sightline.twin.xray.setup import shadow_centres_px, shadow_radius_px

GAMMA = replace(Frame.load("gamma"), tolerances=EXACT)
PLATE = replace(Frame.load("block30+detector-plate"), tolerances=EXACT)
SD_PX = 0.02


def shadows(setup: SetUp, name: str) -> tuple[Observations, np.ndarray]:
    """The centroids of all shadows in a view's field, and the images (N, 2) of the centres."""
    truth, beads = setup.views[name], setup.frame_in(name).fiducials_of(name)
    xyz = np.array([bead.xyz_mm for bead in beads])
    radius = np.array([bead.diameter_mm for bead in beads]) / 2
    kept = np.flatnonzero(truth.in_field(truth.project(xyz), 12.0))
    xyz, radius, ids = xyz[kept], radius[kept], tuple(beads[k].id for k in kept)
    uv, covariance = shadow_centres_px(truth, xyz, radius), np.tile(SD_PX**2 * np.eye(2), (len(ids), 1, 1))
    seen = Observations(
        name,
        ids,
        uv,
        covariance,
        image_shape=truth.chain.shape,
        radius_px=shadow_radius_px(truth, xyz, radius),
    )
    return seen, truth.project(xyz)


def rms(off_px: np.ndarray) -> float:
    return float(np.sqrt((off_px**2).mean()))


@pytest.mark.parametrize("frame", [GAMMA, PLATE], ids=["two plates", "a solid and a plate on the detector"])
def test_the_shift_of_an_intensifier_s_centroids_is_taken_away(frame: Frame) -> None:
    """What is left is what a polynomial does not follow; on the same balls a program without it keeps all."""
    before, after = [], []
    for seed in range(6):
        setup = draw_setup(np.random.default_rng([41, seed]), frame, chain="9in-1k", frame_errors=False)
        for name in setup.views:
            seen, centres_px = shadows(setup, name)
            before.append(seen.uv_px - centres_px)
            after.append(at_centres(seen, frame).uv_px - centres_px)
    before_px, after_px = np.concatenate(before), np.concatenate(after)
    assert np.abs(before_px).max() > 0.05
    assert rms(after_px) < 0.4 * rms(before_px)
    assert rms(after_px) < 0.008
    assert np.abs(after_px.mean(axis=0)).max() < 0.002


def test_a_panel_s_centroids_stay_and_so_do_points() -> None:
    setup = draw_setup(np.random.default_rng(42), GAMMA, chain="flat-panel", frame_errors=False)
    seen, _ = shadows(setup, "pa")
    moved = at_centres(seen, GAMMA).uv_px - seen.uv_px  # oblique plates: discs in place of balls
    assert rms(moved) < 0.004 and np.abs(moved).max() < 0.01
    points = replace(seen, radius_px=None)
    assert at_centres(points, GAMMA) is points


def test_noise_and_one_wrong_bead_hardly_change_the_shift() -> None:
    rng = np.random.default_rng(43)
    setup = draw_setup(rng, GAMMA, chain="9in-1k", frame_errors=False)
    seen, _ = shadows(setup, "pa")
    shift = seen.uv_px - at_centres(seen, GAMMA).uv_px
    noise = 0.1 * rng.standard_normal(seen.uv_px.shape)
    noise[len(noise) // 2] += 5.0
    noisy = replace(seen, uv_px=seen.uv_px + noise)
    assert rms(noisy.uv_px - at_centres(noisy, GAMMA).uv_px - shift) < 0.003


@pytest.mark.parametrize("count", [4, 17, 18])
def test_few_balls_of_a_plate_stay_where_they_are(count: int) -> None:
    setup = draw_setup(np.random.default_rng(44), GAMMA, chain="9in-1k", frame_errors=False)
    seen, _ = shadows(setup, "pa")
    few = choose(seen, [name for name in seen.ids if name in GAMMA.view("pa").xrii.ids][:count].__contains__)
    assert np.array_equal(at_centres(few, GAMMA).uv_px, few.uv_px) == (count < 18)


def test_calibration_takes_the_shift_away_once() -> None:
    """Centroids with radii calibrate like the images of the centres; as points they are off, which no check shows."""
    setup = draw_setup(np.random.default_rng(45), GAMMA, chain="9in-1k", frame_errors=False)
    truth, target = setup.views["pa"], setup.hip_mm[None]
    seen, centres_px = shadows(setup, "pa")

    def off_mm(beads: Observations) -> float:
        lines = calibrate(beads, GAMMA).lines_of_sight(truth.project(target))
        return float(np.linalg.norm(np.cross(lines.directions[0], target[0] - lines.focal_point_mm)))

    exact = off_mm(replace(seen, uv_px=centres_px, radius_px=None))
    assert abs(off_mm(seen) - exact) < 0.003
    assert off_mm(replace(seen, radius_px=None)) > 2 * off_mm(seen)
