"""The image formats that are read, one table for readers, acquisition, app and messages; limits on their size."""

from dataclasses import dataclass
from enum import Enum, auto
from pathlib import Path

import numpy as np

from sightline.common.bounded import MAX_PIXELS, regular_file
from sightline.errors import ImageError

MIN_SIDE = 16  # as `Radiograph`
HEADER_BYTES = 132  # tell the format: DICOM's preamble of 128 bytes and its magic number


class ReadBy(Enum):
    """What reads a format."""

    DICOM = auto()
    PILLOW = auto()
    NUMPY = auto()


@dataclass(frozen=True)
class ImageFormat:
    """A format of image files.

    `suffixes`: of its files, the first is the one that a case uses. `magic`: the bytes at `magic_at` that tell it.
    `holds`: the pixels that are read. `lossy`: always compressed with loss. `writable`: Sightline writes it too.
    """

    name: str
    suffixes: tuple[str, ...]
    magic: tuple[bytes, ...]
    reader: ReadBy
    holds: str
    magic_at: int = 0
    lossy: bool = False
    writable: bool = False


FORMATS = (
    ImageFormat(
        "DICOM",
        (".dcm", ".dicom"),
        (b"DICM",),
        ReadBy.DICOM,
        "8 to 16 bit, also runs",
        magic_at=128,
        writable=True,
    ),
    ImageFormat("PNG", (".png",), (b"\x89PNG\r\n\x1a\n",), ReadBy.PILLOW, "8 or 16 bit", writable=True),
    ImageFormat("TIFF", (".tif", ".tiff"), (b"II*\0", b"MM\0*"), ReadBy.PILLOW, "8 or 16 bit, 32-bit floating point"),
    ImageFormat("BMP", (".bmp",), (b"BM",), ReadBy.PILLOW, "8 bit"),
    ImageFormat("JPEG", (".jpg", ".jpeg"), (b"\xff\xd8\xff",), ReadBy.PILLOW, "8 bit", lossy=True),
    ImageFormat("NumPy", (".npy",), (b"\x93NUMPY",), ReadBy.NUMPY, "8 or 16 bit, floating point", writable=True),
)
FORMAT_NAMES = f"{', '.join(known.name for known in FORMATS[:-1])} or {FORMATS[-1].name}"
SUFFIXES = tuple(suffix for known in FORMATS for suffix in known.suffixes)


def format_of(start: bytes) -> ImageFormat | None:
    """Return the format of an image that begins with these HEADER_BYTES; None for other files."""
    return next((known for known in FORMATS if start[known.magic_at :].startswith(known.magic)), None)


def format_of_file(file: Path) -> ImageFormat | None:
    """Return the format of a file by its first bytes; None where it is not an image. Raises OSError."""
    with regular_file(file) as stream:
        return format_of(stream.read(HEADER_BYTES))


def is_image(path: Path) -> bool:
    """Return whether there is a file that begins as an image does. Raises OSError."""
    return path.is_file() and format_of_file(path) is not None


def check_size(height: int, width: int, name: str) -> None:
    """Raise ImageError where an image is too small or too large."""
    if min(height, width) < MIN_SIDE:
        raise ImageError(f"{name} has {width} x {height} pixels; an X-ray image has at least {MIN_SIDE} a side")
    if height * width > MAX_PIXELS:
        raise ImageError(f"{name} has {width} x {height} pixels; the limit is {MAX_PIXELS} in all: crop or reduce it")


def refuse_longer(stated: int, held: int, rows: int, row_bytes: int, name: str) -> None:
    """Raise ImageError where a file holds at least a row or a column more than it states: the image would be sheared.

    Less than that is padding.
    """
    if held - stated >= min(rows, row_bytes):
        raise ImageError(
            f"{name} holds more pixels than it states: {held} bytes or more, not {stated}; its rows and columns cannot "
            "be right: export it again"
        )


def damaged(name: str) -> ImageError:
    """Return the error for a truncated or inconsistent file."""
    return ImageError(f"{name} is truncated or damaged; copy or export it again")


def grey(pixels: np.ndarray, name: str) -> np.ndarray:
    """Return (H, W) of an array (H, W) or (H, W, channels) with equal colours. Raises ImageError on true colour."""
    if pixels.ndim == 2:
        return pixels
    colours = pixels[..., : 3 if pixels.shape[-1] >= 3 else 1]
    if pixels.ndim != 3 or pixels.shape[-1] > 4 or (colours != colours[..., :1]).any():
        raise ImageError(f"{name} is a colour image; export the X-ray image itself in grey, without drawings on it")
    return np.ascontiguousarray(colours[..., 0])
