"""NRRD files with their data attached, raw or gzip, as 3D Slicer writes a volume. The format is Teem's, NRRD0001-0005.

The reader is ours [ours]: pynrrd (MIT) decompresses without a limit, so only its parser of the header could be used.
"""

import gzip
import re
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from math import prod
from pathlib import Path
from typing import Any

import numpy as np

from sightline.common.bounded import regular_file
from sightline.errors import UnusableInputError

MAX_HEADER_BYTES = 2**16  # [ours] Slicer writes 1 kB for a volume
# Signs that take the file's axes to DICOM's patient coordinates.
_SPACES = {
    "left-posterior-superior": (1.0, 1.0, 1.0),
    "lps": (1.0, 1.0, 1.0),
    "right-anterior-superior": (-1.0, -1.0, 1.0),
    "ras": (-1.0, -1.0, 1.0),
}
_TYPES = {  # those that hold CT numbers
    "i2": ("short", "short int", "signed short", "signed short int", "int16", "int16_t"),
    "u2": ("ushort", "unsigned short", "unsigned short int", "uint16", "uint16_t"),
    "i4": ("int", "signed int", "int32", "int32_t"),
    "f4": ("float",),
    "f8": ("double",),
}
_WRITTEN = {"uint8": "unsigned char", "uint16": "unsigned short", "int16": "short", "float32": "float"}
_ENDIANS = {"little": "<", "big": ">"}
_OPEN: dict[str, Callable[[Any], Any]] = {
    "raw": lambda stream: stream,
    "gzip": lambda stream: gzip.GzipFile(fileobj=stream),
    "gz": lambda stream: gzip.GzipFile(fileobj=stream),
}


@dataclass(frozen=True, eq=False)
class Nrrd:
    """The header of a volume of `shape` (3,), in patient coordinates, mm; index i, j, k steps by a column of `steps_mm`
    (3, 3). The data begin at byte `start`."""

    file: Path
    shape: tuple[int, ...]
    origin_mm: np.ndarray
    steps_mm: np.ndarray
    dtype: np.dtype[Any]
    encoding: str
    start: int

    def slices(self) -> Iterator[np.ndarray]:
        """Yield the slices (nx, ny). Raises UnusableInputError where the file holds less or more than it states."""
        size = prod(self.shape[:2]) * self.dtype.itemsize
        try:
            with regular_file(self.file) as stream:
                stream.seek(self.start)
                data = _OPEN[self.encoding](stream)
                for _ in range(self.shape[2]):
                    yield np.frombuffer(data.read(size), self.dtype).reshape(self.shape[:2], order="F")
                if data.read(1):
                    raise ValueError("more data")
        except (OSError, EOFError, ValueError, zlib.error) as error:
            raise UnusableInputError(
                f"{self.file.name} is truncated or damaged, or holds more than it states; copy or export it again"
            ) from error


def nrrd_bytes(values: np.ndarray, origin_mm: np.ndarray, steps_mm: np.ndarray, statement: str) -> bytes:
    """Return a volume (nx, ny, nz) as a file: uint8, uint16, int16 or float32, in patient coordinates (LPS), mm.

    `origin_mm` (3,): of the first voxel. Index i, j, k steps by a row of `steps_mm` (3, 3).
    """
    lines = (
        "NRRD0005",
        f"type: {_WRITTEN[values.dtype.name]}",
        "dimension: 3",
        "space: left-posterior-superior",
        "sizes: " + " ".join(map(str, values.shape)),
        "space directions: " + " ".join(_vector(step) for step in steps_mm),
        "kinds: domain domain domain",
        "endian: little",
        "encoding: gzip",
        f"space origin: {_vector(origin_mm)}",
        f"sightline:={statement}",
    )
    raw = values.astype(values.dtype.newbyteorder("<"), copy=False).tobytes(order="F")
    return ("\n".join(lines) + "\n\n").encode("ascii", "replace") + gzip.compress(raw, mtime=0)


def _vector(xyz: np.ndarray) -> str:
    return "(" + ",".join(repr(float(x) + 0.0) for x in xyz) + ")"


def read_nrrd(file: Path) -> Nrrd:
    """Read the header of a volume. Raises UnusableInputError."""
    try:
        with regular_file(file) as stream:
            head = stream.read(MAX_HEADER_BYTES)
    except OSError as error:
        raise UnusableInputError(f"cannot read {file.name}: {error.strerror}") from error
    end = re.search(rb"\r?\n\r?\n", head)
    if not head.startswith(b"NRRD000") or end is None:
        raise UnusableInputError(f"{file.name} is not an NRRD file with its data attached; export it as one .nrrd")
    lines = head[: end.start()].decode("latin-1").splitlines()[1:]
    fields = {name.lower(): text.strip() for name, _, text in (line.partition(": ") for line in lines)}
    if set(fields) & {"data file", "datafile", "byte skip", "byteskip", "line skip", "lineskip"}:
        raise UnusableInputError(f"{file.name} keeps its data elsewhere; export it as one .nrrd with its data attached")
    return _header(file, fields, end.end())


def _header(file: Path, fields: dict[str, str], start: int) -> Nrrd:
    units = set(re.findall(r'"([^"]*)"', fields.get("space units", "")))
    if units - {"mm", ""}:
        raise UnusableInputError(f"{file.name} is in {', '.join(sorted(units))}; export it in mm")
    kinds = {name: kind for kind, names in _TYPES.items() for name in names}
    kind = _one_of(file, fields, "type", kinds)
    sign = np.array(_one_of(file, fields, "space", _SPACES))
    dtype = np.dtype(_one_of(file, fields, "endian", _ENDIANS) + kind)
    _one_of(file, fields, "encoding", _OPEN)
    shape = tuple(int(n) for n in _numbers(file, fields, "sizes", (3,)))
    origin = sign * _numbers(file, fields, "space origin", (3,))
    steps = sign[:, None] * _numbers(file, fields, "space directions", (3, 3)).T
    return Nrrd(file, shape, origin, steps, dtype, fields["encoding"].lower(), start)


def _one_of(file: Path, fields: dict[str, str], name: str, known: dict[str, Any]) -> Any:
    """Return the value that stands for the content of a field."""
    stated = fields.get(name, "nothing").lower()
    if stated not in known:
        raise UnusableInputError(f"{file.name} states {stated[:40]} for its {name}; export it with {', '.join(known)}")
    return known[stated]


def _numbers(file: Path, fields: dict[str, str], name: str, shape: tuple[int, ...]) -> np.ndarray:
    """Return the numbers of a field such as "512 512 90" or "(1,0,0) (0,1,0) (0,0,2.5)"."""
    words = re.sub(r"[(),]", " ", fields.get(name, "")).split()
    try:
        numbers = np.array(words, dtype=np.float64).reshape(shape)
    except ValueError:
        numbers = np.array(np.nan)
    if not np.isfinite(numbers).all():
        wanted = " x ".join(map(str, shape))
        raise UnusableInputError(f"{file.name} needs {wanted} numbers for its {name}; export it again as one scan")
    return numbers
