"""The image formats that are read, one table for readers, acquisition, app and messages; limits on size and values."""

from dataclasses import dataclass
from enum import Enum, auto
from pathlib import Path

import numpy as np

from sightline.common.bounded import MAX_PIXELS, regular_file
from sightline.errors import ImageError

MIN_SIDE = 16  # as `Radiograph`
HEADER_BYTES = 132  # tell the format: DICOM's preamble of 128 bytes and its magic number
_FIRST_BYTES = 2**10  # [ours] of the first value of a DICOM data set: a character set, an image type
# Largest difference of the channels of a grey image after a colour conversion, levels of 255: chroma that is off by one
# level moves red by 1.4, green by 1.1 and blue by 1.8, each rounded (ITU-R BT.601) [calc].
_CHROMA = 3
# Negative values [ours]: of noise about black, size against the brightest; of filters at edges, share of the pixels.
# The focal point of the demo's image moves by 0.01 mm for an offset of a tenth of its range.
_FAINT, _FEW = 0.01, 0.01
_APART = 0.05  # of the range of the other values: padding is further below them [ours]


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
    known = next((known for known in FORMATS if start[known.magic_at :].startswith(known.magic)), None)
    return FORMATS[0] if known is None and _is_bare_dicom(start) else known


def _is_bare_dicom(start: bytes) -> bool:
    """Return whether these are the first bytes of a DICOM file without its preamble (see `imaging.bare`)."""
    explicit = start[4:6].isalpha() and start[4:6].isupper()
    length = int.from_bytes(start[4:8], "little")
    implicit = start[:2] == b"\x08\0" and length < _FIRST_BYTES and length % 2 == 0
    is_group = start[:2] in (b"\2\0", b"\x08\0", b"\0\x08")
    return len(start) == HEADER_BYTES and (start[:4] == b"DICM" or (is_group and (explicit or implicit)))


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
    """Return (H, W) of (H, W), (1, H, W), or (H, W, channels) with equal colours, in this machine's byte order.

    Colours that differ as after a colour conversion become their luma. Raises ImageError on true colour.
    """
    pixels = pixels.astype(pixels.dtype.newbyteorder("="), copy=False)
    while pixels.ndim > 2 and pixels.shape[0] == 1:
        pixels = pixels[0]
    if pixels.ndim == 2:
        return pixels
    if pixels.ndim != 3 or pixels.shape[-1] > 4:
        raise ImageError(f"{name} has the shape {pixels.shape}; give one image (H, W)")
    if pixels.shape[-1] < 3:  # the second is opacity
        return np.ascontiguousarray(pixels[..., 0])
    red, green, blue = (pixels[..., k] for k in range(3))
    if (red == green).all() and (red == blue).all():
        return np.ascontiguousarray(red)
    colours = pixels[..., :3].astype(np.float64)
    is_whole = pixels.dtype.kind in "iu"
    if not np.ptp(colours, axis=2).max() <= _CHROMA / 255 * max(float(colours.max()), 255.0 * is_whole):
        raise ImageError(f"{name} is a colour image; export the X-ray image itself in grey, without drawings on it")
    luma = colours @ [0.299, 0.587, 0.114]
    return (np.rint(luma) if is_whole else luma).astype(pixels.dtype)


def non_negative(values: np.ndarray, bits: int | None, name: str) -> tuple[np.ndarray, float]:
    """Return signed values (H, W) without negative ones, and their white; `bits`: None where the range is not known.

    Negative X-rays do not exist. Padding, which is one value apart from all others, becomes black. Noise about black,
    and few values as a filter leaves them at edges, are clipped to 0. Where values fill the range's negative half, its
    lowest value is black. Raises ImageError on others: their black is not known.
    """
    lowest, brightest = values.min(), values.max()
    half = 2.0 ** (bits - 1) if bits else np.inf
    if lowest >= 0:
        return values, half - 1
    second = values[values > lowest].min(initial=brightest)
    if second >= 0 or second - lowest > _APART * (brightest - second):
        values, lowest = np.where(values == lowest, min(second, 0), values), min(second, 0)
    share = (values < 0).mean()
    fills_range = bits is not None and brightest >= half / 2
    if -lowest <= _FAINT * brightest or (share <= _FEW and not fills_range):
        return np.maximum(values, 0), half - 1
    if lowest <= -half / 2:
        return values + int(half), 2 * half - 1
    raise ImageError(
        f"{100 * share:.2g} % of the values of {name} are negative, down to {lowest:g}, so it is not known which value "
        "is black; export it without an offset, a subtraction or a normalisation"
    )
