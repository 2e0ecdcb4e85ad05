"""DICOM files without preamble, file meta information or transfer syntax, as some devices and old programs write."""

import struct
from collections.abc import Generator
from contextlib import contextmanager, suppress
from pathlib import Path

from sightline.common.atomic import scratch_folder
from sightline.common.bounded import MAX_FILE_BYTES, read_bounded, regular_file
from sightline.errors import ImageError
from sightline.imaging.formats import HEADER_BYTES, damaged

_MAGIC = b"DICM"
_START = bytes(HEADER_BYTES - len(_MAGIC)) + _MAGIC
_META_BYTES = 2**16  # at most, of file meta information [ours]: programs write some 200
_LONG = (b"OB", b"OW", b"SQ", b"UN", b"UT", b"UC", b"UR")  # value representations with four bytes of length
_IMPLICIT, _EXPLICIT, _BIG_ENDIAN = b"1.2.840.10008.1.2", b"1.2.840.10008.1.2.1", b"1.2.840.10008.1.2.2"


@contextmanager
def complete(file: Path) -> Generator[Path]:
    """Yield a DICOM file, or a copy that has the preamble, file meta information and transfer syntax that it lacks.

    The first element of the data set tells an uncompressed transfer syntax (PS3.5, 7.1). Raises OSError, and
    ImageError for a file that ends within the first element.
    """
    with regular_file(file) as stream:
        start = stream.read(HEADER_BYTES + _META_BYTES)
    meta = start.find(_MAGIC, 0, HEADER_BYTES) + len(_MAGIC) if start[:4] == _MAGIC or start[128:132] == _MAGIC else 0
    body, syntax = _skipped(start, meta)
    if meta == HEADER_BYTES and syntax:
        yield file
        return
    if len(start) < body + 8:  # of an element's tag and length
        raise damaged(file.name)
    added = b"" if syntax else _syntax_element(start[body : body + 6])
    data = read_bounded(file, MAX_FILE_BYTES, ImageError, "export single images")
    with scratch_folder() as folder:
        copy = folder / file.name
        copy.write_bytes(_START + added + data[meta if syntax else body :])
        yield copy


def _skipped(data: bytes, at: int) -> tuple[int, bytes]:
    """Return where file meta information that begins at `at` ends, and its transfer syntax; b"" where it has none."""
    syntax = b""
    with suppress(struct.error):
        while data[at : at + 2] == b"\2\0":
            is_long = data[at + 4 : at + 6] in _LONG
            value = at + (12 if is_long else 8)
            (length,) = struct.unpack_from("<I" if is_long else "<H", data, value - (4 if is_long else 2))
            if data[at + 2 : at + 4] == b"\x10\0":
                syntax = data[value : value + length].strip(b"\0 ")
            at = value + length
    return at, syntax


def _syntax_element(first: bytes) -> bytes:
    """Return Transfer Syntax UID (0002,0010) for a data set by the first bytes of its first element."""
    explicit = first[4:6].isalpha() and first[4:6].isupper()
    big_endian = first[0] == 0 if first else False  # groups are small numbers
    uid = _IMPLICIT if not explicit else _BIG_ENDIAN if big_endian else _EXPLICIT
    uid += b"\0" * (len(uid) % 2)
    return b"\2\0\x10\0UI" + struct.pack("<H", len(uid)) + uid
