"""Read and write image files of all `FORMATS`. The first bytes identify the format, not the name."""

import re
from dataclasses import replace
from datetime import datetime
from pathlib import Path

import cv2
import numpy as np

from sightline.common.atomic import write_whole
from sightline.common.bounded import MAX_FILE_BYTES, MAX_RUN_BYTES, npy_array, read_bounded
from sightline.errors import ImageError, UnusableInputError
from sightline.imaging.formats import (
    FORMAT_NAMES,
    ImageFormat,
    ReadBy,
    check_size,
    format_of_file,
    grey,
    non_negative,
)
from sightline.imaging.radiograph import Radiograph


def read_image(path: str | Path, frame_index: int | None = None, *, invert: bool = False) -> Radiograph:
    """Return one X-ray image of 8 to 16 bit: DICOM, PNG, TIFF, BMP, JPEG or `.npy` (TIFF, `.npy` also floating point).

    Stored values are kept: no window, look-up table or rescaling is applied, because those may clip; only their
    direction is used, so that brighter means more X-rays (see `dicom.read`). A colour image with equal channels is
    accepted as grey. `frame_index` (from 0) selects a frame of a multi-frame run; without it, a run of several frames
    is refused. `invert`: the file shows areas reached by X-rays dark, contrary to its header. Raises ImageError.

    >>> image = sl.read_image("out/demo/demo_pa.dcm")
    >>> image.shape
    (1024, 1024)
    """
    image = _read(Path(path), frame_index)
    return image.inverted() if invert else image


def as_radiograph(image: Radiograph | np.ndarray | str | Path, white: float | None = None) -> Radiograph:
    """Return the Radiograph of a Radiograph, of an array (H, W) with its largest possible value `white`, or of a file.

    The default of `white` for integers is the largest value of their type. A camera with fewer bits needs its own value
    (4095 for 12), so that saturated pixels are known. Raises ImageError, UnusableInputError.
    """
    if isinstance(image, np.ndarray):
        return _of_array(grey(image, "the image"), "the image", white)
    if white is not None:
        raise UnusableInputError("white= belongs to an array; a Radiograph and a file state theirs")
    if isinstance(image, Radiograph):
        return image
    if isinstance(image, str | Path):
        return read_image(image)
    raise UnusableInputError(
        f"an image is a Radiograph, an array (H, W) or the path of a file, not {type(image).__name__}"
    )


def _of_array(stored: np.ndarray, name: str, white: float | None) -> Radiograph:
    """Return a radiograph of pixels (H, W); `white`: where it is known, and with it that 0 is black.

    Raises ImageError; UnusableInputError where neither `white` nor the type tells the largest value.
    """
    full = _full_scale(stored) if white is None else float(white)
    if stored.dtype not in (np.int8, np.int16):
        return Radiograph(stored, full)
    bits = 8 * stored.dtype.itemsize if white is None else None
    values, shifted = non_negative(stored.astype(np.int32), bits, name)
    return Radiograph(values.astype(f"u{stored.dtype.itemsize}"), shifted if white is None else full)


def _full_scale(pixels: np.ndarray) -> float:
    if pixels.dtype.kind not in "iu":
        raise UnusableInputError(
            f"give white=, the largest value that the detector can store: an array of {pixels.dtype} does not tell it"
        )
    return float(np.iinfo(pixels.dtype).max)


def _read(file: Path, frame_index: int | None) -> Radiograph:
    known = _format(file)
    if known is None:
        raise ImageError(f"{file.name} is not an image that can be read; give {FORMAT_NAMES}")
    if known.reader is ReadBy.DICOM:
        from sightline.imaging import dicom  # on first use: arrays need not wait 0.1 s for pydicom

        return dicom.read(file, frame_index)
    if frame_index not in (None, 0):
        raise ImageError(f"{file.name} holds one image, so there is no frame {frame_index}; leave the frame out")
    data = read_bounded(file, MAX_FILE_BYTES, ImageError, "export single images")
    if known.reader is ReadBy.NUMPY:
        return _radiograph(_numpy(data, file.name), file.name)
    from sightline.imaging.raster import read_raster  # with Pillow, on first use

    return replace(_radiograph(read_raster(data, known.name, file.name), file.name), lossy=known.lossy)


def frames_in(path: str | Path) -> int:
    """Return the number of frames of a file; 1 for all but DICOM runs. Raises ImageError."""
    if not _is_dicom(Path(path)):
        return 1
    from sightline.imaging import dicom

    return dicom.frames_in(Path(path))


def taken_at(path: str | Path) -> datetime | None:
    """Return when the image of a file was acquired, by the device's clock; None where it is not stated.

    Only DICOM states it. Raises ImageError.
    """
    if not _is_dicom(Path(path)):
        return None
    from sightline.imaging import dicom

    return dicom.taken_at(Path(path))


def _is_dicom(file: Path) -> bool:
    known = _format(file)
    return known is not None and known.reader is ReadBy.DICOM


def write_png(radiograph: Radiograph, path: str | Path) -> Path:
    """Write the pixels as an 8- or 16-bit grey PNG; return its path. Raises ImageError on floating-point pixels."""
    if radiograph.pixels.dtype not in (np.uint8, np.uint16):
        raise ImageError("a PNG holds whole numbers of 8 or 16 bits; convert the pixels before writing them")
    return write_whole(path, cv2.imencode(".png", radiograph.pixels)[1].tobytes())


def _format(file: Path) -> ImageFormat | None:
    """Return the format of a file that is neither empty nor too large. Raises ImageError."""
    try:
        size = file.stat().st_size
        if file.is_file() and 0 < size <= MAX_RUN_BYTES:
            return format_of_file(file)
    except OSError as error:
        raise ImageError(f"cannot read {file.name}: {error.strerror}") from error
    if not file.is_file():
        raise ImageError(f"{file.name} is a folder or a device, not a file; name one image file")
    if size == 0:
        raise ImageError(f"{file.name} is empty; export the image again")
    raise ImageError(f"{file.name} has {size} bytes; the limit is {MAX_RUN_BYTES}: export single images")


def _numpy(data: bytes, name: str) -> np.ndarray:
    def look(shape: tuple[int, ...], dtype: np.dtype) -> None:
        ones = next((k for k, side in enumerate(shape[:-2]) if side != 1), max(len(shape) - 2, 0))
        if len(shape) - ones not in (2, 3) or 0 in shape or dtype.hasobject:
            raise ImageError(f"{name} holds no image: shape {shape}, type {dtype}; save one (H, W) array of numbers")
        check_size(shape[ones], shape[ones + 1], name)

    try:
        return npy_array(data, look)
    except ValueError as error:
        raise ImageError(f"{name} is not a complete NumPy file; save the array again") from error


def _radiograph(pixels: np.ndarray, name: str) -> Radiograph:
    pixels = grey(pixels, name)
    if pixels.dtype.kind in "iu" and pixels.dtype.itemsize <= 2:  # of wider ones the type does not tell the white
        return _of_array(pixels, name, None)
    if pixels.dtype.kind == "f":
        with np.errstate(over="ignore"):  # values too large for float32 are refused as not finite
            pixels = pixels.astype(np.float32)
        largest = pixels.max()  # the saturation value is unknown: above the largest value
        return Radiograph(pixels, float(np.nextafter(largest, np.float32(np.inf))))
    raise ImageError(f"{name} holds {pixels.dtype} pixels; save them as 8-bit, 16-bit or floating-point numbers")


def in_order(folder: Path) -> list[Path]:
    """Return the visible files of a folder by name, numbers by value: frame2 before frame10."""
    return sorted((file for file in folder.iterdir() if file.name[0] != "."), key=_by_numbers)


def _by_numbers(file: Path) -> tuple[list[str | int], str]:
    """Return a key of texts and numbers in turn; the name decides between 2 and 02."""
    parts = re.split(r"([0-9]+)", file.name)
    return [int(part) if k % 2 else part for k, part in enumerate(parts)], file.name
