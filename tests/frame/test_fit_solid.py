"""Measured balls of a block become a frame file, with their covariance; wrong measurements are refused."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation
from scipy.stats import chi2

from sightline.common.geometry.rigid import rigid_fit
from sightline.errors import FrameError
from sightline.frame import Frame, RigidBody
from sightline.frame.measured.fit import Circumstances, fit_frame
from sightline.frame.tables import Series

BLOCK = Frame.load("block60")
NOMINAL_MM = BLOCK.solid.xyz_mm
IDS = BLOCK.solid.ids
SD_MM = 0.005


def measured(xyz_mm: np.ndarray, rng: np.random.Generator) -> Series:
    """A series of these balls, from an instrument in any pose."""
    pose = RigidTransform.from_components(rng.uniform(-900, 900, 3), Rotation.random(rng=rng))
    noisy = pose.apply(xyz_mm) + SD_MM * rng.standard_normal(xyz_mm.shape)
    return Series("1", IDS, noisy, SD_MM**2 * np.eye(noisy.size), np.full(len(noisy), np.nan))


def made(rng: np.random.Generator) -> np.ndarray:
    """(16, 3): where the balls of a block of the default tolerance are."""
    return NOMINAL_MM + 0.02 * rng.standard_normal(NOMINAL_MM.shape)


@pytest.mark.slow
@pytest.mark.parametrize("gone", [(), ("b3", "b12")])
def test_the_covariance_of_a_measured_block_is_that_of_its_errors(gone):
    """Pooled chi-square of 60 blocks within what chance gives it 999 times in 1,000, also of balls not measured.

    The gauge's six directions have no error. A drift of plates adds nothing to a block.
    """
    rng, total, freedom = np.random.default_rng(5), 0.0, 0
    keep = np.array([i not in gone for i in IDS])
    for _ in range(60):
        true = made(rng)
        fitted = fit_frame(BLOCK, [measured(true, rng).where(keep)], Circumstances(drift_mm=0.05))
        assert fitted.missing == gone
        error = fitted.frame.solid.xyz_mm - rigid_fit(true[keep], NOMINAL_MM[keep]).apply(true)
        values, vectors = np.linalg.eigh(fitted.frame.covariance_mm2)
        kept = values > 1e-9 * values[-1]
        total += float(((vectors.T @ error.ravel())[kept] ** 2 / values[kept]).sum())
        freedom += int(kept.sum())
    assert freedom == 60 * (3 * len(IDS) - 6)
    assert chi2.ppf(0.0005, freedom) < total < chi2.ppf(0.9995, freedom)


def test_a_block_expands_about_its_middle_and_shows_its_growth():
    """3 K of PMMA from measurement to use; a print 0.3 % too large is found as growth."""
    rng = np.random.default_rng(6)
    true = 1.003 * NOMINAL_MM
    free = replace(BLOCK, tolerances=replace(BLOCK.effective_tolerances, bead_mm=0.2))
    fitted = fit_frame(free, [measured(true, rng)], Circumstances(temperature_c=20.0, use_temperature_c=23.0))
    (body,) = fitted.plates
    assert body.growth_ppm == pytest.approx(3000, abs=4 * 1e6 * SD_MM / 100)  # 16 balls within 50 mm of the middle
    assert body.across_rms_mm is None and body.in_plane_rms_mm < 3 * SD_MM
    size = np.ptp(fitted.frame.solid.xyz_mm, axis=0)
    np.testing.assert_allclose(size, 1.003 * (1 + 3 * 70e-6) * 53, atol=6 * SD_MM)
    assert fitted.frame.temperature_c == 23.0


def test_exchanged_mirrored_and_misplaced_balls_write_nothing():
    rng = np.random.default_rng(7)
    series = measured(made(rng), rng)

    def failing(change: Series) -> dict[str, str]:
        fitted = fit_frame(BLOCK, [change], Circumstances())
        assert fitted.frame is None
        return {check.name: check.sentence for check in fitted.checks if not check.passed}

    names = {"b2": "b9", "b9": "b2"}
    wrong = failing(replace(series, ids=tuple(names.get(i, i) for i in IDS)))
    assert "b2 and b9 are exchanged" in wrong["measured ids"]
    assert "mirror image" in failing(replace(series, xyz_mm=series.xyz_mm * [1, 1, -1]))["measured ids"]
    xyz = series.xyz_mm.copy()
    xyz[4, 0] += 0.5
    assert "b5" in failing(replace(series, xyz_mm=xyz))["measured deviation"]


def test_balls_of_one_plane_do_not_determine_a_block():
    rng = np.random.default_rng(8)
    flatten = np.where(np.arange(16) < 6, 0.0, 1.0)[:, None] * [0, 0, 1] + [1, 1, 0]
    balls = zip(BLOCK.solid.fiducials, NOMINAL_MM * flatten, strict=True)
    flat = replace(BLOCK, solid=RigidBody(tuple(replace(f, xyz_mm=tuple(at)) for f, at in balls)))
    series = measured(flat.solid.xyz_mm, rng).where(np.arange(16) < 6)
    with pytest.raises(FrameError, match=r"6 balls of the solid were measured; .* do not lie in one plane"):
        fit_frame(flat, [series], Circumstances())
