"""TRANSFORM, POSITION and TDATA: poses. Lengths in mm."""

from dataclasses import dataclass
from typing import Self

import numpy as np
from scipy.spatial.transform import RigidTransform

from sightline.errors import MessageError
from sightline.geometry.rigid import why_not_rigid
from sightline.robot.igtl.wire import Reader, field, floats, read_only


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
        return _matrix_bytes(self.matrix)


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
class Tracked:
    """A tool of TDATA, `matrix` (4, 4) in mm. `kind`: 1 tracker, 2 tool with 6 degrees of freedom, 3 tip, 4 tip and
    axis."""

    name: str
    matrix: np.ndarray
    kind: int = 2

    def __post_init__(self):
        object.__setattr__(self, "matrix", _matrix(self.matrix))


@dataclass(frozen=True)
class TrackingData:
    """Tools tracked at one time."""

    type_name = "TDATA"
    tools: tuple[Tracked, ...]

    @classmethod
    def read(cls, content: bytes) -> Self:
        """Read 70 bytes per tool."""
        reader, tools = Reader(content), []
        while reader.left:
            name, (kind, _reserved) = reader.text(20), reader.unpack("BB")
            tools.append(Tracked(name, read_matrix(reader), kind))
        return cls(tuple(tools))

    def content(self) -> bytes:
        """Return 70 bytes per tool."""
        return b"".join(
            field(tool.name, 20, "tool") + bytes((tool.kind, 0)) + _matrix_bytes(tool.matrix) for tool in self.tools
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


def _matrix_bytes(matrix: np.ndarray) -> bytes:
    return floats(matrix[:3].T)
