"""Read and write DICOM. No element that identifies the patient is ever read."""

import re
import warnings
from collections.abc import Generator
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from hashlib import sha256
from io import BytesIO
from itertools import chain
from logging import getLogger
from math import isfinite
from pathlib import Path
from typing import Any

import numpy as np
from pydicom import Dataset, dcmread, dcmwrite
from pydicom.dataset import FileMetaDataset
from pydicom.encaps import get_frame
from pydicom.filereader import read_file_meta_info, read_partial
from pydicom.multival import MultiValue
from pydicom.pixels.utils import pixel_array
from pydicom.tag import BaseTag
from pydicom.uid import (
    JPEG2000,
    UID,
    DeflatedExplicitVRLittleEndian,
    ExplicitVRLittleEndian,
    JPEGBaseline8Bit,
    JPEGExtended12Bit,
    JPEGLSNearLossless,
    XRayAngiographicImageStorage,
    generate_uid,
)

from sightline.common.atomic import write_whole
from sightline.common.bounded import regular_file
from sightline.errors import ImageError
from sightline.imaging.decoder import Decoder, unpacks_to
from sightline.imaging.formats import check_size, damaged, grey, refuse_longer
from sightline.imaging.radiograph import GeometryTags, Radiograph

_LOSSY = {JPEGBaseline8Bit, JPEGExtended12Bit, JPEGLSNearLossless, JPEG2000}  # JPEG 2000 may be lossless

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
    "LossyImageCompression",
    "DistanceSourceToDetector",
    "ImagerPixelSpacing",
    "IntensifierSize",
    "PositionerPrimaryAngle",
    "PositionerSecondaryAngle",
]

_PIXEL_DATA = 0x7FE00010
# Elements with the time of acquisition, the nearest to the exposure first.
_TIMES = (("AcquisitionDateTime",), ("AcquisitionDate", "AcquisitionTime"), ("ContentDate", "ContentTime"))
_ZONE = "TimezoneOffsetFromUTC"
_STAMP = re.compile(r"(\d{14})(?:\.\d*)?([+-]\d{4})?")

# Elements that the standard requires and a mobile C-arm without a worklist leaves empty.
_EMPTY = [
    "StudyDate",
    "StudyTime",
    "AccessionNumber",
    "ReferringPhysicianName",
    "PatientBirthDate",
    "PatientSex",
    "PatientOrientation",
    "KVP",
    "XRayTubeCurrent",
    "ExposureTime",
    "PositionerMotion",
]


def read(file: Path, frame_index: int | None) -> Radiograph:
    """Return one frame of a DICOM file: XA, RF, CR, DX, secondary capture; native, RLE, JPEG, JPEG-LS or JPEG 2000.

    A compressed frame is decoded only if its own header agrees with the file's: a frame that would unpack to more is
    refused before decoding.

    Stored values are kept. They are inverted where fewer X-rays give larger values: where Pixel Intensity Relationship
    Sign (0028,1041) is -1; where that is absent, for MONOCHROME1 (times the sign of Rescale Slope), since C-arms show
    bone dark. Negative stored values are shifted up by the smallest value that can be stored.
    Raises ImageError.
    """
    with quiet():
        header = _header(file)
        index = _frame(header, frame_index, file.name)
        height, width, bits = _layout(header, file.name)
        stored = _decode(file, index, (height, width))
        lossy = header["LossyImageCompression"] == "01" or _syntax(file) in _LOSSY
    if stored.shape[:2] != (height, width):
        raise damaged(file.name)
    pixels, white = _as_x_rays(grey(stored, file.name), header, bits)
    return Radiograph(pixels, white, _geometry(header), lossy)


def taken_at(file: Path) -> datetime | None:
    """Return when the image of a DICOM file was acquired, by the device's clock; None where the file does not state it.

    Acquisition Date Time (0008,002A), else acquisition date and time, else content date and time; without Timezone
    Offset From UTC (0008,0201) in this machine's zone. Raises ImageError.
    """
    with quiet():
        try:
            times = dcmread(file, stop_before_pixels=True, specific_tags=[*chain(*_TIMES), _ZONE])
        except Exception:  # as in `_header`
            raise damaged(file.name) from None
        for keywords in _TIMES:
            match = _STAMP.fullmatch("".join(str(times.get(keyword) or "") for keyword in keywords).strip())
            if match is None:
                continue
            zone = match[2] or str(times.get(_ZONE) or "").strip()
            with suppress(ValueError):  # no such day or hour
                if zone:
                    return datetime.strptime(match[1] + zone, "%Y%m%d%H%M%S%z").astimezone(UTC)
                return datetime.strptime(match[1], "%Y%m%d%H%M%S").astimezone(UTC)  # this machine's zone
    return None


def frames_in(file: Path) -> int:
    """Return the number of frames that a file states. Raises ImageError."""
    with quiet():
        return _frames(_header(file), file.name)


def write(radiograph: Radiograph, path: str | Path, side: str | None = None) -> Path:
    """Write an X-ray angiographic image as a mobile C-arm does, with the geometry in `tags` only; return its path.

    `side`: of the patient, left or right, for Laterality (0020,0060); empty where it is None. 8 bits are stored in 8,
    10 to 16 bits in 16; MONOCHROME2, explicit little endian, a neutral patient. UIDs are derived from the pixels, so
    the same image gives the same file. Raises ImageError on pixels that are not whole numbers up to `white`.
    """
    pixels, bits = radiograph.pixels, int(radiograph.white + 1).bit_length() - 1 if isfinite(radiograph.white) else 0
    if pixels.dtype not in (np.uint8, np.uint16) or radiograph.white != 2**bits - 1 or pixels.max() > radiograph.white:
        raise ImageError("DICOM holds whole numbers from 0 to a white of 2^bits - 1; convert the pixels first")
    origin = sha256(pixels.tobytes()).hexdigest()
    image, study, series = (generate_uid(entropy_srcs=[origin, level]) for level in ("image", "study", "series"))
    tags = radiograph.tags
    dataset = fill(
        Dataset(),
        **dict.fromkeys(_EMPTY),
        SOPClassUID=XRayAngiographicImageStorage,
        SOPInstanceUID=image,
        StudyInstanceUID=study,
        SeriesInstanceUID=series,
        StudyID="1",
        SeriesNumber=1,
        InstanceNumber=1,
        Laterality=None if side is None else side[0].upper(),
        Modality="XA",
        Manufacturer="",
        ImageType=["ORIGINAL", "PRIMARY", "SINGLE PLANE"],
        PatientName="PHANTOM",
        PatientID="PHANTOM",
        PatientIdentityRemoved="YES",
        DeidentificationMethod="No patient was imaged",
        RadiationSetting="GR",
        PixelIntensityRelationship="LIN",
        LossyImageCompression="00",
        DistanceSourceToDetector=tags.source_detector_mm,
        ImagerPixelSpacing=None if tags.imager_pixel_spacing_mm is None else list(tags.imager_pixel_spacing_mm),
        IntensifierSize=tags.intensifier_size_mm,
        PositionerPrimaryAngle=tags.primary_angle_deg,
        PositionerSecondaryAngle=tags.secondary_angle_deg,
    )
    return write_whole(path, file_bytes(with_pixels(dataset, pixels, bits)))


def fill(dataset: Dataset, **elements: Any) -> Dataset:
    """Set elements by their keywords; return the data set."""
    for keyword, value in elements.items():
        setattr(dataset, keyword, value)
    return dataset


def with_pixels(dataset: Dataset, pixels: np.ndarray, bits: int) -> Dataset:
    """Set a grey image (H, W), uint8 or uint16, of which `bits` are used; return the data set."""
    raw = pixels.astype(pixels.dtype.newbyteorder("<"), copy=False).tobytes()
    fill(
        dataset,
        SamplesPerPixel=1,
        PhotometricInterpretation="MONOCHROME2",
        PixelRepresentation=0,
        Rows=pixels.shape[0],
        Columns=pixels.shape[1],
        BitsAllocated=8 * pixels.itemsize,
        BitsStored=bits,
        HighBit=bits - 1,
        PixelData=raw + b"\0" * (len(raw) % 2),
    )
    dataset["PixelData"].VR = "OW" if pixels.itemsize == 2 else "OB"
    return dataset


def file_bytes(dataset: Dataset) -> bytes:
    """Return a DICOM file's bytes, explicit VR little endian."""
    dataset.file_meta = FileMetaDataset()
    dataset.file_meta.TransferSyntaxUID = ExplicitVRLittleEndian
    buffer = BytesIO()
    dcmwrite(buffer, dataset, enforce_file_format=True)
    return buffer.getvalue()


_decoder = Decoder()


@contextmanager
def quiet() -> Generator[None]:
    """Silence pydicom, whose messages quote values of the header."""
    log = getLogger("pydicom")
    before, log.propagate, log.disabled = (log.propagate, log.disabled), False, True
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        log.propagate, log.disabled = before


def _header(file: Path) -> dict[str, Any]:
    """Return the elements of `_READ`, converted, so that malformed ones are refused. Raises ImageError."""
    try:
        if read_file_meta_info(file).TransferSyntaxUID == DeflatedExplicitVRLittleEndian:  # it could unpack to any size
            raise _undecodable(file.name)
        elements = dcmread(file, stop_before_pixels=True, specific_tags=_READ)
        return {keyword: elements.get(keyword) for keyword in _READ}
    except ImageError:
        raise
    except Exception:  # pydicom raises any exception on damaged data; its messages may quote the patient
        raise damaged(file.name) from None


def _whole(header: dict[str, Any], keyword: str, name: str) -> int:
    """Return a whole number; 0 where the element is absent or empty. Raises ImageError."""
    try:
        return int(header[keyword] or 0)
    except (TypeError, ValueError):
        raise damaged(name) from None


def _frames(header: dict[str, Any], name: str) -> int:
    return max(1, _whole(header, "NumberOfFrames", name))


def _frame(header: dict[str, Any], frame_index: int | None, name: str) -> int:
    frames = _frames(header, name)
    if frame_index is None and frames > 1:
        raise ImageError(f"{name} is a run of {frames} frames; say which one is meant, 0 to {frames - 1}")
    index = frame_index or 0
    if not 0 <= index < frames:
        raise ImageError(f"{name} has no frame {index}; it has frames 0 to {frames - 1}")
    return index


def _layout(header: dict[str, Any], name: str) -> tuple[int, int, int]:
    height, width, bits, allocated = (
        _whole(header, keyword, name) for keyword in ("Rows", "Columns", "BitsStored", "BitsAllocated")
    )
    if not height or not width:
        raise ImageError(f"{name} is a DICOM file without an image; export the image itself")
    check_size(height, width, name)
    if header["PhotometricInterpretation"] == "PALETTE COLOR":
        raise ImageError(f"{name} is a colour image; export the X-ray image itself in grey")
    if allocated not in (8, 16) or not 8 <= bits <= allocated:
        raise ImageError(f"{name} stores {bits} bits in {allocated}; 8 to 16 bits can be read")
    return height, width, bits


def _decode(file: Path, index: int, shape: tuple[int, int]) -> np.ndarray:
    try:
        syntax = _syntax(file)
        if not syntax.is_encapsulated:
            _refuse_longer(file, shape)
            return pixel_array(file, index=index)
        if unpacks_to(_coded(file, index), syntax, shape):
            return _decoder.decode(file, index)
    except ImageError:
        raise
    except Exception:  # as above; and UndecodableError
        raise _undecodable(file.name) from None
    raise _undecodable(file.name)


def _syntax(file: Path) -> UID:
    return read_file_meta_info(file).TransferSyntaxUID


def _refuse_longer(file: Path, shape: tuple[int, int]) -> None:
    """Raise ImageError where there are more uncompressed pixels than the header states."""
    lengths: list[int] = []

    def at_pixels(tag: BaseTag, _: str | None, length: int) -> bool:
        if tag == _PIXEL_DATA:
            lengths.append(length)
        return tag >= _PIXEL_DATA

    with regular_file(file) as stream:
        elements = read_partial(stream, at_pixels)
    if str(elements.PhotometricInterpretation).endswith(
        "_422"
    ):  # subsampled colours: two bytes per pixel instead of three
        return
    frames, samples = int(elements.get("NumberOfFrames") or 1), int(elements.get("SamplesPerPixel") or 1)
    row_bytes = shape[1] * samples * (int(elements.BitsAllocated) // 8)
    refuse_longer(frames * shape[0] * row_bytes, max(lengths, default=0), shape[0], row_bytes, file.name)


def _coded(file: Path, index: int) -> bytes:
    """Return the bytes of one compressed frame."""
    elements = dcmread(file, specific_tags=["NumberOfFrames", "PixelData"])
    return get_frame(elements.PixelData, index, number_of_frames=int(elements.get("NumberOfFrames") or 1))


def _undecodable(name: str) -> ImageError:
    return ImageError(f"the pixels of {name} are damaged, or compressed in a rare way; export it again, uncompressed")


def _as_x_rays(stored: np.ndarray, header: dict[str, Any], bits: int) -> tuple[np.ndarray, float]:
    """Return pixels that increase with the X-rays, uint8 or uint16, and their white."""
    white = 2**bits - 1
    values = stored.astype(np.int32)
    if header["PixelRepresentation"] == 1:
        if values.min() < 0:
            values += 2 ** (bits - 1)
        else:
            white = 2 ** (bits - 1) - 1
    sign = header["PixelIntensityRelationshipSign"]
    if sign not in (1, -1):
        shown = -1 if header["PhotometricInterpretation"] == "MONOCHROME1" else 1
        sign = -shown if (_number(header["RescaleSlope"]) or 1.0) < 0 else shown
    if sign == -1:
        values = white - values
    return values.astype(np.uint8 if white < 256 else np.uint16), float(white)


def _number(value: Any) -> float | None:
    """Return a finite number, or None where the element is absent, empty or malformed."""
    try:
        number = float(value)
    except (TypeError, ValueError):
        return None
    return number if isfinite(number) else None


def _length_mm(value: Any) -> float | None:
    """Return a positive number or None; in many headers zero means unknown."""
    number = _number(value)
    return number if number is not None and number > 0 else None


def _geometry(header: dict[str, Any]) -> GeometryTags:
    spacing = header["ImagerPixelSpacing"]
    row, column = (
        (_length_mm(v) for v in spacing) if isinstance(spacing, MultiValue) and len(spacing) == 2 else (None,) * 2
    )
    return GeometryTags(
        source_detector_mm=_length_mm(header["DistanceSourceToDetector"]),
        imager_pixel_spacing_mm=(row, column) if row and column else None,
        intensifier_size_mm=_length_mm(header["IntensifierSize"]),
        primary_angle_deg=_number(header["PositionerPrimaryAngle"]),
        secondary_angle_deg=_number(header["PositionerSecondaryAngle"]),
    )
