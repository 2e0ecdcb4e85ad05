"""POLYDATA: points in mm, cells that join them, and attributes."""

import struct
from dataclasses import dataclass
from typing import Self

import numpy as np

from sightline.errors import MessageError
from sightline.robot.igtl.wire import Reader, floats, read_only, text_of

Cells = tuple[tuple[int, ...], ...]

_MAX_NAME = 255  # protocol


@dataclass(frozen=True, eq=False)
class Attribute:
    """`values` (N, components) on points or cells; `kind` as numbered on the protocol's page, 0: scalars of points."""

    name: str
    values: np.ndarray
    kind: int = 0

    def __post_init__(self):
        object.__setattr__(self, "values", read_only(self.values, "an attribute", (None, None)))


@dataclass(frozen=True, eq=False)
class PolyData:
    """`points_mm` (N, 3); each cell lists the indices of its points."""

    type_name = "POLYDATA"
    points_mm: np.ndarray
    vertices: Cells = ()
    lines: Cells = ()
    polygons: Cells = ()
    triangle_strips: Cells = ()
    attributes: tuple[Attribute, ...] = ()

    def __post_init__(self):
        object.__setattr__(self, "points_mm", read_only(self.points_mm, "points", (None, 3)))
        count = len(self.points_mm)
        for cells in (self.vertices, self.lines, self.polygons, self.triangle_strips):
            if any(not 0 <= number < count for cell in cells for number in cell):
                raise MessageError(f"a cell names a point that is not among the {count}")

    @classmethod
    def read(cls, content: bytes) -> Self:
        """Read ten counts, points, four lists of cells, attributes."""
        reader = Reader(content)
        count, *sizes, attribute_count = reader.unpack("10I")
        points = reader.floats(count, 3)
        cells = [_read_cells(reader, *pair) for pair in zip(sizes[::2], sizes[1::2], strict=True)]
        attributes = _read_attributes(reader, attribute_count)
        reader.finish()
        return cls(points, *cells, attributes=attributes)

    def content(self) -> bytes:
        """Return ten counts, points, four lists of cells, attributes."""
        lists = (self.vertices, self.lines, self.polygons, self.triangle_strips)
        packed = [_cell_bytes(cells) for cells in lists]
        sizes = [n for cells, data in zip(lists, packed, strict=True) for n in (len(cells), len(data))]
        counts = struct.pack(">10I", len(self.points_mm), *sizes, len(self.attributes))
        return counts + floats(self.points_mm) + b"".join(packed) + _attribute_bytes(self.attributes)


def _read_cells(reader: Reader, count: int, size: int) -> Cells:
    numbers = np.frombuffer(reader.take(size // 4 * 4), dtype=">u4").tolist()
    cells, at = [], 0
    while at < len(numbers):
        end = at + 1 + numbers[at]
        cells.append(tuple(numbers[at + 1 : end]))
        at = end
    if size % 4 or at != len(numbers) or len(cells) != count:
        raise MessageError(f"says that {count} cells take {size} bytes; they do not")
    return tuple(cells)


def _cell_bytes(cells: Cells) -> bytes:
    return np.array([n for cell in cells for n in (len(cell), *cell)], dtype=">u4").tobytes()


def _read_attributes(reader: Reader, count: int) -> tuple[Attribute, ...]:
    if 6 * count > reader.left:
        raise MessageError(f"says that {count} attributes follow; they do not")
    heads = [reader.unpack("BBI") for _ in range(count)]
    names, size = [], 0
    for _ in heads:
        name = b"".join(iter(lambda: reader.take(1), b"\0"))
        names.append(text_of(name))
        size += len(name) + 1
    reader.take(size % 2)
    return tuple(
        Attribute(name, reader.floats(length, components), kind)
        for name, (kind, components, length) in zip(names, heads, strict=True)
    )


def _attribute_bytes(attributes: tuple[Attribute, ...]) -> bytes:
    heads, names, values = b"", b"", b""
    for attribute in attributes:
        name = attribute.name.encode("utf-8")
        if len(name) > _MAX_NAME or b"\0" in name:
            raise MessageError(f"attribute {attribute.name!r}: at most {_MAX_NAME} bytes, none of them zero")
        heads += struct.pack(">BBI", attribute.kind, *attribute.values.shape[::-1])
        names += name + b"\0"
        values += floats(attribute.values)
    return heads + names + bytes(len(names) % 2) + values
