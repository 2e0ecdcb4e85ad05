import dataclasses

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sightline.frame import Frame, Tolerances

SD = Tolerances(bead_mm=0.03, plate_mm=0.05, plate_rad=0.4e-3, arm_mm=0.1, arm_rad=0.3e-3)
FRAME = dataclasses.replace(Frame.load("gamma"), tolerances=SD)


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
    frame = dataclasses.replace(FRAME, covariance_mm2=root @ root.T)
    np.testing.assert_allclose(frame.error_factor @ frame.error_factor.T, root @ root.T, atol=1e-12)


def test_defaults_hold_where_none_are_stated():
    assert Frame.load("gamma").tolerances is None
    assert Frame.load("gamma").effective_tolerances == Tolerances(0.02, 0.05, 0.2e-3, 0.1, 0.3e-3)
