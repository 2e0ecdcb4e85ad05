"""`sightline simulate`: the same bytes again, what the files hold, and what is refused."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pydicom
import pytest
import trimesh
from nibabel.nifti1 import Nifti1Image

from sightline.common.atomic import MANIFEST
from sightline.detection import detect
from sightline.frame import Frame
from sightline.imaging import read_image
from sightline.twin.xray.presets import PRESETS
from sightline.twin.xray.setup import with_errors

GAMMA = Frame.load("gamma")
FILES = ["lateral.dcm", "pa.dcm", "truth.json"]


@pytest.fixture(scope="module")
def simulated(run, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The object of four balls, seed 5."""
    out = tmp_path_factory.mktemp("simulated") / "deep" / "one"
    ran = run("simulate", "object", "--seed", 5, "--out", out)
    assert ran.code == 0, ran.err
    assert "truth.json" in ran.out
    return out


@pytest.mark.slow
def test_any_seed_gives_the_same_files_again_to_the_byte_and_png_the_same_pixels(
    run, simulated: Path, tmp_path: Path
) -> None:
    for name, option in (("again", "--quiet"), ("png", "--png")):
        assert run("simulate", "object", "--seed", 5, "--out", tmp_path / name, option).code == 0
    other = run("simulate", "object", "--seed", 6, "--out", tmp_path / "other", "--json")
    assert other.code == 0
    assert other.err == ""
    assert other.document["seed"] == 6
    assert sorted(file.name for file in simulated.parent.rglob("*") if file.is_file()) == [MANIFEST, *FILES]
    for name in FILES:
        assert (tmp_path / "again" / name).read_bytes() == (simulated / name).read_bytes()
        assert (tmp_path / "other" / name).read_bytes() != (simulated / name).read_bytes()
    assert sorted(file.name for file in (tmp_path / "png").glob("[!.]*")) == ["lateral.png", "pa.png", "truth.json"]
    for view in ("pa", "lateral"):
        pixels = [read_image(file).pixels for file in (tmp_path / "png" / f"{view}.png", simulated / f"{view}.dcm")]
        np.testing.assert_array_equal(*pixels)


def test_images_are_as_a_c_arm_stores_them(simulated: Path) -> None:
    for view in ("pa", "lateral"):
        header = pydicom.dcmread(simulated / f"{view}.dcm")
        for tag in ("DistanceSourceToDetector", "ImagerPixelSpacing", "IntensifierSize", "PositionerPrimaryAngle"):
            assert not header.get(tag)


def test_the_truth_says_where_things_are_in_the_image(simulated: Path) -> None:
    """Within 0.5 px something is found where the truth has balls and beads; some of them overlap, or are cut."""
    truth = json.loads((simulated / "truth.json").read_text())
    assert (truth["what"], truth["seed"], truth["preset"], truth["whole_shown"]) == ("object", 5, "9in-1k", True)
    assert list(truth["points_mm"]) == ["ball 1", "ball 2", "ball 3", "ball 4"]
    for view in ("pa", "lateral"):
        found = detect(read_image(simulated / f"{view}.dcm")).uv_px
        for kind, least in (("points_uv_px", 0.75), ("beads_uv_px", 0.8)):
            true = np.array(list(truth["views"][view][kind].values()))
            near = np.linalg.norm(found[:, None] - true, axis=2).min(axis=0)
            assert np.mean(near < 0.5) >= least, (view, kind)


@pytest.mark.slow
@pytest.mark.parametrize("side", ["right", "left"])
def test_tags_state_the_nominal_geometry(run, side: str, tmp_path: Path) -> None:
    """Detector on the side of the hip: the patient's right is a negative angle. Poses stray by up to 15°."""
    arguments = ["simulate", "object", "--side", side, "--tags", "--preset", "17cm-1k", "--out", tmp_path, "--quiet"]
    assert run(*arguments).code == 0
    tags = {view: read_image(tmp_path / f"{view}.dcm").tags for view in ("pa", "lateral")}
    for view, angle in (("pa", 0.0), ("lateral", -90.0 if side == "right" else 90.0)):
        assert tags[view].source_detector_mm == 1000.0
        assert tags[view].imager_pixel_spacing_mm == pytest.approx((160 / 1024, 160 / 1024))
        assert tags[view].intensifier_size_mm == 215.0
        assert abs(tags[view].primary_angle_deg - angle) <= 15
        assert abs(tags[view].secondary_angle_deg) <= 15


@pytest.mark.slow
def test_a_solid_stands_before_a_panel_whose_files_state_its_geometry(run, tmp_path: Path) -> None:
    ran = run("simulate", "object", "--frame", "block60", "--dose", "low", "--out", tmp_path, "--json")
    assert ran.code == 0, ran.err
    assert ran.document["preset"] == "flat-panel"
    truth = json.loads((tmp_path / "truth.json").read_text())
    assert list(truth["beads_mm"]) == [f"b{n}" for n in range(1, 17)]
    assert truth["points_mm"]["ball 1"] == pytest.approx([-18.0, -76.8 - 16.0, -22.4 - 12.0])
    for view in ("pa", "lateral"):
        image = read_image(tmp_path / f"{view}.dcm")
        assert image.tags.source_detector_mm == 1020.0
        assert image.tags.imager_pixel_spacing_mm == pytest.approx((298 / 1536, 298 / 1536))
        assert image.tags.intensifier_size_mm is None
        assert len(truth["views"][view]["beads_uv_px"]) == 16


@pytest.mark.slow
def test_an_image_that_is_not_square_shows_a_hip(run, tmp_path: Path) -> None:
    preset = "9in-pal"
    ran = run("simulate", "--preset", preset, "--dose", "low", "--side", "left", "--out", tmp_path, "--json")
    assert ran.code == 0, ran.out
    truth = json.loads((tmp_path / "truth.json").read_text())
    assert truth["side"] == "left"
    assert set(truth["points_mm"]) == {"head centre", "lesser trochanter", "greater trochanter"}
    for view in ("pa", "lateral"):
        assert read_image(tmp_path / f"{view}.dcm").shape == PRESETS[preset].shape
        for point in ("entry_uv_px", "end_uv_px"):
            if truth["whole_shown"]:
                h, w = PRESETS[preset].shape
                assert 0 < truth["views"][view][point][0] < w
                assert 0 < truth["views"][view][point][1] < h


@pytest.fixture(scope="module")
def block(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A cuboid of 40 mm about (300, 0, 0)."""
    file = tmp_path_factory.mktemp("mesh") / "block.stl"
    mesh = trimesh.creation.box((40.0, 40.0, 40.0))
    mesh.apply_translation([300.0, 0.0, 0.0])
    mesh.export(file)
    return file


def nifti(folder: Path) -> Path:
    """Air with a block of bone of 40 mm about its middle."""
    hu = np.full((60, 60, 60), -1000, dtype=np.int16)
    hu[20:40, 20:40, 20:40] = 1200
    Nifti1Image(hu, np.diag([2.0, 2.0, 2.0, 1.0])).to_filename(folder / "scan.nii.gz")
    return folder / "scan.nii.gz"


@pytest.mark.slow
def test_a_mesh_or_a_scan_is_put_with_its_middle_or_a_stated_point_at_the_origin(run, block, tmp_path: Path) -> None:
    made = {}
    for name, what in (
        ("mesh", [block]),
        ("mesh, away", [block, "--at", "330,0,0"]),
        ("scan", [nifti(tmp_path)]),
    ):
        out = tmp_path / name
        ran = run("simulate", *what, "--out", out, "--dose", "high", "--quiet")
        assert ran.code == 0, ran.err
        made[name] = read_image(out / "pa.dcm").pixels, json.loads((out / "truth.json").read_text())
    light = {name: brightness_at_origin(*one) for name, one in made.items()}
    assert max(light["mesh"], light["scan"]) < 0.75
    assert light["mesh, away"] > 1.2 * light["mesh"]
    for name, middle in (("mesh", [300, 0, 0]), ("mesh, away", [330, 0, 0]), ("scan", [-59, -59, 59])):
        assert np.allclose(made[name][1]["origin_in_file_mm"], middle)


def brightness_at_origin(pixels: np.ndarray, truth: dict) -> float:
    """Against the whole image; a median, so that a bead beside it tells nothing."""
    u, v = (round(c) for c in truth["views"]["pa"]["points_uv_px"]["origin"])
    return float(np.median(pixels[v - 8 : v + 9, u - 8 : u + 9]) / np.median(pixels[pixels > 0]))


@pytest.mark.slow
def test_accessories_lie_in_the_beam_and_the_set_up_is_the_same(run, simulated: Path, tmp_path: Path) -> None:
    ran = run("simulate", "object", "--seed", 5, "--with", "drape", "--with", "table-rail", "--out", tmp_path, "--json")
    assert ran.code == 0, ran.out
    truth, before = (json.loads((folder / "truth.json").read_text()) for folder in (tmp_path, simulated))
    assert truth.pop("with") == ["drape", "table-rail"]
    assert truth == before
    dark, bright = (read_image(folder / "lateral.dcm").pixels.astype(float) for folder in (tmp_path, simulated))
    assert (dark < 0.6 * bright).mean() > 0.02  # behind the rail


@pytest.mark.slow
def test_one_manufactured_frame_is_kept_over_many_images(run, tmp_path: Path) -> None:
    def truth_of(seed: int, errors: int) -> dict[str, Any]:
        out = tmp_path / f"{seed}-{errors}"
        ran = run(
            "simulate", "object", "--seed", seed, "--frame-errors", errors, "--dose", "low", "--out", out, "--json"
        )
        assert ran.code == 0, ran.out
        truth = json.loads((out / "truth.json").read_text())
        assert truth["frame_errors"] == errors
        made = Frame.load(out / "frame-as-made.json")
        assert truth["beads_mm"] == {b.id: list(b.xyz_mm) for v in made.views.values() for b in v.fiducials}
        return truth

    first, second = truth_of(5, 7), truth_of(6, 7)
    drawn = [with_errors(GAMMA, np.random.default_rng(seed)) for seed in (7, 8)]
    mine, other = ({b.id: list(b.xyz_mm) for v in f.views.values() for b in v.fiducials} for f in drawn)
    assert first["beads_mm"] == second["beads_mm"] == mine != other
    assert first["views"]["pa"]["focal_point_mm"] != second["views"]["pa"]["focal_point_mm"]
    assert first["frame"] == Frame.load("gamma").key
    off = [np.subtract(first["beads_mm"][b.id], b.xyz_mm) for v in GAMMA.views.values() for b in v.fiducials]
    assert 0.01 < np.sqrt(np.mean(np.square(off))) < 0.3  # made to the tolerances


@pytest.mark.parametrize(("file", "why"), [("bone.nii", "is not an .nrrd"), ("bone.nrrd", "no bone as one volume")])
def test_no_ct_is_written_of_another_kind_or_of_an_object_without_bone(
    run, tmp_path: Path, file: str, why: str
) -> None:
    ran = run("simulate", "object", "--write-bone", tmp_path / file, "--out", tmp_path / "images")
    assert ran.code == 2
    assert why in ran.said
    assert not list(tmp_path.iterdir())
