"""Read PNG, TIFF, BMP and JPEG with Pillow, which refuses truncated and damaged files."""

from io import BytesIO
from typing import Any

import cv2
import numpy as np
from PIL import Image
from PIL.ImageFile import ImageFile

from sightline.common.bounded import MAX_PIXELS
from sightline.errors import ImageError
from sightline.imaging.formats import check_size, damaged, refuse_longer
from sightline.imaging.quiet import Quiet

_strict = Quiet("error", "PIL")  # Pillow warns of huge images and of inconsistent headers, before it reads a pixel

_BITS, _STRIP_BYTES, _TILE_WIDTH, _TILE_HEIGHT = 258, 279, 322, 323  # tags of TIFF
# Pillow's names of lossless compressions of TIFF. JPEG and fax in a TIFF are refused.
_LOSSLESS = ("raw", "tiff_lzw", "tiff_adobe_deflate", "tiff_deflate", "packbits")


def read_raster(data: bytes, format_name: str, name: str) -> np.ndarray:
    """Return the pixels (H, W) or (H, W, channels) of a file; `name`: of the file, for messages. Raises ImageError.

    Pillow reduces colour of 16 bits to 8. OpenCV reads those pixels, after Pillow has found the file whole.
    """
    try:
        with _strict(), Image.open(BytesIO(data), formats=(format_name,)) as image:
            check_size(image.height, image.width, name)
            image.verify()  # the checksums of a PNG; then it must be opened again
        with _strict(), Image.open(BytesIO(data), formats=(format_name,)) as image:
            _check_layout(image, data, name)
            wide_colour = len(image.getbands()) > 1 and ";16" in str(image.tile)
            image.load()
            pixels = _pixels(image)
    except (ImageError, MemoryError):
        raise
    except (Image.DecompressionBombWarning, Image.DecompressionBombError):
        raise ImageError(f"{name} has too many pixels; the limit is {MAX_PIXELS} in all: crop or reduce it") from None
    except Exception:  # Pillow raises any exception on damaged data
        raise damaged(name) from None
    if wide_colour:
        pixels = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
        if pixels is None:
            raise damaged(name)
        pixels = pixels[..., [2, 1, 0, *range(3, pixels.shape[2])]]  # blue is OpenCV's first
    return pixels


def _pixels(image: ImageFile) -> np.ndarray:
    if image.mode in ("1", "P"):
        return np.asarray(image.convert("L" if image.mode == "1" else "RGBA"))
    if image.mode in ("CMYK", "YCbCr", "LAB"):  # their first channels are not red, green and blue
        return np.asarray(image.convert("RGB"))
    pixels = np.asarray(image)
    signed = image.mode == "I" and _tag(image, _BITS) == (16,)
    return pixels.astype(np.int16) if signed else pixels


def _tag(image: ImageFile, tag: int) -> Any:
    return getattr(image, "tag_v2", {}).get(tag)


def _check_layout(image: ImageFile, data: bytes, name: str) -> None:
    """Raise ImageError on several pages, on a compression with loss in a TIFF, and on more pixels than are stated."""
    if getattr(image, "n_frames", 1) > 1:
        raise ImageError(f"{name} holds several pages; save the one image as a file of its own")
    packing = image.info.get("compression")
    if image.format == "TIFF" and packing not in _LOSSLESS:
        raise ImageError(f"{name} is compressed as {packing}; export it uncompressed, or with LZW, Deflate or PackBits")
    if (_tag(image, _TILE_WIDTH) or 0) * (_tag(image, _TILE_HEIGHT) or 0) > MAX_PIXELS:
        raise damaged(name)
    if _tag(image, _STRIP_BYTES) and packing == "raw":
        bits = _tag(image, _BITS) or (1,)
        row_bytes = (image.width * sum(bits) + 7) // 8
        refuse_longer(image.height * row_bytes, sum(_tag(image, _STRIP_BYTES)), image.height, row_bytes, name)
    if image.format == "BMP":
        tile: Any = image.tile[0]
        if tile.codec_name != "raw":
            raise ImageError(f"{name} is a compressed bitmap; export it as PNG")
        row_bytes = abs(tile.args[1])
        refuse_longer(image.height * row_bytes, len(data) - tile.offset, image.height, row_bytes, name)
