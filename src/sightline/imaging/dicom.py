"""Read and write DICOM. No element that identifies the patient is ever read."""

import re
from contextlib import suppress
from datetime import UTC, datetime
from hashlib import sha256
from io import BytesIO
from itertools import chain
from math import isfinite
from pathlib import Path
from typing import Any

import numpy as np
from pydicom import Dataset, dcmread, dcmwrite
from pydicom.dataset import FileMetaDataset
from pydicom.encaps import generate_fragments, get_frame
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
from sightline.imaging.bare import complete
from sightline.imaging.decoder import Decoder, starts_image, unpacks_to
from sightline.imaging.formats import check_size, damaged, grey, non_negative, refuse_longer
from sightline.imaging.quiet import Quiet
from sightline.imaging.radiograph import GeometryTags, Radiograph

_LOSSY = {JPEGBaseline8Bit, JPEGExtended12Bit, JPEGLSNearLossless, JPEG2000}  # JPEG 2000 may be lossless

# What may differ from frame to frame: an enhanced multi-frame object states it in its functional groups (PS3.3,
# C.7.6.16), within one sequence for each subject.
_OF_FRAMES = [
    "PixelIntensityRelationshipSign",
    "RescaleSlope",
    "DistanceSourceToDetector",
    "ImagerPixelSpacing",
    "IntensifierSize",
    "PositionerPrimaryAngle",
    "PositionerSecondaryAngle",
]
_SHARED, _EACH = "SharedFunctionalGroupsSequence", "PerFrameFunctionalGroupsSequence"
# Everything that is read besides the pixels and a palette.
_READ = [
    "SamplesPerPixel",
    "PhotometricInterpretation",
    "NumberOfFrames",
    "Rows",
    "Columns",
    "BitsAllocated",
    "BitsStored",
    "HighBit",
    "PixelRepresentation",
    "LossyImageCompression",
    *_OF_FRAMES,
    _SHARED,
    _EACH,
]
_PALETTE = [f"{c}PaletteColorLookupTable{part}" for part in ("Descriptor", "Data") for c in ("Red", "Green", "Blue")]

_PIXEL_DATA, _UNDEFINED = 0x7FE00010, 0xFFFFFFFF
_NO_TAG = 0x00080000  # of an element that is not needed
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


def read(path: Path, frame_index: int | None) -> Radiograph:
    """Return one frame of a DICOM file: XA, RF, CR, DX, secondary capture; native, RLE, JPEG, JPEG-LS or JPEG 2000.

    A compressed frame is decoded only if its own header agrees with the file's: a frame that would unpack to more is
    refused before decoding.

    Stored values are kept; a palette in grey is applied. They are inverted where fewer X-rays give larger values: where
    Pixel Intensity Relationship Sign (0028,1041) is -1; where that is absent, for MONOCHROME1 (times the sign of
    Rescale Slope), since C-arms show bone dark. Of negative values see `formats.non_negative`. Raises ImageError.
    """
    with quiet(), complete(path) as file:
        header = _header(file)
        index = _frame(header, frame_index, file.name)
        header |= _of_frame(header, index, file.name)
        height, width, bits = _layout(header, file.name)
        syntax = _syntax(file)
        stored = _decode(file, index, (height, width))
        if stored.shape[:2] != (height, width):
            raise damaged(file.name)
        values = _placed(stored, header, bits, file.name, coded=syntax.is_encapsulated)
        if header["PhotometricInterpretation"] == "PALETTE COLOR":
            values, bits = _through_palette(values, file)
    pixels, white = _as_x_rays(grey(values, file.name), header, bits, file.name)
    lossy = header["LossyImageCompression"] == "01" or syntax in _LOSSY
    return Radiograph(pixels, white, _geometry(header), lossy)


def taken_at(path: Path) -> datetime | None:
    """Return when the image of a DICOM file was acquired, by the device's clock; None where the file does not state it.

    Acquisition Date Time (0008,002A), else acquisition date and time, else content date and time; without Timezone
    Offset From UTC (0008,0201) in this machine's zone. Raises ImageError.
    """
    with quiet(), complete(path) as file:
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


def frames_in(path: Path) -> int:
    """Return the number of frames that a file states. Raises ImageError."""
    with quiet(), complete(path) as file:
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


quiet = Quiet("ignore", "pydicom")  # its messages quote values of the header


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


def claims_image(file: Path) -> bool:
    """Return whether a DICOM file's class is that of an image, or is unknown; not of an index or a dose report."""
    try:
        with quiet():
            keyword = UID(read_file_meta_info(file).get("MediaStorageSOPClassUID", "")).keyword
    except Exception:  # as in `_header`
        return True
    return keyword == "" or "ImageStorage" in keyword


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


def _of_frame(header: dict[str, Any], index: int, name: str) -> dict[str, Any]:
    """Return the elements that the functional groups state of one frame; its own come before those of all frames."""
    try:
        items = [*(header[_SHARED] or [])[:1], *(header[_EACH] or [])[index : index + 1]]
        groups = [group.value[0] for item in items for group in item if group.VR == "SQ" and group.value]
        return {key: group[key].value for group in groups for key in _OF_FRAMES if key in group}
    except Exception:  # as in `_header`
        raise damaged(name) from None


def _layout(header: dict[str, Any], name: str) -> tuple[int, int, int]:
    height, width, bits, allocated = (
        _whole(header, keyword, name) for keyword in ("Rows", "Columns", "BitsStored", "BitsAllocated")
    )
    if not height or not width:
        raise ImageError(f"{name} is a DICOM file without an image; export the image itself")
    check_size(height, width, name)
    if allocated not in (8, 16) or not 8 <= bits <= allocated:
        raise ImageError(f"{name} stores {bits} bits in {allocated}; 8 to 16 bits can be read")
    return height, width, bits


def _decode(file: Path, index: int, shape: tuple[int, int]) -> np.ndarray:
    """Return the values of one frame as they are stored, in all allocated bits. Raises ImageError."""
    try:
        syntax, length = _syntax(file), _pixel_length(file)
        if length == 0:
            raise ImageError(f"{file.name} holds no pixel data, at most those of an icon; export the image itself")
        if not syntax.is_encapsulated:
            if length == _UNDEFINED:
                raise ImageError(
                    f"the pixels of {file.name} are compressed, but its transfer syntax is missing or says that they "
                    "are not; export it again, uncompressed"
                )
            _refuse_longer(file, length, shape)
            return pixel_array(file, index=index, correct_unused_bits=False)
        if unpacks_to(_coded(file, index), syntax, shape, file.name):
            return _decoder.decode(file, index)
    except ImageError:
        raise
    except Exception:  # as above; and UndecodableError
        raise _undecodable(file.name) from None
    raise _undecodable(file.name)


def _syntax(file: Path) -> UID:
    return read_file_meta_info(file).TransferSyntaxUID


def _pixel_length(file: Path) -> int:
    """Return the length of the pixel data, bytes; _UNDEFINED where they are compressed, 0 where there are none."""
    lengths: list[int] = []

    def at_pixels(tag: BaseTag, _: str | None, length: int) -> bool:
        if tag == _PIXEL_DATA:
            lengths.append(length)
        return tag >= _PIXEL_DATA

    with regular_file(file) as stream:
        read_partial(stream, at_pixels, specific_tags=[_NO_TAG])
    return max(lengths, default=0)


def _refuse_longer(file: Path, length: int, shape: tuple[int, int]) -> None:
    """Raise ImageError where there are more uncompressed pixels than the header states."""
    stated = ["NumberOfFrames", "SamplesPerPixel", "BitsAllocated", "PhotometricInterpretation"]
    elements = dcmread(file, stop_before_pixels=True, specific_tags=stated)
    if str(elements.PhotometricInterpretation).endswith(
        "_422"
    ):  # subsampled colours: two bytes per pixel instead of three
        return
    frames, samples = int(elements.get("NumberOfFrames") or 1), int(elements.get("SamplesPerPixel") or 1)
    row_bytes = shape[1] * samples * (int(elements.BitsAllocated) // 8)
    frame_bytes = shape[0] * row_bytes
    if length // frame_bytes > frames and length % frame_bytes <= 1:
        raise _more_frames(length // frame_bytes, frames, file.name)
    refuse_longer(frames * frame_bytes, length, shape[0], row_bytes, file.name)


def _more_frames(held: int, stated: int, name: str) -> ImageError:
    return ImageError(
        f"{name} holds {held} times the pixels of a frame, but its Number of Frames says {stated}: it is a run, or its "
        "rows are wrong; export it again"
    )


def _coded(file: Path, index: int) -> bytes:
    """Return the bytes of one compressed frame. Raises ImageError where there are more frames than are stated."""
    elements = dcmread(file, specific_tags=["NumberOfFrames", "PixelData"])
    frames = int(elements.get("NumberOfFrames") or 1)
    if frames == 1:
        syntax = elements.file_meta.TransferSyntaxUID
        held = sum(starts_image(fragment, syntax) for fragment in list(generate_fragments(elements.PixelData))[1:])
        if held > 1:
            raise _more_frames(held, frames, file.name)
    return get_frame(elements.PixelData, index, number_of_frames=frames)


def _undecodable(name: str) -> ImageError:
    return ImageError(f"the pixels of {name} are damaged, or compressed in a rare way; export it again, uncompressed")


def _placed(stored: np.ndarray, header: dict[str, Any], bits: int, name: str, *, coded: bool) -> np.ndarray:
    """Return values (int32) from the bits of each stored one in which High Bit places them (PS3.5, 8.1.1).

    Compressed values stand at bit 0 where their codestream says so, whatever High Bit says. Other bits may hold an
    overlay. Raises ImageError where they are part of the values: without them the image would be rougher.
    """
    allocated, high = int(header["BitsAllocated"]), header["HighBit"]
    shift = 0 if high is None else int(high) + 1 - bits
    if not 0 <= shift <= allocated - bits:
        raise ImageError(f"{name} has High Bit {high}, which cannot hold {bits} bits in {allocated}; export it again")
    values = stored.astype(np.int32) & (2**allocated - 1)
    half = 2 ** (bits - 1) if header["PixelRepresentation"] == 1 else 0
    if shift and values.max() < 2**bits and (values & (2**shift - 1)).any():
        if not coded:
            raise ImageError(
                f"{name} says that its values end at bit {high}, but all are below {2**bits}; its High Bit cannot be "
                "right: export it again"
            )
        shift = 0
    values >>= shift
    below, above, ones = values & (2**bits - 1), values >> bits, 2 ** (allocated - shift - bits) - 1
    is_extended = (above == ones) & (values & half != 0)  # negative values may be
    if (above[~is_extended] != 0).any() and _roughness(values) <= _roughness(below):
        raise ImageError(f"{name} stores values above its {bits} bits, so Bits Stored cannot be right; export it again")
    return (below ^ half) - half


def _roughness(values: np.ndarray) -> float:
    return float(np.abs(np.diff(values, axis=1)).sum(dtype=np.float64))


def _through_palette(values: np.ndarray, file: Path) -> tuple[np.ndarray, int]:
    """Return the colours (H, W, 3) of palette entries, and their bits (PS3.3, C.7.6.3.1.5). Raises ImageError."""
    try:
        elements = dcmread(file, stop_before_pixels=True, specific_tags=_PALETTE)
        found = [_colour(elements, *keys) for keys in zip(_PALETTE[:3], _PALETTE[3:], strict=True)]
        first = int(elements[_PALETTE[0]].value[1])
        colours = np.stack([entries[np.clip(values - first, 0, len(entries) - 1)] for entries in found], axis=2)
    except Exception:  # as in `_header`
        raise ImageError(f"the palette of {file.name} cannot be read; export the image in grey") from None
    if colours.max() > 255 and not (colours % 257).any():  # bytes, each doubled
        colours //= 257
    return colours, 8 if colours.max() < 256 else 16


def _colour(elements: Dataset, descriptor: str, data: str) -> np.ndarray:
    """Return the entries of one colour of a palette."""
    raw, count = bytes(elements[data].value), int(elements[descriptor].value[0]) or 2**16
    if not elements.file_meta.TransferSyntaxUID.is_little_endian:
        raw = np.frombuffer(raw, ">u2").astype("<u2").tobytes()
    return np.frombuffer(raw, "<u2" if len(raw) >= 2 * count else "u1")[:count].astype(np.int32)


def _as_x_rays(values: np.ndarray, header: dict[str, Any], bits: int, name: str) -> tuple[np.ndarray, float]:
    """Return pixels that increase with the X-rays, uint8 or uint16, and their white."""
    white = 2.0**bits - 1
    is_palette = header["PhotometricInterpretation"] == "PALETTE COLOR"
    if header["PixelRepresentation"] == 1 and not is_palette:
        values, white = non_negative(values, bits, name)
    sign = header["PixelIntensityRelationshipSign"]
    if sign not in (1, -1):
        shown = -1 if header["PhotometricInterpretation"] == "MONOCHROME1" else 1
        sign = -shown if (_number(header["RescaleSlope"]) or 1.0) < 0 else shown
    if sign == -1:
        values = white - values
    return values.astype(np.uint8 if white < 256 else np.uint16), white


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
