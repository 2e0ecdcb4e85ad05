"""xReg's HDF5: files as its own writer makes them, all of its coordinate frames, and files that are not xReg's."""

from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from hypothesis import given, settings
from tests.calibration.exchange.cameras import pinholes, points_about_hip, project

from sightline.calibration.exchange.formats import read_view, write_view
from sightline.calibration.exchange.pinhole import Pinhole
from sightline.errors import UnusableInputError

POINTS = points_about_hip()
MATRIX = np.array([[5000.0, 0, 500, 310000], [0, 5000, 480, 290000], [0, 0, 1, 620]])
FLOAT_PX = 0.001  # what 32 bits may round a pixel by; measured up to 0.0004 over 300 cameras


def example(name: str = "a") -> Pinhole:
    return Pinhole.of_matrix(MATRIX, name, (90, 80), (0.2, 0.2))


def put(file: Path, pinhole: Pinhole, **changed: Any) -> None:
    """A file of ours in which what is stated of the camera is another."""
    file.write_bytes(write_view(pinhole, "xreg")[f"{pinhole.name}.xreg.h5"])
    with h5py.File(file, "r+") as held:
        cam = held["proj-000/cam"]
        for key, value in changed.items():
            del cam[key.replace("_", "-")]
            if value is not None:
                cam[key.replace("_", "-")] = value


def as_xreg_writes(group: h5py.Group, pinhole: Pinhole) -> None:
    """`WriteCamModelH5`: whole numbers of 64 bits, floats of 32, text of a fixed length."""
    assert pinhole.shape is not None and pinhole.pixel_mm is not None
    group.attrs["xreg-type"] = np.bytes_("cam-model")
    group["num-rows"], group["num-cols"] = np.uint64(pinhole.shape[0]), np.uint64(pinhole.shape[1])
    group["row-spacing"], group["col-spacing"] = np.float32(pinhole.pixel_mm[1]), np.float32(pinhole.pixel_mm[0])
    group["cam-coord-frame-type"] = np.bytes_("origin-at-focal-pt-det-pos-z")
    group["intrinsic"] = pinhole.camera_matrix.astype(np.float32)
    group["extrinsic"] = pinhole.extrinsic.astype(np.float32)


@pytest.mark.slow
@settings(max_examples=20, deadline=None, database=None)
@given(first=pinholes(), second=pinholes())
def test_projections_of_xregs_own_writer_are_read_by_name(tmp_path_factory, first: Pinhole, second: Pinhole) -> None:
    file = tmp_path_factory.mktemp("xreg") / "fluoro.xreg.h5"
    with h5py.File(file, "w") as held:
        held["num-projs"] = np.uint64(2)
        for k, pinhole in enumerate((first, second)):
            as_xreg_writes(held.create_group(f"proj-{k:03d}/cam"), pinhole)
            image = held.create_group(f"proj-{k:03d}/img")
            image.create_dataset("pixels", data=np.zeros(pinhole.shape or (), np.float32), compression=9)
            held[f"proj-{k:03d}/landmarks/FH-l"] = np.zeros((2, 1), np.float32)
    with pytest.raises(UnusableInputError, match="no projection 'fluoro'; its 2 projections are: proj-000, proj-001"):
        read_view(file)
    for k, pinhole in enumerate((first, second)):
        back = read_view(file, name=f"proj-{k:03d}")
        assert back.shape == pinhole.shape
        assert np.abs(back.view().project(POINTS) - project(pinhole, POINTS)).max() < FLOAT_PX


def test_the_only_projection_is_not_taken_for_another_one(tmp_path: Path) -> None:
    put(tmp_path / "a.xreg.h5", example())
    assert read_view(tmp_path / "a.xreg.h5", name="proj-000").name == "proj-000"
    with pytest.raises(UnusableInputError, match="no projection 'proj-001'; its 1 projections are: proj-000"):
        read_view(tmp_path / "a.xreg.h5", name="proj-001")


def test_a_camera_alone_is_read(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "c.xreg.h5", "w") as held:
        as_xreg_writes(held, example())
    back = read_view(tmp_path / "c.xreg.h5")
    assert np.abs(back.view().project(POINTS) - project(example(), POINTS)).max() < FLOAT_PX


@pytest.mark.parametrize("kind", [np.uint8, np.uint16, np.float32])
def test_what_is_written_is_what_xregs_reader_asks_for(tmp_path: Path, kind: type) -> None:
    """`ReadProjDataH5`: names, ranks and orders; HDF5 itself converts between sizes of numbers."""
    pinhole = example()
    pixels = np.arange(90 * 80).reshape(90, 80).astype(kind)
    (name, data), *others = write_view(pinhole, "xreg", pixels).items()
    assert (name, others) == ("a.xreg.h5", [])
    (tmp_path / name).write_bytes(data)
    with h5py.File(tmp_path / name) as held:
        assert held["num-projs"][()] == 1
        cam, image = held["proj-000/cam"], held["proj-000/img"]
        assert (cam["num-rows"][()], cam["num-cols"][()]) == (90, 80)
        assert (cam["row-spacing"][()], cam["col-spacing"][()]) == (0.2, 0.2)
        assert cam["cam-coord-frame-type"][()] == b"origin-at-focal-pt-det-pos-z"
        assert np.array_equal(cam["intrinsic"], pinhole.camera_matrix)
        assert np.array_equal(cam["extrinsic"], pinhole.extrinsic)
        assert image["pixels"].dtype == kind and np.array_equal(image["pixels"], pixels)
        assert np.array_equal(image["dir-mat"], np.eye(2))
        assert image["origin"].shape == image["spacing"].shape == (2, 1)
        assert cam["num-rows"].dtype.itemsize == 8 and held["num-projs"].dtype.kind == "u"
    assert write_view(pinhole, "xreg", pixels)[name] == data  # the same view, the same bytes


@pytest.mark.parametrize("frame", ["origin-at-focal-pt-det-neg-z", "origin-on-det"])
@settings(max_examples=10, deadline=None, database=None)
@given(pinhole=pinholes(mirrored=True))
def test_xregs_other_two_frames_give_the_same_pixels(tmp_path_factory, frame: str, pinhole: Pinhole) -> None:
    """By `phys_pt_to_ind_pt`: with z towards the source its images are mirrored ones."""
    file = tmp_path_factory.mktemp("xreg") / "pa.xreg.h5"
    put(file, pinhole)
    with h5py.File(file) as written:
        cam = written["proj-000/cam"]
        k, e, across = cam["intrinsic"][()], cam["extrinsic"][()], cam["col-spacing"][()]
    focal = abs(k[0, 0]) * across
    turn = np.diag([-1.0, 1.0, -1.0, 1.0])  # x and z reversed: right-handed still
    if frame == "origin-on-det":
        e = np.array([[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, focal], [0, 0, 0, 1]]) @ turn @ e
        k = k @ np.diag([-1.0, 1.0, 1.0])
    else:
        e = turn @ e
        k = np.array([[k[0, 0], 0, k[0, 2]], [0, -k[1, 1], k[1, 2]], [0, 0, 1]])
    p = POINTS @ e[:3, :3].T + e[:3, 3]
    if frame == "origin-on-det":
        p = np.column_stack([p[:, :2], focal - p[:, 2]])
    index = p @ k.T
    assert np.abs(index[:, :2] / index[:, 2:] - project(pinhole, POINTS)).max() < 1e-7  # the test's own construction
    put(file, pinhole, cam_coord_frame_type=np.bytes_(frame), intrinsic=k, extrinsic=e)
    assert np.abs(read_view(file).view().project(POINTS) - project(pinhole, POINTS)).max() < 1e-7


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"extrinsic": np.diag([1.0, 1.0, 1.1, 1.0])}, "not a rotation"),
        ({"extrinsic": np.diag([1.0, 1.0, -1.0, 1.0])}, "reflection"),
        ({"extrinsic": np.eye(3)}, "4 x 4"),
        ({"extrinsic": np.eye(40)}, "'extrinsic' is missing"),
        ({"intrinsic": np.full((3, 3), np.nan)}, "finite"),
        ({"intrinsic": None}, "'intrinsic' is missing"),
        ({"num_rows": np.float64(-4.0)}, "image size"),
        ({"row_spacing": np.float64(0.0)}, "above zero"),
        ({"row_spacing": np.bytes_("wide")}, "col-spacing|row-spacing"),
        ({"cam_coord_frame_type": np.bytes_("up")}, "cam-coord-frame-type is 'up'"),
        ({"intrinsic": h5py.SoftLink("/proj-000/cam/extrinsic")}, "'intrinsic' is missing"),
        ({"intrinsic": h5py.ExternalLink("other.h5", "intrinsic")}, "'intrinsic' is missing"),
    ],
)
def test_files_without_a_valid_camera_are_refused_with_the_reason(
    tmp_path: Path, changed: dict[str, Any], words: str
) -> None:
    file = tmp_path / "a.xreg.h5"
    put(file, example(), **changed)
    with pytest.raises(UnusableInputError, match=words) as refused:
        read_view(file)
    assert "a.xreg.h5" in str(refused.value)


def test_numbers_are_taken_from_the_file_itself_alone(tmp_path: Path) -> None:
    """Not from another file that it names, and nothing is unpacked or laid out that is larger than a matrix."""
    (tmp_path / "secret").write_bytes(np.eye(3).tobytes())
    file = tmp_path / "a.xreg.h5"
    virtual = h5py.VirtualLayout((3, 3), float)
    virtual[:] = h5py.VirtualSource(str(tmp_path / "b.h5"), "x", (3, 3))

    def outside(cam: h5py.Group) -> None:
        cam.create_dataset("intrinsic", (3, 3), float, external=[(str(tmp_path / "secret"), 0, 72)])

    def mapped(cam: h5py.Group) -> None:
        cam.create_virtual_dataset("intrinsic", virtual)

    def packed(cam: h5py.Group) -> None:
        cam.create_dataset("intrinsic", (3, 3), float, chunks=(10**4, 10**3), maxshape=(None, None), compression=9)

    def wide(cam: h5py.Group) -> None:
        cam.create_dataset("intrinsic", (), "S2000000000")

    for spoil in (outside, mapped, packed, wide):
        put(file, example(), intrinsic=None)
        with h5py.File(file, "r+") as held:
            spoil(held["proj-000/cam"])
        with pytest.raises(UnusableInputError, match="'intrinsic' is missing"):
            read_view(file)


def test_files_without_a_projection_are_refused(tmp_path: Path) -> None:
    file = tmp_path / "a.xreg.h5"
    for fill, words in (
        ({}, "its 0 projections are: none"),
        ({"num-projs": np.uint64(9)}, "its 0 projections are: none"),
        ({"num-projs": np.uint64(2**63)}, "num-projs must be"),
        ({"num-projs": np.uint64(1), "proj-000": 5.0}, "a group was expected"),
        ({"num-projs": np.uint64(1), "proj-000/x": 5.0}, "no group 'cam'"),
        ({"num-projs": np.bytes_("one")}, "num-projs"),
    ):
        with h5py.File(file, "w") as held:
            for key, value in fill.items():
                held[key] = value
        with pytest.raises(UnusableInputError, match=words):
            read_view(file)


def test_without_the_library_it_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "h5py", None)
    with pytest.raises(UnusableInputError, match=r"install sightline\[xreg\]"):
        write_view(example(), "xreg")
