"""Size of a compressed DICOM frame once decoded, read from its header before a decoder runs."""

import struct

_J2K_SIZE = b"\xff\x4f\xff\x51"  # start of a codestream and its SIZ segment (ISO/IEC 15444-1, A.4 and A.5)
_JP2 = b"\x00\x00\x00\x0cjP  "  # a JP2 file around the codestream; the standard forbids it, some devices write it
_FRAME_HEADERS = {*range(0xC0, 0xD0), 0xF7} - {0xC4, 0xC8, 0xCC}  # SOF of JPEG; F7: of JPEG-LS
_RLE_SEGMENTS = 6  # PS3.5, G.3: two bytes of three colours
_RLE_HEADER = 64  # bytes


def unpacks_to(coded: bytes, syntax: str, shape: tuple[int, int]) -> bool:
    """Return whether a frame's header states `shape` (H, W), with three components and two bytes at most."""
    # Here, because other formats are read without pydicom.
    from pydicom.uid import JPEG2000TransferSyntaxes, JPEGLSTransferSyntaxes, JPEGTransferSyntaxes, RLELossless

    if syntax == RLELossless:
        return _rle_fits(coded, shape[0] * shape[1])
    if syntax in JPEGTransferSyntaxes or syntax in JPEGLSTransferSyntaxes:
        return jpeg_shape(coded) == shape
    return syntax in JPEG2000TransferSyntaxes and _j2k_shape(coded) == shape


def jpeg_shape(coded: bytes) -> tuple[int, int] | None:
    """Return height and width of the first frame header (ITU-T T.81, B.2.2); None where there is none."""
    at = 2
    while at + 9 <= len(coded) and coded[at] == 0xFF:
        if coded[at + 1] == 0xFF:  # a fill byte
            at += 1
            continue
        if coded[at + 1] in _FRAME_HEADERS:
            height, width, components = struct.unpack_from(">HHB", coded, at + 5)
            return (height, width) if components <= 3 else None
        at += 2 + struct.unpack_from(">H", coded, at + 2)[0]
    return None


def _j2k_shape(coded: bytes) -> tuple[int, int] | None:
    """Return height and width of the image area; None for other data and for more than three components."""
    at = coded.find(_J2K_SIZE, 0, 1024) if coded.startswith(_JP2) else 0
    if at < 0 or coded[at : at + 4] != _J2K_SIZE or len(coded) < at + 42:
        return None
    right, bottom, left, top = struct.unpack_from(">IIII", coded, at + 8)
    (components,) = struct.unpack_from(">H", coded, at + 40)
    return (bottom - top, right - left) if components <= 3 else None


def _rle_fits(coded: bytes, pixels: int) -> bool:
    """Return whether a frame is no longer than its pixels at their worst (PS3.5, G.3).

    A byte of a segment unpacks to 64 at most, so this bounds the result; the helper process limits its memory.
    """
    if len(coded) < _RLE_HEADER:
        return False
    (segments,) = struct.unpack_from("<I", coded)
    worst = _RLE_HEADER + segments * (pixels + pixels // 64 + 2)
    return 0 < segments <= _RLE_SEGMENTS and len(coded) <= worst
