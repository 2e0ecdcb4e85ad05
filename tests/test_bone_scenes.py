"""The scan of a bone's scene has the bone's surface where the truth has it, and each fault moves it as stated."""

from pathlib import Path

import numpy as np
import pytest
from benchmarks.scenes import surfaces
from benchmarks.scenes.bones import GAIN, TISSUE_HU, Bone, exported, scanned
from benchmarks.scenes.surfaces import Anatomy, anatomy, zero_surface

from sightline.errors import SetUpError
from sightline.imaging import Radiograph
from sightline.imaging.volumes.ct import CtScan

CENTRE, RADIUS, SIZE = np.array([31.3, -12.7, -404.2]), 22.6, np.array([1.05, 0.96, 1.02])


def _ball() -> Bone:
    low = CENTRE - 34.0
    grid = low + np.moveaxis(np.indices((69, 69, 69)), 0, -1)
    whole = Anatomy("ball", np.linalg.norm(grid - CENTRE, axis=-1) - RADIUS, low, 1.0, {"middle": CENTRE})
    return Bone(whole, SIZE, 3.0, 0.75, 0.35)


def _radii_mm(ct: CtScan, bone: Bone) -> np.ndarray:
    """Return the radii (N,), before the stretch, of the surface at half the height of the cortex."""
    half = TISSUE_HU + (np.percentile(ct.hu, 99.5) - TISSUE_HU) / 2
    at = ct.origin_mm + (zero_surface((half - ct.hu) / 500.0).vertices * ct.voxel_mm) @ ct.axes
    radii = np.linalg.norm((at - CENTRE) / bone.size, axis=1)
    return radii[radii > RADIUS - 1.2]


def test_the_net_of_a_ball_is_closed_and_has_its_volume() -> None:
    bone = _ball()
    mesh = bone.anatomy.surface(-1.0)
    assert mesh.is_watertight
    # Mean of the crossings and flat triangles lie inside a convex surface, by up to 0.4 step² / radius: here 0.02 mm.
    np.testing.assert_allclose(mesh.volume, 4 / 3 * np.pi * (RADIUS - 1.0) ** 3, rtol=3e-3)
    assert np.abs(np.linalg.norm(mesh.vertices - CENTRE, axis=1) - RADIUS + 1.0).max() < 0.03


def test_the_scan_has_the_surface_of_the_truth_and_each_fault_moves_it() -> None:
    bone = _ball()
    # Noise of 20 HU on an edge of 600 HU/mm moves a vertex by 0.03 mm, and blur a curved edge by less.
    for fault, off in ((None, 0.0), ("swollen", 0.5)):
        radii = _radii_mm(scanned(bone, np.random.default_rng(5), fault), bone)
        assert abs(np.median(radii) - RADIUS - off) < 0.05
        assert np.std(radii) < 0.15
    ct = scanned(bone, np.random.default_rng(5), "scaled")
    np.testing.assert_allclose(ct.voxel_mm, 1.02)
    mirrored = scanned(bone, np.random.default_rng(5), "mirrored")
    np.testing.assert_array_equal(mirrored.hu[::-1], scanned(bone, np.random.default_rng(5)).hu)


def test_the_cortex_has_the_attenuation_of_bone_up_to_the_scanner_s_gain() -> None:
    ct = scanned(_ball(), np.random.default_rng(6))
    # 0.75 of the 43 per metre by which dense bone exceeds tissue at 60 keV, over water's 20.6; the edge is blurred.
    expected = 1000 * 0.75 * 43.0 / 20.6
    assert 0.9 * GAIN[0] * expected < np.percentile(ct.hu, 99) - TISSUE_HU < 1.05 * GAIN[1] * expected


def test_an_exported_image_has_eight_bits_and_keeps_its_order() -> None:
    pixels = np.tile(np.linspace(1000, 30000, 64), (64, 1)).astype(np.uint16)
    image = exported(Radiograph(pixels, 65535.0))
    assert image.pixels.dtype == np.uint8 and image.lossy
    assert np.corrcoef(image.pixels[30], pixels[30])[0, 1] > 0.999


def test_a_missing_femur_is_named(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(surfaces, "FEMUR", tmp_path / "none.stl")
    anatomy.cache_clear()
    with pytest.raises(SetUpError, match="beside the repository"):
        anatomy("femur")
