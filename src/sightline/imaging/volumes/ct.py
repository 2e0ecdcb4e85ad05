"""CT scans, from NIfTI and NRRD files and DICOM series, and as volumes of soft tissue and bone. Lengths mm.

Patient coordinates are DICOM's: x to the patient's left, y to the back, z to the head. Elements that identify the
patient are never read.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sightline.common.atomic import write_whole
from sightline.errors import UnusableInputError
from sightline.imaging.volumes.beam import TABLE_PER_CM
from sightline.imaging.volumes.nrrd import nrrd_bytes, read_nrrd
from sightline.imaging.volumes.volume import Volume

WATER_PER_CM = 0.206  # at 60 keV [calc, xraydb], where a CT number is taken as mu_water (1 + HU/1000)
MAX_VOXELS = 2**28  # [ours] 1,024 slices of 512², 0.5 GB
MAX_PARTED = 2**26  # [ours] voxels in shares: 256 slices of 512², 0.7 GB during projection
MAX_SLICES = MAX_VOXELS // 128**2  # files in one folder: slices of 128²
SPACING_MM = (0.1, 10.0)  # [ours] voxel edges of clinical CT; others are probably not in mm
HU = (-1024, 3071)  # range of twelve bits; values outside are clipped
AIR_HU = -1000  # without attenuation
NO_AIR_HU = -100  # [ours] a scan of a body has fat or air below this; values of another modality have not
# Of a regular stack [ours]: deviation of a spacing, of which a missing slice makes more, and cosine between axes that
# should be perpendicular; both are above the rounding of numbers in files.
UNEVEN, TILTED = 0.01, 1e-3
# Rows: CFCS axes in patient coordinates (docs/conventions.md: +X lateral, +Z anterior, +Y completes them).
CFCS_OF_PATIENT = {
    "right": np.array([[-1.0, 0, 0], [0, 0, -1], [0, -1, 0]]),
    "left": np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]),
}
_TAGS = [
    "Modality",
    "SeriesInstanceUID",
    "NumberOfFrames",
    "ImageOrientationPatient",
    "ImagePositionPatient",
    "PixelSpacing",
    "RescaleSlope",
    "RescaleIntercept",
    "Rows",
    "Columns",
]


@dataclass(frozen=True, eq=False)
class CtScan:
    """CT numbers `hu` (nx, ny, nz) int16; voxel [i, j, k] is at origin_mm + (voxel_mm * (i, j, k)) @ axes, patient
    coordinates, mm."""

    hu: np.ndarray
    origin_mm: np.ndarray
    voxel_mm: np.ndarray
    axes: np.ndarray


def read_ct(path: str | Path) -> CtScan:
    """Read a CT scan from a NIfTI file (.nii, .nii.gz), an NRRD file (.nrrd) or a folder with one DICOM series.

    Raises UnusableInputError if it is not a CT, states no spacing or position, lacks slices, is skewed or too large.
    """
    place = Path(path)
    if place.is_dir():
        return _series(place)
    if not place.is_file():
        raise UnusableInputError(f"there is no {place.name}; name a NIfTI or NRRD file or a folder of DICOM files")
    return _nrrd(place) if place.suffix.lower() == ".nrrd" else _nifti(place)


def ct_volumes(scan: CtScan, side: str, hip_mm: np.ndarray, at_mm: np.ndarray | None = None) -> tuple[Volume, Volume]:
    """Return soft tissue and bone of a scan in CFCS, with the point `hip_mm` (3,), patient coordinates, moved to
    `at_mm` (default: the origin).

    A voxel below soft tissue is a mixture of tissue and air, one above it of tissue and bone; one beyond cortical bone
    is denser bone, also where it is metal, which 12 bits clip. The mixture has the attenuation of the scan at 60 keV,
    and that of its materials at other energies.
    """
    if side not in CFCS_OF_PATIENT:
        raise UnusableInputError(f"a hip's side is 'right' or 'left', not {side!r}")
    if scan.hu.size > MAX_PARTED:
        raise UnusableInputError(
            f"the scan has {scan.hu.size} voxels, the limit is {MAX_PARTED}: crop it about the hip"
        )
    rotation = CFCS_OF_PATIENT[side]
    origin = rotation @ (scan.origin_mm - np.asarray(hip_mm)) + (np.zeros(3) if at_mm is None else np.asarray(at_mm))
    index = np.clip(scan.hu, *HU) - HU[0]
    tissue, bone = (
        Volume(share[index], origin, scan.voxel_mm, scan.axes @ rotation.T, material, None)
        for share, material in zip(shares_of_hu(np.arange(HU[0], HU[1] + 1)), ("tissue", "bone"), strict=True)
    )
    return tissue, bone


def shares_of_hu(hu: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the shares of soft tissue and cortical bone, float32, with the attenuation of CT numbers at 60 keV."""
    soft, hard = TABLE_PER_CM["tissue"][1], TABLE_PER_CM["bone"][1]
    mu = np.maximum(WATER_PER_CM * (1 + np.asarray(hu) / 1000), 0.0)
    tissue = np.interp(mu, [0.0, soft, hard], [0.0, 1.0, 0.0])
    bone = np.where(mu < hard, np.interp(mu, [soft, hard], [0.0, 1.0]), mu / hard)
    return tissue.astype(np.float32), bone.astype(np.float32)


def hu_of_bone(share: np.ndarray) -> np.ndarray:
    """Return the CT numbers of mixtures of cortical bone, by their shares, and soft tissue; `shares_of_hu` reversed."""
    soft, hard = TABLE_PER_CM["tissue"][1], TABLE_PER_CM["bone"][1]
    return 1000 * ((soft + share * (hard - soft)) / WATER_PER_CM - 1)


def write_ct(scan: CtScan, path: str | Path) -> Path:
    """Write a scan as NRRD; return its path. Raises UnusableInputError where it cannot be written."""
    return write_whole(path, nrrd_bytes(scan.hu, scan.origin_mm, scan.voxel_mm[:, None] * scan.axes, "CT"))


def _nifti(file: Path) -> CtScan:
    from nibabel.nifti1 import Nifti1Image

    try:
        image = Nifti1Image.from_filename(file, keep_file_open=True)  # else .gz is read from its start for each slice
        header = image.header
        codes, unit = (int(header["sform_code"]), int(header["qform_code"])), header.get_xyzt_units()[0]
        affine, shape = np.asarray(image.affine, dtype=np.float64), image.shape
    except Exception as error:  # broken bytes may make nibabel raise anything
        raise UnusableInputError(f"{file.name} is not a NIfTI file, or is damaged; export it again") from error
    if not any(codes):
        raise UnusableInputError(f"{file.name} has no orientation (sform, qform); export it with one")
    if unit not in ("mm", "unknown"):
        raise UnusableInputError(f"{file.name} is in {unit}; export it in mm")
    if len(shape) != 3:
        raise UnusableInputError(f"{file.name} has {len(shape)} dimensions; give one scan of three")
    _check_size(shape, file.name)
    to_patient = np.diag([-1.0, -1.0, 1.0])  # NIfTI: x to the right, y to the front
    slices = (_sound(lambda k=k: np.asarray(image.dataobj[:, :, k], np.float32), file.name) for k in range(shape[2]))
    return _scan(slices, shape, to_patient @ affine[:3, 3], to_patient @ affine[:3, :3], file.name)


def _nrrd(file: Path) -> CtScan:
    header = read_nrrd(file)
    _check_size(header.shape, file.name)
    return _scan(header.slices(), header.shape, header.origin_mm, header.steps_mm, file.name)


def _series(folder: Path) -> CtScan:
    import pydicom
    from pydicom.pixels.utils import pixel_array

    files = [file for file in sorted(folder.iterdir()) if file.is_file()]
    if not 0 < len(files) <= MAX_SLICES:
        raise UnusableInputError(f"{folder.name} holds {len(files)} files; give a folder of 1 to {MAX_SLICES}")
    slices = []
    for file in files:
        try:
            slices.append((file, pydicom.dcmread(file, stop_before_pixels=True, specific_tags=_TAGS)))
        except Exception as error:  # pydicom's messages may quote the patient
            raise UnusableInputError(f"{file.name} is not a DICOM file; leave only the scan in the folder") from error
    for file, header in slices:
        _check_slice(header, file.name)
    first = slices[0][1]
    for what in ("SeriesInstanceUID", "ImageOrientationPatient", "PixelSpacing", "Rows", "Columns"):
        if any(header[what].value != first[what].value for _, header in slices):
            raise UnusableInputError(f"the files of {folder.name} differ in {what}; leave one series in the folder")
    shape = int(first.Columns), int(first.Rows), len(slices)
    _check_size(shape, folder.name)
    right, down = np.array(first.ImageOrientationPatient, dtype=np.float64).reshape(2, 3)
    normal = np.cross(right, down)
    slices.sort(key=lambda entry: float(np.dot(entry[1].ImagePositionPatient, normal)))
    at = np.array([header.ImagePositionPatient for _, header in slices], dtype=np.float64)
    by_row, by_column = (float(c) for c in first.PixelSpacing)  # between rows, between columns
    steps = np.stack([by_column * right, by_row * down, _slice_step(at, folder.name)], 1)
    values = (
        _sound(lambda file=file: pixel_array(file), file.name).T * float(header.RescaleSlope)
        + float(header.RescaleIntercept)
        for file, header in slices
    )
    return _scan(values, shape, at[0], steps, folder.name)


def _sound(read: Callable[[], np.ndarray], name: str) -> np.ndarray:
    """Return what `read` returns. Raises UnusableInputError: broken bytes may make a library raise anything."""
    try:
        return read()
    except Exception as error:
        raise UnusableInputError(f"{name} is truncated or damaged; copy or export it again") from error


def _check_slice(header, name: str) -> None:
    """Raise UnusableInputError if a slice is not of a CT, or lacks elements that give its position."""
    if header.get("Modality") != "CT":
        raise UnusableInputError(f"{name} is of modality {header.get('Modality') or 'unknown'}; give a CT series")
    missing = [tag for tag in _TAGS if tag != "NumberOfFrames" and header.get(tag) in (None, "")]
    if missing:
        raise UnusableInputError(f"{name} states no {missing[0]}; export the series with it")
    if int(header.get("NumberOfFrames") or 1) > 1:
        raise UnusableInputError(f"{name} holds many slices in one file; export one file per slice")
    for tag, count in (("ImageOrientationPatient", 6), ("ImagePositionPatient", 3), ("PixelSpacing", 2)):
        if np.size(header[tag].value) != count:
            raise UnusableInputError(f"{name} has a malformed {tag}; export the series again")


def _slice_step(at_mm: np.ndarray, name: str) -> np.ndarray:
    """Return the step (3,) from slice to slice, mm. Raises UnusableInputError for missing or duplicate slices."""
    if len(at_mm) < 2:
        raise UnusableInputError(f"{name} holds one slice; give the whole series")
    mean = (at_mm[-1] - at_mm[0]) / (len(at_mm) - 1)
    uneven = np.linalg.norm(np.diff(at_mm, axis=0) - mean, axis=1).max()
    if not uneven <= UNEVEN * np.linalg.norm(mean):
        raise UnusableInputError(
            f"the slices of {name} are not evenly spaced: one is missing or duplicate; export the series again"
        )
    return mean


def _check_size(shape: tuple[int, ...], name: str) -> None:
    if min(shape) < 2 or np.prod(shape, dtype=np.float64) > MAX_VOXELS:
        raise UnusableInputError(
            f"{name} has {' x '.join(map(str, shape))} voxels; a scan has two a side and at most {MAX_VOXELS} in all: "
            "crop it about the hip"
        )


def _scan(
    slices: Iterable[np.ndarray], shape: tuple[int, ...], origin_mm: np.ndarray, steps_mm: np.ndarray, name: str
) -> CtScan:
    """Return a scan of slices (nx, ny), read one by one. Raises UnusableInputError.

    Indices i, j, k step by the columns of `steps_mm` (3, 3), patient coordinates.
    """
    voxel = np.linalg.norm(steps_mm, axis=0)
    if not (np.isfinite(origin_mm).all() and (voxel >= SPACING_MM[0]).all() and (voxel <= SPACING_MM[1]).all()):
        raise UnusableInputError(
            f"{name} has voxels of {' x '.join(f'{v:.4g}' for v in voxel)} mm; a CT has {SPACING_MM[0]:g} to "
            f"{SPACING_MM[1]:g}: export it with its spacing"
        )
    axes = (steps_mm / voxel).T
    if np.abs(axes @ axes.T - np.eye(3)).max() > TILTED:
        raise UnusableInputError(
            f"the axes of {name} are not perpendicular (a tilted gantry?); resample it to perpendicular axes"
        )
    hu = np.empty(shape, dtype=np.int16)
    for k, values in enumerate(slices):
        if not np.isfinite(values).all():
            raise UnusableInputError(f"{name} holds values that are not finite; export it again without them")
        hu[:, :, k] = np.clip(np.rint(values), *HU)
    if hu.min() > NO_AIR_HU:
        raise UnusableInputError(
            f"{name} has no value below {NO_AIR_HU}, so its values are not CT numbers; give a CT in Hounsfield units"
        )
    return CtScan(hu, origin_mm, voxel, axes)
