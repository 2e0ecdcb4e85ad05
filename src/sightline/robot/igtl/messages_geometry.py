"""TRANSFORM, POSITION, POINT and TRAJ: poses, named points and straight paths. Lengths in mm."""

from dataclasses import dataclass
from typing import Self

import numpy as np
from scipy.spatial.transform import RigidTransform

from sightline.common.geometry.rigid import why_not_rigid
from sightline.errors import MessageError
from sightline.robot.igtl.wire import Reader, field, floats, read_only

Colour = tuple[int, int, int, int]
WHITE: Colour = (255, 255, 255, 255)


@dataclass(frozen=True, eq=False)
class Transform:
    """`matrix` (4, 4), mm. The upper three rows are sent as 32-bit floats, which resolve 0.00003 mm at 400 mm."""

    type_name = "TRANSFORM"
    matrix: np.ndarray

    def __post_init__(self):
        object.__setattr__(self, "matrix", _matrix(self.matrix))

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
    def read(cls, content: bytes) -> Self:
        """Read 48 bytes."""
        reader = Reader(content)
        matrix = read_matrix(reader)
        reader.finish()
        return cls(matrix)

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
    def read(cls, content: bytes) -> Self:
        """Read 28 bytes."""
        reader = Reader(content)
        position, quaternion = reader.floats(3), reader.floats(4)
        reader.finish()
        return cls(position, quaternion)

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
    def read(cls, content: bytes) -> Self:
        """Read 150 bytes per path."""
        reader, paths = Reader(content), []
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


def _matrix(values: np.ndarray) -> np.ndarray:
    matrix = read_only(values, "a transform", (4, 4))
    if matrix[3].tolist() != [0, 0, 0, 1]:
        raise MessageError(f"the last row of a transform is {matrix[3]}, not 0 0 0 1")
    return matrix


def read_matrix(reader: Reader) -> np.ndarray:
    """Return a matrix (4, 4) from the twelve numbers of its upper rows, column by column."""
    matrix = np.zeros((4, 4))
    matrix[:3], matrix[3, 3] = reader.floats(4, 3).T, 1
    return matrix
