"""DICOM in and out. No element that tells who the patient is, is ever read."""

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from hashlib import sha256
from io import BytesIO
from math import isfinite
from pathlib import Path
from typing import Any

import gdcm
import numpy as np
from pydicom import Dataset, dcmread, dcmwrite
from pydicom.dataset import FileMetaDataset
from pydicom.pixels.utils import pixel_array
from pydicom.uid import ExplicitVRLittleEndian, XRayAngiographicImageStorage, generate_uid

from sightline.atomic import write_whole
from sightline.errors import ImageError
from sightline.imaging.headers import damaged
from sightline.imaging.limits import check_size
from sightline.imaging.radiograph import GeometryTags, Radiograph

# Everything that is read besides the pixels.
_READ = [
    "SamplesPerPixel",
    "PhotometricInterpretation",
    "NumberOfFrames",
    "Rows",
    "Columns",
    "BitsAllocated",
    "BitsStored",
    "PixelRepresentation",
    "PixelIntensityRelationshipSign",
    "RescaleSlope",
    "DistanceSourceToDetector",
    "ImagerPixelSpacing",
    "IntensifierSize",
    "PositionerPrimaryAngle",
    "PositionerSecondaryAngle",
]

# Elements the standard wants present and a mobile C-arm without a worklist leaves empty.
_EMPTY = [
    "StudyDate",
    "StudyTime",
    "AccessionNumber",
    "ReferringPhysicianName",
    "StudyID",
    "SeriesNumber",
    "InstanceNumber",
    "PatientBirthDate",
    "PatientSex",
    "PatientOrientation",
    "KVP",
    "XRayTubeCurrent",
    "ExposureTime",
    "PositionerMotion",
]


def read(file: Path, frame_index: int | None) -> Radiograph:
    """One frame of a DICOM file: XA, RF, CR, DX, secondary capture; native, RLE, JPEG, JPEG-LS or JPEG 2000.

    Stored values are kept. They are inverted where fewer X-rays give larger ones: where Pixel Intensity Relationship
    Sign (0028,1041) says -1; where that is absent, for MONOCHROME1 (taken with the sign of Rescale Slope), since
    C-arms show bone dark. Negative stored values are shifted up by the smallest that can be stored.
    Raises ImageError.
    """
    with _quiet():
        try:
            header = dcmread(file, stop_before_pixels=True, specific_tags=_READ)
        except Exception:  # pydicom raises what the broken bytes make it raise; its messages may quote the patient
            raise damaged(file.name) from None
        index = _frame(header, frame_index, file.name)
        height, width, bits = _layout(header, file.name)
        stored = _decode(file, index)
    if stored.shape[:2] != (height, width):
        raise damaged(file.name)
    if stored.ndim == 3:
        if (stored != stored[..., :1]).any():
            raise ImageError(f"{file.name} is a colour image; export the X-ray image itself in grey")
        stored = stored[..., 0]
    pixels, white = _as_x_rays(stored, header, bits)
    return Radiograph(pixels, white, _geometry(header))


def write(radiograph: Radiograph, path: str | Path) -> Path:
    """Write an X-ray angiographic image as a mobile C-arm does: of the geometry only what `tags` holds, mostly nothing.

    8 bits in 8, 10 to 16 bits in 16, MONOCHROME2, explicit little endian, a neutral patient. UIDs are made from the
    pixels, so the same image gives the same file. Raises ImageError on pixels that are not whole numbers up to `white`.
    """
    pixels, bits = radiograph.pixels, int(radiograph.white + 1).bit_length() - 1 if isfinite(radiograph.white) else 0
    if pixels.dtype not in (np.uint8, np.uint16) or radiograph.white != 2**bits - 1 or pixels.max() > radiograph.white:
        raise ImageError("DICOM holds whole numbers from 0 to a white of 2^bits - 1; convert the pixels first")
    height, width = radiograph.shape
    origin = sha256(pixels.tobytes()).hexdigest()
    out = Dataset()
    out.SOPClassUID = XRayAngiographicImageStorage
    out.SOPInstanceUID, out.StudyInstanceUID, out.SeriesInstanceUID = (
        generate_uid(entropy_srcs=[origin, level]) for level in ("image", "study", "series")
    )
    for keyword in _EMPTY:
        setattr(out, keyword, None)
    out.Modality, out.Manufacturer, out.ImageType = "XA", "", ["ORIGINAL", "PRIMARY", "SINGLE PLANE"]
    out.PatientName, out.PatientID, out.PatientIdentityRemoved = "PHANTOM", "PHANTOM", "YES"
    out.DeidentificationMethod = "No patient was imaged"
    out.RadiationSetting, out.PixelIntensityRelationship, out.LossyImageCompression = "GR", "LIN", "00"
    tags = radiograph.tags
    out.DistanceSourceToDetector = tags.source_detector_mm
    out.ImagerPixelSpacing = None if tags.imager_pixel_spacing_mm is None else list(tags.imager_pixel_spacing_mm)
    out.IntensifierSize = tags.intensifier_size_mm
    out.PositionerPrimaryAngle, out.PositionerSecondaryAngle = tags.primary_angle_deg, tags.secondary_angle_deg
    out.SamplesPerPixel, out.PhotometricInterpretation, out.PixelRepresentation = 1, "MONOCHROME2", 0
    out.Rows, out.Columns = height, width
    out.BitsAllocated, out.BitsStored, out.HighBit = 8 * pixels.itemsize, bits, bits - 1
    raw = pixels.astype(pixels.dtype.newbyteorder("<"), copy=False).tobytes()
    out.PixelData = raw + b"\0" * (len(raw) % 2)
    out["PixelData"].VR = "OW" if pixels.itemsize == 2 else "OB"
    out.file_meta = FileMetaDataset()
    out.file_meta.TransferSyntaxUID = ExplicitVRLittleEndian
    buffer = BytesIO()
    dcmwrite(buffer, out, enforce_file_format=True)
    return write_whole(path, buffer.getvalue())


@contextmanager
def _quiet() -> Iterator[None]:
    """Nothing of a header reaches a log: pydicom's warnings quote values, and gdcm writes to stderr."""
    gdcm.Trace.WarningOff()
    gdcm.Trace.ErrorOff()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield


def _frame(header: Dataset, frame_index: int | None, name: str) -> int:
    frames = int(header.get("NumberOfFrames") or 1)
    if frame_index is None and frames > 1:
        raise ImageError(f"{name} is a run of {frames} frames; say which one is meant, 0 to {frames - 1}")
    index = frame_index or 0
    if not 0 <= index < frames:
        raise ImageError(f"{name} has no frame {index}; it has frames 0 to {frames - 1}")
    return index


def _layout(header: Dataset, name: str) -> tuple[int, int, int]:
    height, width, bits = (header.get(key) for key in ("Rows", "Columns", "BitsStored"))
    if not height or not width:
        raise ImageError(f"{name} is a DICOM file without an image; export the image itself")
    check_size(height, width, name)
    photometric = header.get("PhotometricInterpretation", "")
    if photometric == "PALETTE COLOR":
        raise ImageError(f"{name} is a colour image; export the X-ray image itself in grey")
    allocated = header.get("BitsAllocated")
    if allocated not in (8, 16) or not bits or not 8 <= bits <= allocated:
        raise ImageError(f"{name} stores {bits} bits in {allocated}; 8 to 16 bits can be read")
    return height, width, bits


def _decode(file: Path, index: int) -> np.ndarray:
    try:
        return pixel_array(file, index=index)
    except NotImplementedError:
        raise ImageError(f"{file.name} is compressed in a way that cannot be read; export it uncompressed") from None
    except Exception:  # as above: any broken byte
        raise damaged(file.name) from None


def _as_x_rays(stored: np.ndarray, header: Dataset, bits: int) -> tuple[np.ndarray, float]:
    """Pixels that grow with the X-rays, uint8 or uint16, and their white."""
    white = 2**bits - 1
    values = stored.astype(np.int32)
    if header.get("PixelRepresentation") == 1:
        if values.min() < 0:
            values += 2 ** (bits - 1)
        else:
            white = 2 ** (bits - 1) - 1
    sign = header.get("PixelIntensityRelationshipSign")
    if sign not in (1, -1):
        shown = -1 if header.get("PhotometricInterpretation") == "MONOCHROME1" else 1
        sign = -shown if _number(header, "RescaleSlope", 1.0) < 0 else shown
    if sign == -1:
        values = white - values
    return values.astype(np.uint8 if white < 256 else np.uint16), float(white)


def _number(header: Dataset, key: str, default: float) -> float:
    value = _value(header, key)
    return default if value is None else value


def _value(header: Dataset, key: str) -> Any:
    """A finite number, or None where the element is absent, empty or malformed."""
    try:
        value = float(header.get(key))  # type: ignore[arg-type]
    except (TypeError, ValueError):
        return None
    return value if isfinite(value) else None


def _length_mm(value: float | None) -> float | None:
    """Zero stands for "unknown" in many headers."""
    return value if value is not None and value > 0 else None


def _geometry(header: Dataset) -> GeometryTags:
    try:
        row, column = (_length_mm(float(v)) for v in header.get("ImagerPixelSpacing") or ())
    except (TypeError, ValueError):
        row = column = None
    return GeometryTags(
        source_detector_mm=_length_mm(_value(header, "DistanceSourceToDetector")),
        imager_pixel_spacing_mm=(row, column) if row and column else None,
        intensifier_size_mm=_length_mm(_value(header, "IntensifierSize")),
        primary_angle_deg=_value(header, "PositionerPrimaryAngle"),
        secondary_angle_deg=_value(header, "PositionerSecondaryAngle"),
    )
