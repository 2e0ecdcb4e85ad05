"""Size of an LZW stream, without unpacking it."""

import numpy as np

from sightline.kernels import exact

_CLEAR, _END = 256, 257
_MAX_CODES = 4096


@exact
def _size(data: np.ndarray, most: int) -> int:
    lengths = np.ones(_MAX_CODES + 1, np.int64)
    known, width, before = _END + 1, 9, _CLEAR
    held = bits = total = at = 0
    while total <= most:
        while bits < width and at < len(data):
            held = ((held << 8) | data[at]) & 0xFFFFFF
            bits, at = bits + 8, at + 1
        if bits < width:
            return total
        code = (held >> (bits - width)) & ((1 << width) - 1)
        bits -= width
        if code == _END:
            return total
        if code == _CLEAR:
            known, width, before = _END + 1, 9, _CLEAR
            continue
        if before == _CLEAR:
            if code > 255:
                return -1
        else:
            if code > known or known >= _MAX_CODES:
                return -1
            lengths[known] = lengths[before] + 1
            known += 1
            if known >= (1 << width) - 1 and width < 12:
                width += 1
        total += lengths[code] if code > _END else 1
        before = code
    return total


def lzw_size(data: bytes, most: int) -> int:
    """Return the unpacked size of the LZW stream of a TIFF strip; counting stops beyond `most` (TIFF 6.0, 13).

    Raises ValueError on an invalid stream.
    """
    size = int(_size(np.frombuffer(data, np.uint8), most))
    if size < 0:
        raise ValueError("the LZW stream holds an undefined code")
    return size
