"""Size and completeness of PNG, BMP, TIFF and JPEG files, checked before a decoder reads them.

Decoders fill the missing part of a truncated file with grey, and allocate whatever memory a header asks for.
"""

import struct
import zlib
from collections.abc import Callable

from sightline.errors import ImageError
from sightline.imaging.compressed import jpeg_shape, packbits_size
from sightline.imaging.limits import check_size

_ADAM7 = ((0, 0, 8, 8), (4, 0, 8, 8), (0, 4, 4, 8), (2, 0, 4, 4), (0, 2, 2, 4), (1, 0, 2, 2), (0, 1, 1, 2))
# Of TIFF: compression (259), planar configuration (284).
_STORED, _LZW, _DEFLATE, _PACKBITS = 1, 5, (8, 32946), 32773
_PLANES_APART = 2
_MAX_PARTS = 2**20  # strips of the tallest image, in four planes [ours]

# (bytes of the file, its name) -> (height, width). Raises ImageError.
HeaderReader = Callable[[bytes, str], tuple[int, int]]


def png(data: bytes, name: str) -> tuple[int, int]:
    """Return height and width; checks that all chunks are present with valid checksums (ISO/IEC 15948, 5.3)."""
    at, header, ended, packed = 8, None, False, []
    while at + 12 <= len(data) and not ended:
        length, kind = struct.unpack_from(">I4s", data, at)
        body = data[at + 8 : at + 8 + length]
        if (
            at + 12 + length > len(data)
            or zlib.crc32(kind + body) != struct.unpack_from(">I", data, at + 8 + length)[0]
        ):
            raise damaged(name)
        if kind == b"IHDR" and length == 13:
            header = struct.unpack(">IIBBBBB", body)
        elif kind == b"IDAT":
            packed.append(body)
        at += 12 + length
        ended = kind == b"IEND"
    if header is None or not ended:
        raise damaged(name)
    width, height, depth, colour, *_, interlace = header
    check_size(height, width, name)
    rows, row_bytes = _png_layout(width, height, depth, colour, interlaced=interlace == 1)
    refuse_longer(rows * row_bytes, _inflated(b"".join(packed), 2 * rows * row_bytes, name), rows, row_bytes, name)
    return height, width


def _png_layout(width: int, height: int, depth: int, colour: int, *, interlaced: bool) -> tuple[int, int]:
    """Return rows and bytes per row, with the filter byte; all bytes as one row for an interlaced image."""
    bits = depth * {2: 3, 4: 2, 6: 4}.get(colour, 1)
    if not interlaced:
        return height, 1 + (width * bits + 7) // 8
    total = 0
    for left, top, across, down in _ADAM7:
        columns, rows = -(-(width - left) // across), -(-(height - top) // down)
        total += rows * (1 + (columns * bits + 7) // 8) if columns > 0 and rows > 0 else 0
    return 1, total


def _inflated(packed: bytes, most: int, name: str) -> int:
    """Return the unpacked size of a zlib stream, at most `most`. Raises ImageError."""
    try:
        return len(zlib.decompressobj().decompress(packed, max(most, 1)))
    except zlib.error:
        raise damaged(name) from None


def bmp(data: bytes, name: str) -> tuple[int, int]:
    """Return height and width; checks that all rows of an uncompressed bitmap are present (BITMAPINFOHEADER)."""
    if len(data) < 54:
        raise damaged(name)
    start, _, width, height, _, bits, compression = struct.unpack_from("<IIiiHHI", data, 10)
    if compression not in (0, 3):
        raise ImageError(f"{name} is a compressed bitmap; export it as PNG")
    height, row_bytes = abs(height), (width * bits + 31) // 32 * 4
    if width <= 0 or start + height * row_bytes > len(data):
        raise damaged(name)
    check_size(height, width, name)
    refuse_longer(height * row_bytes, len(data) - start, height, row_bytes, name)
    return height, width


def tiff(data: bytes, name: str) -> tuple[int, int]:
    """Return height and width of the only page; checks that strips or tiles lie within the file (TIFF 6.0, 2)."""
    order = "<" if data[:2] == b"II" else ">"
    try:
        (at,) = struct.unpack_from(order + "I", data, 4)
        (count,) = struct.unpack_from(order + "H", data, at)
        entries = (_tiff_entry(data, order, at + 2 + 12 * i) for i in range(count))
        tags = {tag: numbers for tag, numbers in entries if numbers}
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
    height, width = tags[257][0], tags[256][0]
    check_size(height, width, name)
    _check_parts([data[offset : offset + length] for offset, length in zip(offsets, lengths, strict=True)], tags, name)
    return height, width


def _check_parts(parts: list[bytes], tags: dict[int, tuple[int, ...]], name: str) -> None:
    """Raise ImageError where strips or tiles hold more pixels than the header states, or their number differs.

    The last strip may be padded.
    """
    stated, row_bytes = _tiff_layout(tags, name)
    if len(parts) != len(stated):
        raise damaged(name)
    held = [_part_size(part, tags.get(259, (1,))[0], 2 * size, name) for part, size in zip(parts, stated, strict=True)]
    if held[-1] == stated[0]:
        held[-1] = stated[-1]
    refuse_longer(sum(stated), sum(held), tags[257][0], row_bytes, name)


def _tiff_layout(tags: dict[int, tuple[int, ...]], name: str) -> tuple[list[int], int]:
    """Return the size of each strip or tile, and of a row of pixels, bytes (TIFF 6.0, 8 and 15). Raises ImageError."""
    height, width = tags[257][0], tags[256][0]
    channels = tags.get(277, (1,))[0]
    bits = tags.get(258, (1,))
    planes = channels if tags.get(284, (1,))[0] == _PLANES_APART else 1
    pixel_bits = (sum(bits) if len(bits) == channels else channels * bits[0]) // max(planes, 1)

    def bytes_of(columns: int) -> int:
        return (columns * pixel_bits + 7) // 8

    if 273 in tags:
        rows = min(tags.get(278, (height,))[0], height)
        count = -(-height // rows) if rows else 0
        sizes = [rows * bytes_of(width)] * (count - 1) + [(height - rows * (count - 1)) * bytes_of(width)]
    else:
        across, down = tags.get(322, (0,))[0], tags.get(323, (0,))[0]
        count = -(-width // across) * -(-height // down) if across and down else 0
        sizes = [down * bytes_of(across)] * count
    if not 0 < count * planes <= _MAX_PARTS or pixel_bits <= 0:
        raise damaged(name)
    return sizes * planes, planes * bytes_of(width)


def _part_size(part: bytes, packing: int, most: int, name: str) -> int:
    """Return the unpacked size of a strip or tile; counting stops beyond `most`. Raises ImageError."""
    if packing == _STORED:
        return len(part)
    if packing in _DEFLATE:
        return _inflated(part, most, name)
    if packing == _PACKBITS:
        return packbits_size(part, most)
    if packing == _LZW:
        from sightline.imaging.lzw import lzw_size

        try:
            return lzw_size(part, most)
        except ValueError:
            raise damaged(name) from None
    raise ImageError(
        f"{name} is compressed in a way whose length cannot be verified (TIFF compression {packing}); export it "
        "uncompressed, or with LZW, Deflate or PackBits"
    )


def refuse_longer(stated: int, held: int, rows: int, row_bytes: int, name: str) -> None:
    """Raise ImageError where a file holds at least a row or a column more than it states: the image would be sheared.

    Less than that is padding.
    """
    if held - stated >= min(rows, row_bytes):
        raise ImageError(
            f"{name} holds more pixels than it states: {held} bytes or more, not {stated}; its rows and columns cannot "
            "be right: export it again"
        )


def jpeg(data: bytes, name: str) -> tuple[int, int]:
    """Return height and width of the first frame header; checks for the end marker (ITU-T T.81, B.2.2)."""
    shape = jpeg_shape(data)
    if shape is None or b"\xff\xd9" not in data[-64:]:
        raise damaged(name)
    return shape


def damaged(name: str) -> ImageError:
    """Return the error for a truncated or inconsistent file."""
    return ImageError(f"{name} is truncated or damaged; copy or export it again")


def _tiff_entry(data: bytes, order: str, at: int) -> tuple[int, tuple[int, ...]]:
    """Return the tag and the whole numbers (none for other types) of a directory entry."""
    tag, kind, count = struct.unpack_from(order + "HHI", data, at)
    code, size = {3: ("H", 2), 4: ("I", 4)}.get(kind, ("", 0))
    if not size:
        return tag, ()
    if size * count > len(data):
        raise struct.error
    place = at + 8 if size * count <= 4 else struct.unpack_from(order + "I", data, at + 8)[0]
    return tag, struct.unpack_from(f"{order}{count}{code}", data, place)
