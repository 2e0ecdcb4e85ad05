"""POINT and TRAJ: named points and straight paths. Lengths in mm."""

from dataclasses import dataclass
from typing import Self

import numpy as np

from sightline.robot.igtl.wire import Reader, field, floats, read_only

Colour = tuple[int, int, int, int]
WHITE: Colour = (255, 255, 255, 255)


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
    def read(cls, content: bytes) -> Self:
        """Read 136 bytes per point."""
        reader, points = Reader(content), []
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
    """A straight path, `entry_mm` and `target_mm` (3,). `kind`: which of them are given, 1 entry, 2 target, 3 both."""

    name: str
    entry_mm: np.ndarray
    target_mm: np.ndarray
    group: str = ""
    kind: int = 3
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
    def read(cls, content: bytes) -> Self:
        """Read 150 bytes per path."""
        reader, paths = Reader(content), []
        while reader.left:
            name, group, (kind, _reserved) = reader.text(64), reader.text(32), reader.unpack("BB")
            rgba, entry, target = reader.unpack("4B"), reader.floats(3), reader.floats(3)
            diameter = float(reader.floats(1)[0])
            paths.append(Path(name, entry, target, group, kind, rgba, diameter, reader.text(20)))
        return cls(tuple(paths))

    def content(self) -> bytes:
        """Return 150 bytes per path."""
        return b"".join(
            field(path.name, 64, "path")
            + field(path.group, 32, "group")
            + bytes((path.kind, 0, *path.rgba))
            + floats(np.concatenate([path.entry_mm, path.target_mm, [path.diameter_mm]]))
            + field(path.owner, 20, "owner")
            for path in self.paths
        )
