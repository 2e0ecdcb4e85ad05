from dataclasses import replace

import numpy as np
import pytest
from fit_scenes import FRAME as SMALL
from fit_scenes import measured
from scipy.spatial.transform import Rotation

from sightline.frame import Frame, InUse, Tolerances
from sightline.frame.measured.fit import Circumstances, fit_frame
from sightline.twin.xray.setup import Handling, in_use, with_errors

SD = Tolerances(bead_mm=0.03, plate_mm=0.05, plate_rad=0.4e-3, arm_mm=0.1, arm_rad=0.3e-3)
FRAME = replace(Frame.load("gamma"), tolerances=SD)


def moved(xyz_mm: np.ndarray, sd: tuple[float, float], rng: np.random.Generator) -> np.ndarray:
    """Points shifted and rotated about their centroid."""
    middle = xyz_mm.mean(axis=0)
    turn = Rotation.from_rotvec(sd[1] * rng.normal(size=3))
    return turn.apply(xyz_mm - middle) + middle + sd[0] * rng.normal(size=3)


def drawn(rng: np.random.Generator) -> np.ndarray:
    """One physical frame, built as the tolerances say: plates on arms, beads in plates; its errors (3M,)."""
    errors = []
    for view in FRAME.views.values():
        plates = [moved(p.xyz_mm, (SD.plate_mm, SD.plate_rad), rng) for p in (view.xrii, view.source)]
        both = moved(np.concatenate(plates), (SD.arm_mm, SD.arm_rad), rng)
        beads = both + SD.bead_mm * rng.normal(size=both.shape)
        errors.append((beads - np.concatenate([view.xrii.xyz_mm, view.source.xyz_mm])).ravel())
    return np.concatenate(errors)


def test_error_factor_is_the_covariance_of_frames_built_so():
    rng = np.random.default_rng(11)
    samples = np.array([drawn(rng) for _ in range(3000)])
    stated = FRAME.error_factor @ FRAME.error_factor.T
    probes = np.linalg.qr(np.hstack([FRAME.error_factor[:, -36:], rng.normal(size=(len(stated), 20))]))[0]
    expected = probes.T @ stated @ probes
    root = np.linalg.inv(np.linalg.cholesky(expected))
    got = root @ np.cov((samples @ probes).T) @ root.T
    # 3000 samples: the standard error of a variance is 2.6 %, of a correlation 1.8 %; five of them over 1540 pairs.
    np.testing.assert_allclose(got, np.eye(len(got)), atol=0.13)
    np.testing.assert_allclose(root @ probes.T @ samples.mean(axis=0), 0, atol=5 / np.sqrt(3000))


def test_views_do_not_share_errors_and_plates_of_a_view_do():
    stated = FRAME.error_factor @ FRAME.error_factor.T
    pa, lateral = FRAME.rows("pa"), FRAME.rows("lateral")
    assert np.all(stated[pa, lateral] == 0)
    xrii = slice(pa.start, pa.start + 3 * len(FRAME.view("pa").xrii.ids))
    assert np.abs(stated[xrii, xrii.stop : pa.stop]).max() > 0.5 * SD.arm_mm**2


def test_rows_cover_the_frame_in_file_order():
    assert [FRAME.rows(name) for name in FRAME.views] == [slice(0, 339), slice(339, 678)]
    assert FRAME.error_factor.shape[0] == 678


@pytest.mark.parametrize("rank", [5, 678])
def test_a_stated_covariance_replaces_the_tolerances(rank):
    root = np.random.default_rng(rank).normal(size=(678, rank)) * 0.01
    frame = replace(FRAME, covariance_mm2=root @ root.T)
    np.testing.assert_allclose(frame.error_factor @ frame.error_factor.T, root @ root.T, atol=1e-12)


def test_defaults_hold_where_none_are_stated():
    assert Frame.load("gamma").tolerances is None
    assert Frame.load("gamma").effective_tolerances == Tolerances(0.02, 0.05, 0.2e-3, 0.1, 0.3e-3)


EXACT = replace(Frame.load("gamma"), tolerances=Tolerances(0.0, 0.0, 0.0, 0.0, 0.0))


@pytest.mark.parametrize(
    ("told", "befell"),
    [
        (InUse(warmer_k=5.0), Handling(warmer_k=5.0)),
        (InUse(water_share=0.004), Handling(water_share=0.004)),
    ],
)
def test_heat_and_water_move_balls_as_the_twin_moves_them(told, befell):
    """One standard deviation along the factor's single direction, and along no other."""
    factor = replace(EXACT, in_use=told).error_factor
    values, vectors = np.linalg.eigh(factor @ factor.T)
    moved = (in_use(EXACT, befell).xyz_mm - EXACT.xyz_mm).ravel()
    assert np.sqrt(values[-1]) == pytest.approx(np.linalg.norm(moved), rel=1e-9)
    assert values[-2] < 1e-12 * values[-1]
    np.testing.assert_allclose(np.abs(vectors[:, -1] @ moved), np.linalg.norm(moved), rtol=1e-9)


def test_drapes_move_the_plates_of_a_view_as_one():
    frame = replace(EXACT, in_use=InUse(drape_n=20.0))
    factor = frame.error_factor.reshape(226, 3, -1)
    pa = factor[:113]
    shift = pa.mean(axis=0)
    np.testing.assert_allclose(np.sqrt((shift**2).sum(axis=1)), 0.1, rtol=1e-9)  # 20 N: twice 0.05 mm, per axis
    distance = np.linalg.norm(EXACT.xyz_mm[0] - EXACT.xyz_mm[60])
    way = (EXACT.xyz_mm[0] - EXACT.xyz_mm[60]) / distance
    np.testing.assert_allclose(way @ (pa[0] - pa[60]), 0.0, atol=1e-12)  # rigid: no distance changes
    assert np.abs(factor[:113].reshape(339, -1) @ factor[113:].reshape(339, -1).T).max() < 1e-12


def test_it_adds_to_tolerances_and_to_a_stated_covariance_alike():
    told = InUse(5.0, 0.002, 10.0)
    default = Frame.load("gamma")
    covariance = default.error_factor @ default.error_factor.T
    stated = replace(default, covariance_mm2=covariance)
    for frame in (default, stated):
        factor = replace(frame, in_use=told).error_factor
        alone = replace(EXACT, in_use=told).error_factor
        np.testing.assert_allclose(factor @ factor.T, covariance + alone @ alone.T, atol=1e-10)


def test_a_measured_frame_keeps_what_use_adds_and_counts_it_once():
    rng = np.random.default_rng(1)
    told = InUse(5.0, 0.0, 0.0)
    series = [measured(with_errors(SMALL, rng).xyz_mm, rng)]
    plain = fit_frame(SMALL, series, Circumstances()).frame
    used = fit_frame(replace(SMALL, in_use=told), series, Circumstances()).frame
    assert used.in_use == told
    np.testing.assert_allclose(used.covariance_mm2, plain.covariance_mm2, atol=1e-12)


def test_balls_of_a_solid_share_no_errors_but_each_body_expands_about_its_middle():
    frame = replace(Frame.load("block40+detector-plate"), in_use=InUse(10.0, 0.0, 0.0))
    factor = frame.error_factor
    np.testing.assert_array_equal(factor[:, : len(factor)], 0.02 * np.eye(len(factor)))
    heat = factor[:, len(factor)].reshape(-1, 3)
    for body, own in ((frame.solid, heat[:14]), (frame.detector, heat[14:])):
        np.testing.assert_allclose(own, 70e-5 * (body.xyz_mm - body.xyz_mm.mean(axis=0)), atol=1e-12)
