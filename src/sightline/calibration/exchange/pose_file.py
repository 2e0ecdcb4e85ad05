"""Poses from files: a 4x4 matrix in JSON, or a transform of ITK (.tfm)."""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from sightline.calibration.exchange import reading
from sightline.common.geometry.rigid import why_not_rigid
from sightline.errors import UnusableInputError

if TYPE_CHECKING:
    from scipy.spatial.transform import RigidTransform

_ITK = b"#Insight Transform File"
# x' = M (x - c) + c + t: "Parameters" holds M, row by row, and t; "FixedParameters" holds c.
_KINDS = [
    f"{kind}_{real}_3_3" for kind in ("AffineTransform", "MatrixOffsetTransformBase") for real in ("double", "float")
]


def read_pose(path: str | Path) -> "RigidTransform":
    """Return the pose in a file, mm: it takes points of a CT or mesh to CFCS.

    JSON: 4 x 4 numbers, or {"matrix": 4 x 4 numbers}. ITK: one affine transform, in the direction in which ITK maps
    points; 3D Slicer shows the inverse of what its .tfm file holds. Raises UnusableInputError.
    """
    from scipy.spatial.transform import RigidTransform  # here: it takes 6 MB

    file = Path(path)
    data = reading.read_bytes(file)
    try:
        matrix = _of_itk(reading.text(data)) if data.startswith(_ITK) else _of_json(data)
    except UnusableInputError as error:
        raise UnusableInputError(f"{file.name}: {error}") from None
    if why := why_not_rigid(matrix):
        raise UnusableInputError(
            f"{file.name} is not a rigid pose: {why}; export it without scaling, shear or mirroring"
        )
    return RigidTransform.from_matrix(matrix)


def _of_json(data: bytes) -> np.ndarray:
    value = reading.json_value(data)
    return reading.array(reading.entry(value, "matrix") if isinstance(value, dict) else value, (4, 4), "the pose")


def _of_itk(text: str) -> np.ndarray:
    lines = [line.partition(":") for line in text.splitlines() if not line.startswith("#")]
    kinds = [value.strip() for name, _, value in lines if name == "Transform"]
    if len(kinds) != 1 or kinds[0] not in _KINDS:
        raise UnusableInputError(f"it holds {', '.join(kinds)[:80] or 'no transform'}; give one of {', '.join(_KINDS)}")
    values = {name: value.split() for name, _, value in lines}
    numbers = reading.array(reading.entry(values, "Parameters"), (12,), "the parameters")
    centre = reading.array(reading.entry(values, "FixedParameters"), (3,), "the fixed parameters")
    matrix = np.eye(4)
    matrix[:3, :3] = numbers[:9].reshape(3, 3)
    matrix[:3, 3] = numbers[9:] + centre - matrix[:3, :3] @ centre
    return matrix
