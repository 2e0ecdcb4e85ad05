"""Size and wholeness of PNG, BMP, TIFF and JPEG files, read before a decoder touches them.

Decoders fill what is missing of a truncated file with grey and reserve whatever memory a header asks for.
"""

import struct
import zlib
from collections.abc import Callable

from sightline.errors import ImageError
from sightline.imaging.compressed import jpeg_shape

# (bytes of the file, its name) -> (height, width). Raises ImageError.
HeaderReader = Callable[[bytes, str], tuple[int, int]]


def png(data: bytes, name: str) -> tuple[int, int]:
    """Height and width; every chunk is there and its checksum right (ISO/IEC 15948, 5.3)."""
    at, size, ended = 8, None, False
    while at + 12 <= len(data) and not ended:
        length, kind = struct.unpack_from(">I4s", data, at)
        body = data[at + 8 : at + 8 + length]
        if (
            at + 12 + length > len(data)
            or zlib.crc32(kind + body) != struct.unpack_from(">I", data, at + 8 + length)[0]
        ):
            raise damaged(name)
        if kind == b"IHDR" and length == 13:
            width, height = struct.unpack_from(">II", body)
            size = height, width
        at += 12 + length
        ended = kind == b"IEND"
    if size is None or not ended:
        raise damaged(name)
    return size


def bmp(data: bytes, name: str) -> tuple[int, int]:
    """Height and width; an uncompressed bitmap's rows are all there (BITMAPINFOHEADER)."""
    if len(data) < 54:
        raise damaged(name)
    start, _, width, height, _, bits, compression = struct.unpack_from("<IIiiHHI", data, 10)
    if compression not in (0, 3):
        raise ImageError(f"{name} is a compressed bitmap; export it as PNG")
    height = abs(height)
    if width <= 0 or start + height * ((width * bits + 31) // 32 * 4) > len(data):
        raise damaged(name)
    return height, width


def tiff(data: bytes, name: str) -> tuple[int, int]:
    """Height and width of the only page; its strips or tiles lie within the file (TIFF 6.0, 2)."""
    order = "<" if data[:2] == b"II" else ">"
    try:
        (at,) = struct.unpack_from(order + "I", data, 4)
        (count,) = struct.unpack_from(order + "H", data, at)
        tags = dict(_tiff_entry(data, order, at + 2 + 12 * i) for i in range(count))
        (following,) = struct.unpack_from(order + "I", data, at + 2 + 12 * count)
    except struct.error:
        raise damaged(name) from None
    if following:
        raise ImageError(f"{name} holds several pages; save the one image as a file of its own")
    offsets, lengths = (tags.get(273) or tags.get(324) or ()), (tags.get(279) or tags.get(325) or ())
    if not tags.get(256) or not tags.get(257) or not offsets or len(offsets) != len(lengths):
        raise damaged(name)
    if any(offset + length > len(data) for offset, length in zip(offsets, lengths, strict=True)):
        raise damaged(name)
    return tags[257][0], tags[256][0]


def jpeg(data: bytes, name: str) -> tuple[int, int]:
    """Height and width of the first frame header; the end marker is there (ITU-T T.81, B.2.2)."""
    shape = jpeg_shape(data)
    if shape is None or b"\xff\xd9" not in data[-64:]:
        raise damaged(name)
    return shape


def damaged(name: str) -> ImageError:
    """The error of a file that breaks off or contradicts itself."""
    return ImageError(f"{name} is truncated or damaged; copy or export it again")


def _tiff_entry(data: bytes, order: str, at: int) -> tuple[int, tuple[int, ...]]:
    """One directory entry: its tag and its whole numbers (none for other types)."""
    tag, kind, count = struct.unpack_from(order + "HHI", data, at)
    code, size = {3: ("H", 2), 4: ("I", 4)}.get(kind, ("", 0))
    if not size:
        return tag, ()
    if size * count > len(data):
        raise struct.error
    place = at + 8 if size * count <= 4 else struct.unpack_from(order + "I", data, at + 8)[0]
    return tag, struct.unpack_from(f"{order}{count}{code}", data, place)
