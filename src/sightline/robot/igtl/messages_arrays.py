"""Messages of numbers: TRANSFORM, POSITION, POINT and TRAJ (lengths in mm), SENSOR, NDARRAY and IMAGE."""

import math
import struct
from dataclasses import dataclass
from typing import Self

import numpy as np
from scipy.spatial.transform import RigidTransform

from sightline.common.geometry.rigid import why_not_rigid
from sightline.errors import MessageError
from sightline.robot.igtl.wire import Reader, field, floats, read_only

_SCALARS = {2: "i1", 3: "u1", 4: "i2", 5: "u2", 6: "i4", 7: "u4", 10: "f4", 11: "f8", 13: "c16"}
_CODES = {name: code for code, name in _SCALARS.items()}
_COMPLEX = 13  # allowed in arrays, not in images
_MAX_DIMENSIONS = 32  # what every version of numpy can hold


def unit(prefix: int, *factors: tuple[int, int]) -> int:
    """Return the code of a physical unit: SI prefix (4 bits), then up to six (unit, exponent) of 6 and 4 bits, as
    listed on the protocol's page on units."""
    code = prefix << 60
    for place, (base, exponent) in enumerate(factors):
        code |= (base << 4 | exponent & 0xF) << 50 - 10 * place
    return code


NEWTON = unit(0x0, (0x0B, 1))
MILLIMETRE = unit(0xB, (0x01, 1))


@dataclass(frozen=True, eq=False)
class Sensor:
    """`values` (N,), N at most 255, in the physical unit coded by `unit`; `status` is reserved by the protocol."""

    type_name = "SENSOR"
    values: np.ndarray
    unit: int = 0
    status: int = 0

    def __post_init__(self):
        object.__setattr__(self, "values", read_only(self.values, "a sensor's array", (None,)))

    @classmethod
    def read(cls, reader: Reader) -> Self:
        """Read 10 bytes and the numbers."""
        count, status, unit_code = reader.unpack("BBQ")
        return cls(reader.doubles(count), unit_code, status)

    def content(self) -> bytes:
        """Return 10 bytes and the numbers."""
        return struct.pack(">BBQ", len(self.values), self.status, self.unit) + self.values.astype(">f8").tobytes()


@dataclass(frozen=True, eq=False)
class NDArray:
    """`values` of any shape: integers of 8, 16 or 32 bits, floats of 32 or 64, complex of 128; the type is kept."""

    type_name = "NDARRAY"
    values: np.ndarray

    def __post_init__(self):
        object.__setattr__(self, "values", _plain(self.values))

    @classmethod
    def read(cls, reader: Reader) -> Self:
        """Read type, shape, numbers."""
        code, dimensions = reader.unpack("BB")
        if not 0 < dimensions <= _MAX_DIMENSIONS:
            raise MessageError(f"has {dimensions} dimensions; 1 to {_MAX_DIMENSIONS} are read")
        return cls(_numbers(reader, code, ">", reader.unpack(f"{dimensions}H")))

    def content(self) -> bytes:
        """Return type, shape, numbers."""
        shape = self.values.shape
        start = struct.pack(f">BB{len(shape)}H", _code(self.values), len(shape), *shape)
        return start + self.values.astype(self.values.dtype.newbyteorder(">")).tobytes()


@dataclass(frozen=True, eq=False)
class Image:
    """`pixels` (K, J, I) or (K, J, I, components), of any type of an array except complex.

    `matrix` (4, 4), mm: its columns are the steps along i, j, k and the centre of the whole image, in `coordinates`
    "RAS" or "LPS". For a part of an image, `offset` (i, j, k) is its first pixel and `size` the size of the whole.
    """

    type_name = "IMAGE"
    pixels: np.ndarray
    matrix: np.ndarray
    coordinates: str = "RAS"
    size: tuple[int, int, int] | None = None
    offset: tuple[int, int, int] = (0, 0, 0)

    def __post_init__(self):
        pixels = _plain(self.pixels)
        if pixels.ndim not in (3, 4) or _code(pixels) == _COMPLEX:
            raise MessageError(f"pixels have shape {pixels.shape} and type {pixels.dtype}; (K, J, I) and real are sent")
        part = pixels.shape[2::-1]
        size = part if self.size is None else self.size
        if any(start + count > whole for start, count, whole in zip(self.offset, part, size, strict=True)):
            raise MessageError(f"pixels {part} from {self.offset} reach beyond an image of {size}")
        if self.coordinates not in _COORDINATES.values():
            raise MessageError(f"coordinates {self.coordinates!r}; RAS or LPS")
        object.__setattr__(self, "pixels", pixels)
        object.__setattr__(self, "size", size)
        object.__setattr__(self, "matrix", read_only(self.matrix, "an image's matrix", (4, 4)))

    @classmethod
    def read(cls, reader: Reader) -> Self:
        """Read 72 bytes and the pixels, in the byte order stated."""
        version, components, code, order, coordinates = reader.unpack("HBBBB")
        size = reader.unpack("HHH")
        matrix = read_matrix(reader)
        offset, part = reader.unpack("HHH"), reader.unpack("HHH")
        known = order in _ORDERS and coordinates in _COORDINATES and code != _COMPLEX
        if not known or version != 1 or not components:
            raise MessageError(
                f"has version {version}, {components} components, type {code}, byte order {order}, "
                f"coordinates {coordinates}: not all of these are known"
            )
        shape = part[::-1] if components == 1 else (*part[::-1], components)
        pixels = _numbers(reader, code, _ORDERS[order], shape)
        return cls(pixels, matrix, _COORDINATES[coordinates], size, offset)

    def content(self) -> bytes:
        """Return 72 bytes and the pixels, lowest byte first."""
        components = self.pixels.shape[3] if self.pixels.ndim == 4 else 1
        coordinates = next(code for code, name in _COORDINATES.items() if name == self.coordinates)
        return (
            struct.pack(">HBBBB3H", 1, components, _code(self.pixels), 2, coordinates, *(self.size or ()))
            + floats(self.matrix[:3].T)
            + struct.pack(">6H", *self.offset, *self.pixels.shape[2::-1])
            + self.pixels.astype(self.pixels.dtype.newbyteorder("<"), copy=False).tobytes()
        )


_COORDINATES = {1: "RAS", 2: "LPS"}
_ORDERS = {1: ">", 2: "<"}


def _numbers(reader: Reader, code: int, order: str, shape: tuple[int, ...]) -> np.ndarray:
    if code not in _SCALARS:
        raise MessageError(f"holds numbers of an unknown type, {code}")
    dtype = np.dtype(order + _SCALARS[code])
    return np.frombuffer(reader.take(math.prod(shape) * dtype.itemsize), dtype=dtype).reshape(shape)


def _plain(values: np.ndarray) -> np.ndarray:
    """Return a read-only copy in native byte order. Raises MessageError for types that the protocol does not have."""
    array = np.asarray(values)
    _code(array)
    array = np.array(array, dtype=array.dtype.newbyteorder("="), order="C")
    array.flags.writeable = False
    return array


def _code(array: np.ndarray) -> int:
    name = array.dtype.str[1:]
    if name not in _CODES:
        raise MessageError(f"numbers of type {array.dtype} cannot be sent; {', '.join(_CODES)} can")
    return _CODES[name]


Colour = tuple[int, int, int, int]
WHITE: Colour = (255, 255, 255, 255)


@dataclass(frozen=True, eq=False)
class Transform:
    """`matrix` (4, 4), mm. The upper three rows are sent as 32-bit floats, which resolve 0.00003 mm at 400 mm."""

    type_name = "TRANSFORM"
    matrix: np.ndarray

    def __post_init__(self):
        matrix = read_only(self.matrix, "a transform", (4, 4))
        if matrix[3].tolist() != [0, 0, 0, 1]:
            raise MessageError(f"the last row of a transform is {matrix[3]}, not 0 0 0 1")
        object.__setattr__(self, "matrix", matrix)

    @classmethod
    def of(cls, pose: RigidTransform) -> Self:
        """Return the transform of a pose in mm."""
        return cls(pose.as_matrix())

    @property
    def fault(self) -> str | None:
        """Why it is not a rigid motion; None if it is one."""
        return why_not_rigid(self.matrix)

    def rigid(self) -> RigidTransform:
        """Return the pose, with its rotation orthonormalised. Raises MessageError if it is not a rigid motion."""
        if self.fault is not None:
            raise MessageError(f"the transform is not a rigid motion: {self.fault}")
        return RigidTransform.from_matrix(self.matrix)

    @classmethod
    def read(cls, reader: Reader) -> Self:
        """Read 48 bytes."""
        return cls(read_matrix(reader))

    def content(self) -> bytes:
        """Return 48 bytes: column by column."""
        return floats(self.matrix[:3].T)


@dataclass(frozen=True, eq=False)
class Position:
    """`position_mm` (3,) and `quaternion` (4,), x y z w, as received: its norm need not be 1."""

    type_name = "POSITION"
    position_mm: np.ndarray
    quaternion: np.ndarray

    def __post_init__(self):
        object.__setattr__(self, "position_mm", read_only(self.position_mm, "a position", (3,)))
        object.__setattr__(self, "quaternion", read_only(self.quaternion, "a quaternion", (4,)))

    @classmethod
    def read(cls, reader: Reader) -> Self:
        """Read 28 bytes."""
        return cls(reader.floats(3), reader.floats(4))

    def content(self) -> bytes:
        """Return 28 bytes."""
        return floats(self.position_mm) + floats(self.quaternion)


@dataclass(frozen=True, eq=False)
class Point:
    """`position_mm` (3,); `diameter_mm`: 0 if not stated; `owner`: the image that it belongs to."""

    name: str
    position_mm: np.ndarray
    group: str = ""
    rgba: Colour = WHITE
    diameter_mm: float = 0.0
    owner: str = ""

    def __post_init__(self):
        object.__setattr__(self, "position_mm", read_only(self.position_mm, "a point", (3,)))


@dataclass(frozen=True)
class Points:
    """Points, in the sender's order."""

    type_name = "POINT"
    points: tuple[Point, ...]

    @classmethod
    def read(cls, reader: Reader) -> Self:
        """Read 136 bytes per point."""
        points = []
        while reader.left:
            name, group, rgba = reader.text(64), reader.text(32), reader.unpack("4B")
            position, (diameter,) = reader.floats(3), reader.floats(1)
            points.append(Point(name, position, group, rgba, float(diameter), reader.text(20)))
        return cls(tuple(points))

    def content(self) -> bytes:
        """Return 136 bytes per point."""
        return b"".join(
            field(point.name, 64, "point")
            + field(point.group, 32, "group")
            + bytes(point.rgba)
            + floats(np.append(point.position_mm, point.diameter_mm))
            + field(point.owner, 20, "owner")
            for point in self.points
        )


@dataclass(frozen=True, eq=False)
class Path:
    """A straight path, `entry_mm` and `target_mm` (3,). `given`: which of them are given, 1 entry, 2 target, 3 both."""

    name: str
    entry_mm: np.ndarray
    target_mm: np.ndarray
    group: str = ""
    given: int = 3
    rgba: Colour = WHITE
    diameter_mm: float = 0.0
    owner: str = ""

    def __post_init__(self):
        object.__setattr__(self, "entry_mm", read_only(self.entry_mm, "an entry point", (3,)))
        object.__setattr__(self, "target_mm", read_only(self.target_mm, "a target point", (3,)))


@dataclass(frozen=True)
class Trajectories:
    """Paths, in the sender's order."""

    type_name = "TRAJ"
    paths: tuple[Path, ...]

    @classmethod
    def read(cls, reader: Reader) -> Self:
        """Read 150 bytes per path."""
        paths = []
        while reader.left:
            name, group, (given, _reserved) = reader.text(64), reader.text(32), reader.unpack("BB")
            rgba, entry, target = reader.unpack("4B"), reader.floats(3), reader.floats(3)
            diameter = float(reader.floats(1)[0])
            paths.append(Path(name, entry, target, group, given, rgba, diameter, reader.text(20)))
        return cls(tuple(paths))

    def content(self) -> bytes:
        """Return 150 bytes per path."""
        return b"".join(
            field(path.name, 64, "path")
            + field(path.group, 32, "group")
            + bytes((path.given, 0, *path.rgba))
            + floats(np.concatenate([path.entry_mm, path.target_mm, [path.diameter_mm]]))
            + field(path.owner, 20, "owner")
            for path in self.paths
        )


def read_matrix(reader: Reader) -> np.ndarray:
    """Return a matrix (4, 4) from the twelve numbers of its upper rows, column by column."""
    matrix = np.zeros((4, 4))
    matrix[:3], matrix[3, 3] = reader.floats(4, 3).T, 1
    return matrix
