"""A printed block measured by its own images: errors, their covariance, and what is refused."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2
from tests.calibration.solid_scenes import C_ARM, built, turned_images

from sightline.calibration.solids.self_check import KnownDistance, self_check_solid
from sightline.common.geometry.rigid import rigid_fit
from sightline.errors import CalibrationRefusedError, UnusableInputError
from sightline.frame import Frame, Tolerances

PRINTED = replace(Frame.load("block60"), name="printed", tolerances=Tolerances(0.2, 0.0, 0.0, 0.0, 0.0))
IMAGES = 10


def _distance(rng, xyz_mm, sd_mm=0.02):
    """The balls b1 and b4, at opposite corners."""
    return KnownDistance(
        "b1", "b4", float(np.linalg.norm(xyz_mm[3] - xyz_mm[0])) + sd_mm * rng.standard_normal(), sd_mm
    )


@pytest.mark.slow
def test_ten_images_and_one_distance_measure_a_printed_block():
    """Eight blocks: as-printed errors of 0.2 mm become 0.02 mm rms, and chi-square is that of the stated covariance."""
    rng, off, squares = np.random.default_rng(21), [], []
    for _ in range(8):
        xyz = built(rng, PRINTED)
        found = self_check_solid(
            turned_images(rng, PRINTED, xyz, IMAGES), PRINTED, _distance(rng, xyz), [C_ARM] * IMAGES
        )
        assert all(check.passed for check in found.checks)
        estimate = np.array([f.xyz_mm for f in found.frame.fiducials])
        error = rigid_fit(xyz, estimate).apply(xyz) - estimate
        off.append(error)
        information = np.linalg.pinv(found.frame.covariance_mm2, rcond=1e-6, hermitian=True)
        squares.append(error.ravel() @ information @ error.ravel())
    assert np.sqrt(np.mean(np.square(off))) < 0.02
    freedom = 8 * (3 * 16 - 6)
    assert chi2.ppf(1e-4, freedom) < np.sum(squares) < chi2.ppf(1 - 1e-4, freedom)


def test_the_distance_gives_the_size():
    """A block printed 0.5 % too large, three s.d. of the size that its tolerance leaves. The two balls are known to
    0.01 mm each across their distance of 55 mm: 3e-4, twice that is allowed."""
    rng = np.random.default_rng(22)
    xyz = 1.005 * PRINTED.solid.xyz_mm
    found = self_check_solid(
        turned_images(rng, PRINTED, xyz, IMAGES), PRINTED, _distance(rng, xyz, 0.005), [C_ARM] * IMAGES
    )
    before, after = (one.solid.xyz_mm - one.solid.xyz_mm.mean(axis=0) for one in (PRINTED, found.frame))
    assert np.linalg.norm(after) / np.linalg.norm(before) == pytest.approx(1.005, abs=6e-4)


def test_the_measured_frame_is_a_file_that_calibrates(tmp_path):
    rng = np.random.default_rng(23)
    xyz = built(rng, PRINTED)
    found = self_check_solid(turned_images(rng, PRINTED, xyz, IMAGES), PRINTED, _distance(rng, xyz), [C_ARM] * IMAGES)
    found.frame.save(tmp_path / "measured.json")
    again = Frame.load(tmp_path / "measured.json")
    np.testing.assert_allclose(again.covariance_mm2, found.frame.covariance_mm2, rtol=1e-6, atol=1e-12)
    assert (found.images == IMAGES).all() and found.sd_mm.max() < 0.05


def test_what_cannot_be_measured_is_refused():
    rng = np.random.default_rng(24)
    xyz = built(rng, PRINTED)
    given = turned_images(rng, PRINTED, xyz, 4)
    with pytest.raises(CalibrationRefusedError, match="3 images were given"):
        self_check_solid(given[:3], PRINTED, _distance(rng, xyz))
    with pytest.raises(UnusableInputError, match="no ball 'x'"):
        self_check_solid(given, PRINTED, KnownDistance("b1", "x", 60.0, 0.02))
    with pytest.raises(UnusableInputError, match="mm apart by the frame file"):
        self_check_solid(given, PRINTED, KnownDistance("b1", "b4", 50.0, 0.02))
    with pytest.raises(UnusableInputError, match="two different balls"):
        KnownDistance("b1", "b1", 50.0, 0.02)
