"""CT scans: written, read back, placed and projected; and each kind of bad one refused."""

import gzip
from pathlib import Path

import nibabel
import numpy as np
import pydicom
import pytest
from pydicom.dataset import FileMetaDataset
from pydicom.uid import CTImageStorage, ExplicitVRLittleEndian, generate_uid

from sightline.errors import UnusableInputError
from sightline.imaging.volumes.beam import TABLE_PER_CM
from sightline.imaging.volumes.ct import WATER_PER_CM, CtScan, ct_volumes, read_ct, shares_of_hu
from sightline.imaging.volumes.rays import Rays, volume_integral

VOXEL = np.array([0.9, 1.1, 2.5])
ORIGIN = np.array([-37.3, 21.9, -803.1])  # patient: left, back, head
SHAPE = (40, 36, 20)
TURN = np.linalg.qr(np.array([[1.0, 0.1, 0.05], [-0.1, 1.0, 0.02], [0.0, -0.03, 1.0]]))[0]
AXES = TURN * np.sign(np.diag(TURN))  # rows: nearly left, back, head


def made() -> CtScan:
    """Flesh in air with a ball of bone about (i, j, k) = (25, 14, 8), so that no two directions look alike."""
    i, j, k = np.meshgrid(*[np.arange(n) for n in SHAPE], indexing="ij")
    far = np.linalg.norm((np.stack([i, j, k], -1) - [25, 14, 8]) * VOXEL, axis=-1)
    hu = np.where(far < 8, 900, np.where((i > 2) & (i < 37) & (j > 2) & (j < 33), 40 + k, -1000))
    return CtScan(hu.astype(np.int16), ORIGIN, VOXEL, AXES)


def write_nifti(file: Path, scan: CtScan) -> Path:
    affine = np.eye(4)
    affine[:3, :3] = (scan.axes * scan.voxel_mm[:, None]).T
    affine[:3, 3] = scan.origin_mm
    image = nibabel.Nifti1Image(scan.hu, np.diag([-1.0, -1, 1, 1]) @ affine)
    image.header.set_xyzt_units("mm")
    nibabel.save(image, file)
    return file


NRRD = """NRRD0004
# Complete NRRD file format specification at:
type: short
dimension: 3
space: {space}
sizes: 40 36 20
space directions: {directions}
kinds: domain domain domain
endian: little
encoding: {encoding}
space origin: {origin}
note:=from: a test

"""


def vector(numbers) -> str:
    return "(" + ",".join(repr(float(n)) for n in numbers) + ")"


def write_nrrd(file: Path, scan: CtScan, encoding="gzip", change=("", ""), sign=(1, 1, 1)) -> Path:
    head = NRRD.format(
        space="left-posterior-superior" if sign == (1, 1, 1) else "right-anterior-superior",
        directions=" ".join(vector(sign * row) for row in scan.axes * scan.voxel_mm[:, None]),
        origin=vector(sign * scan.origin_mm),
        encoding=encoding,
    )
    assert change[0] in head
    data = scan.hu.astype("<i2").tobytes(order="F")
    file.write_bytes(head.replace(*change).encode() + (gzip.compress(data) if encoding == "gzip" else data))
    return file


def write_series(folder: Path, scan: CtScan, change=lambda k, one: None) -> Path:
    folder.mkdir()
    series = generate_uid()
    for k in range(scan.hu.shape[2]):
        one = pydicom.Dataset()
        one.file_meta = FileMetaDataset()
        one.file_meta.TransferSyntaxUID = ExplicitVRLittleEndian
        one.file_meta.MediaStorageSOPClassUID = one.SOPClassUID = CTImageStorage
        one.file_meta.MediaStorageSOPInstanceUID = one.SOPInstanceUID = generate_uid()
        one.SeriesInstanceUID, one.Modality = series, "CT"
        one.ImageOrientationPatient = [f"{c:.12f}" for c in scan.axes[:2].ravel()]
        one.ImagePositionPatient = [f"{c:.10f}" for c in scan.origin_mm + k * scan.voxel_mm[2] * scan.axes[2]]
        one.PixelSpacing = [float(scan.voxel_mm[1]), float(scan.voxel_mm[0])]
        one.RescaleSlope, one.RescaleIntercept = 2, -2048
        one.Columns, one.Rows = scan.hu.shape[:2]
        one.SamplesPerPixel, one.PhotometricInterpretation = 1, "MONOCHROME2"
        one.BitsAllocated, one.BitsStored, one.HighBit, one.PixelRepresentation = 16, 16, 15, 0
        one.PixelData = np.ascontiguousarray((scan.hu[:, :, k].T + 2048) // 2).astype("<u2").tobytes()
        change(k, one)
        one.save_as(folder / f"{(7 * k) % 97:03d}.dcm", enforce_file_format=True)  # names in no order
    return folder


@pytest.fixture(scope="module")
def even() -> CtScan:
    """CT numbers that a slope of 2 can hold."""
    scan = made()
    return CtScan((scan.hu // 2 * 2).astype(np.int16), scan.origin_mm, scan.voxel_mm, scan.axes)


def assert_same(read: CtScan, written: CtScan) -> None:
    assert np.array_equal(read.hu, written.hu)
    assert np.allclose(read.origin_mm, written.origin_mm, atol=1e-4)  # float32 of a NIfTI header
    assert np.allclose(read.voxel_mm, written.voxel_mm, atol=1e-6)
    assert np.allclose(read.axes, written.axes, atol=1e-6)


@pytest.mark.parametrize("name", ["scan.nii", "scan.nii.gz"])
def test_a_nifti_scan_comes_back(name, tmp_path):
    assert_same(read_ct(write_nifti(tmp_path / name, made())), made())


@pytest.mark.parametrize("encoding", ["raw", "gzip"])
@pytest.mark.parametrize("sign", [(1, 1, 1), (-1, -1, 1)], ids=["LPS", "RAS"])
def test_an_nrrd_scan_comes_back(encoding, sign, tmp_path):
    assert_same(read_ct(write_nrrd(tmp_path / "scan.nrrd", made(), encoding, sign=sign)), made())


BAD_NRRD = {  # what the message says, by what stands in the header instead
    "states nothing for its space": ("space: left-posterior-superior\n", ""),
    "states scanner-xyz for its space": ("left-posterior-superior", "scanner-xyz"),
    "states uchar for its type": ("type: short", "type: uchar"),
    "states bzip2 for its encoding": ("encoding: gzip", "encoding: bzip2"),
    "states nothing for its endian": ("endian: little\n", ""),
    "needs 3 numbers for its sizes": ("sizes: 40 36 20", "sizes: 3 40 36 20"),
    "needs 3 numbers for its space origin": ("space origin: (-37.3,", "space origin: (nan,"),
    "needs 3 x 3 numbers for its space directions": ("space directions: (", "space directions: none ("),
    "4000 x 4000 x 4000 voxels": ("sizes: 40 36 20", "sizes: 4000 4000 4000"),
    "is in m;": ("kinds:", 'space units: "m" "m" "m"\nkinds:'),
    "not perpendicular": ("kinds: domain domain domain", "space directions: (0.9,0.9,0) (0,0.9,0) (0,0,1)"),
    "data elsewhere": ("note:=from:", "data file:"),
    "truncated or damaged": ("sizes: 40 36 20", "sizes: 40 36 21"),
    "holds more than it states": ("sizes: 40 36 20", "sizes: 40 36 19"),
    "not an NRRD file": ("NRRD0004", "NHDR0004"),
}


@pytest.mark.parametrize("why", BAD_NRRD)
def test_a_bad_nrrd_file_is_refused(why, tmp_path):
    with pytest.raises(UnusableInputError, match=why):
        read_ct(write_nrrd(tmp_path / "scan.nrrd", made(), change=BAD_NRRD[why]))


def test_a_dicom_series_comes_back(even, tmp_path):
    assert_same(read_ct(write_series(tmp_path / "series", even)), even)


def test_shares_have_the_attenuation_of_the_ct_number():
    hu = np.arange(-1000, 3001, 7)
    tissue, bone = shares_of_hu(hu)
    mu = tissue * TABLE_PER_CM["tissue"][1] + bone * TABLE_PER_CM["bone"][1]
    assert np.allclose(mu, WATER_PER_CM * (1 + hu / 1000), atol=1e-6)
    assert tissue[0] == bone[0] == 0
    assert ((tissue >= 0) & (tissue <= 1) & (bone >= 0)).all()


@pytest.mark.parametrize("side", ["right", "left"])
def test_a_hip_lies_in_the_frame_as_the_conventions_say(side):
    """Rays through the ball of bone and 10 mm off it to lateral, caudal and anterior of the patient."""
    scan = made()
    ball = scan.origin_mm + (scan.voxel_mm * [25, 14, 8]) @ scan.axes
    out = 1.0 if side == "left" else -1.0
    marks = np.array([[0.0, 0, 0], [10 * out, 0, 0], [0, 0, -10], [0, -10, 0]])  # patient: lateral, caudal, anterior
    hu = scan.hu.copy()
    for value, mark in enumerate(marks[1:], start=1):
        i, j, k = np.rint((ball + mark - scan.origin_mm) @ scan.axes.T / scan.voxel_mm).astype(int)
        hu[i - 1 : i + 2, j - 1 : j + 2, k] = 1000 + 400 * value
    bone = ct_volumes(CtScan(hu, scan.origin_mm, scan.voxel_mm, scan.axes), side, ball, np.array([3.0, -4.0, 5.0]))[1]
    caudal = 1.0 if side == "right" else -1.0
    places = np.array([[3.0, -4, 5], [13, -4, 5], [3, -4 + 10 * caudal, 5], [3, -4, 15]])
    i, j, k = np.rint((places - bone.origin_mm) @ bone.axes.T / bone.voxel_mm).astype(int).T
    expected = shares_of_hu(np.array([900, 1400, 1800, 2200]))[1]
    assert np.allclose(bone.values[i, j, k], expected)
    assert np.linalg.det(bone.axes) == pytest.approx(1.0)


def test_a_ball_of_bone_in_a_scan_casts_its_chord():
    """Skewed voxels of unlike edges: the way through a smooth ball's edge to half a short voxel edge."""
    i, j, k = np.meshgrid(*[np.arange(n) for n in SHAPE], indexing="ij")
    far = np.linalg.norm((np.stack([i, j, k], -1) - [20.3, 17.6, 9.4]) * VOXEL, axis=-1)
    values = np.clip((14.0 - far) / 2.5 + 0.5, 0, 1).astype(np.float32)
    focal = np.array([-5.0, 9.0, -600.0])
    centre = VOXEL * [20.3, 17.6, 9.4]
    x, y = np.meshgrid(np.linspace(-10, 60, 40), np.linspace(-10, 60, 40))
    points = np.stack([x, y, np.full_like(x, 400.0)], -1)
    cast = volume_integral(Rays(focal, points, np.ones((40, 40), dtype=bool)), values, np.zeros(3), VOXEL)
    d = (points - focal) / np.linalg.norm(points - focal, axis=-1, keepdims=True)
    to = centre - focal
    across = np.linalg.norm(to - (d @ to)[..., None] * d, axis=-1)
    exact = 2 * np.sqrt(np.maximum(14.0**2 - across**2, 0))
    assert (exact > 20).sum() > 100
    assert np.abs(cast - exact)[exact > 20].max() < 0.45


def unlike(attribute, value):
    """A change of one slice."""
    return lambda k, one: setattr(one, attribute, value) if k == 3 else None


def without(attribute):
    return lambda k, one: delattr(one, attribute)


def shifted(k, one):
    if k > 10:
        one.ImagePositionPatient = [float(c) + 2.5 * a for c, a in zip(one.ImagePositionPatient, AXES[2], strict=True)]


def sheared(k, one):
    """The table moves along z while the gantry is tilted about x."""
    one.ImageOrientationPatient = [1, 0, 0, 0, 0.94, 0.342]
    one.ImagePositionPatient = [0, 0, 2.5 * k]


BAD_SERIES = {
    "modality MR": lambda k, one: setattr(one, "Modality", "MR"),
    "states no PixelSpacing": without("PixelSpacing"),
    "differ in SeriesInstanceUID": unlike("SeriesInstanceUID", "1.2.3"),
    "differ in PixelSpacing": unlike("PixelSpacing", [1.0, 1.0]),
    "one is missing": shifted,
    "0 x 1.1|voxels of 0": lambda k, one: setattr(one, "PixelSpacing", [1.1, 0]),
    "not perpendicular": lambda k, one: setattr(one, "ImageOrientationPatient", [1, 0, 0, 0.2, 0.98, 0]),
    "tilted gantry": sheared,
    "not CT numbers": lambda k, one: setattr(one, "RescaleIntercept", 0),
    "truncated or damaged": unlike("PixelData", b"\0" * 64),
    "many slices in one file": unlike("NumberOfFrames", 5),
}


@pytest.mark.parametrize("why", BAD_SERIES)
def test_a_bad_series_is_refused(why, even, tmp_path):
    folder = write_series(tmp_path / "series", even, BAD_SERIES[why])
    with pytest.raises(UnusableInputError, match=why):
        read_ct(folder)


def test_a_folder_of_other_files_is_refused(even, tmp_path):
    folder = write_series(tmp_path / "series", even)
    (folder / "notes.txt").write_text("a note")
    with pytest.raises(UnusableInputError, match=r"notes\.txt is not a DICOM"):
        read_ct(folder)
    (tmp_path / "none").mkdir()
    with pytest.raises(UnusableInputError, match="holds 0 files"):
        read_ct(tmp_path / "none")


# Where in the header (NIfTI-1), and what stands there instead.
BAD_NIFTI = {
    "has no orientation": (252, np.array([0, 0], "<i2")),
    "is in micron": (123, np.array([3], "u1")),
    "voxels of": (280, np.array([-0.001, 0, 0, 0], "<f4")),
    "not perpendicular": (280, np.array([-0.9, -0.9, 0, 0], "<f4")),
}


@pytest.mark.parametrize("why", BAD_NIFTI)
def test_a_bad_nifti_header_is_refused(why, tmp_path):
    straight = CtScan(made().hu, ORIGIN, VOXEL, np.eye(3))
    file = write_nifti(tmp_path / "scan.nii", straight)
    data, (at, value) = bytearray(file.read_bytes()), BAD_NIFTI[why]
    data[at : at + value.nbytes] = value.tobytes()
    file.write_bytes(bytes(data))
    with pytest.raises(UnusableInputError, match=why):
        read_ct(file)


def test_bad_nifti_contents_are_refused(tmp_path):
    scan = made()
    whole = write_nifti(tmp_path / "scan.nii", scan).read_bytes()
    (tmp_path / "cut.nii").write_bytes(whole[:-100])
    (tmp_path / "text.nii").write_text("no header")
    counts = CtScan(np.abs(scan.hu), *[getattr(scan, n) for n in ("origin_mm", "voxel_mm", "axes")])
    write_nifti(tmp_path / "counts.nii", counts)
    nibabel.save(nibabel.Nifti1Image(np.full((4, 4, 4), np.nan, np.float32), np.eye(4)), tmp_path / "nan.nii")
    nibabel.save(nibabel.Nifti1Image(np.zeros((4, 4, 4, 2), np.int16), np.eye(4)), tmp_path / "run.nii")
    for name, why in [
        ("cut.nii", "truncated"),
        ("text.nii", "not a NIfTI"),
        ("counts.nii", "not CT numbers"),
        ("nan.nii", "not finite"),
        ("run.nii", "4 dimensions"),
        ("none.nii", "there is no none"),
    ]:
        with pytest.raises(UnusableInputError, match=why):
            read_ct(tmp_path / name)


def test_a_huge_scan_is_refused_before_it_is_read(tmp_path):
    header = bytearray(write_nifti(tmp_path / "scan.nii", made()).read_bytes()[:352])
    header[40:56] = np.array([3, 4000, 4000, 4000, 1, 1, 1, 1], dtype="<i2").tobytes()
    (tmp_path / "huge.nii").write_bytes(bytes(header))
    with pytest.raises(UnusableInputError, match="4000 x 4000 x 4000 voxels"):
        read_ct(tmp_path / "huge.nii")


def test_a_side_is_right_or_left():
    with pytest.raises(UnusableInputError, match="side"):
        ct_volumes(made(), "up", np.zeros(3))
