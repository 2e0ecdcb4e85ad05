"""Parts common to all formats: size limits, text, strict JSON, finite numbers. Readers raise UnusableInputError."""

import json
import re
from pathlib import Path
from typing import Any

import numpy as np

from sightline.common.bounded import MAX_TEXT_BYTES, read_bounded
from sightline.common.strict import strict_json
from sightline.errors import UnusableInputError

MAX_NUMBER = 1e12  # [calc] focal lengths of 1e5 px times distances of 1e4 mm, and a scale of 1000
_BRACKETS = re.compile(r"[\[{\]}]")
MAX_DEPTH = 8  # [ours] of nested brackets in JSON and elements in XML; files of views have 3


def read_bytes(path: Path, limit: int = MAX_TEXT_BYTES) -> bytes:
    """Return the content of a file of at most `limit` bytes."""
    return read_bounded(path, limit, UnusableInputError, "give the file of one view or plan")


def text(data: bytes) -> str:
    """Return the text of UTF-8 bytes."""
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError:
        raise UnusableInputError("this is not a text file; export it again as text in UTF-8") from None


def json_object(data: bytes, depth: int = MAX_DEPTH) -> dict[str, Any]:
    """Return a JSON object without repeated keys or NaN, nested no deeper than `depth`."""
    value = json_value(data, depth)
    if not isinstance(value, dict):
        raise UnusableInputError("the file must hold one JSON object, { ... }")
    return value


def json_value(data: bytes, depth: int = MAX_DEPTH) -> Any:
    """Return any JSON value, with the same restrictions."""
    written = text(data)
    level = 0
    for bracket in _BRACKETS.findall(written):  # deep nesting would exhaust the stack; brackets in strings count too
        level += 1 if bracket in "[{" else -1
        if level > depth:
            raise UnusableInputError("the JSON is nested too deeply to be a view or a plan")
    return strict_json(written, UnusableInputError, "export it again")


def entry(document: dict[str, Any], key: str) -> Any:
    """Return the value of a required key."""
    if key not in document:
        raise UnusableInputError(
            f"{key!r} is missing; the file has: {', '.join(map(repr, list(document)[:12])) or 'nothing'}"
        )
    return document[key]


def array(value: Any, shape: tuple[int, ...], what: str) -> np.ndarray:
    """Return finite numbers of a shape, none beyond MAX_NUMBER, so that arithmetic does not overflow."""
    try:
        numbers = np.array(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        numbers = None
    if numbers is None or numbers.shape != shape or not (np.abs(numbers) <= MAX_NUMBER).all():
        wanted = " x ".join(map(str, shape)) or "one"
        raise UnusableInputError(f"{what} must be {wanted} finite numbers; export it again")
    return numbers


def number(value: Any, what: str) -> float:
    """Return a finite number."""
    if isinstance(value, bool):
        raise UnusableInputError(f"{what} must be a number")
    return float(array(value, (), what))


def positive(value: Any, what: str) -> float:
    """Return a finite number above zero."""
    positive_number = number(value, what)
    if positive_number < 1 / MAX_NUMBER:
        raise UnusableInputError(f"{what} is {positive_number:g}; it must be above zero")
    return positive_number


def image_shape(height: Any, width: Any) -> tuple[int, int]:
    """Return height and width in pixels: integers from 1 to 65536."""
    sides = [number(side, "the image size") for side in (height, width)]
    if any(side != int(side) or not 1 <= side <= 2**16 for side in sides):
        raise UnusableInputError(
            f"check the image size of {sides[1]:g} x {sides[0]:g} pixels: each must be an integer from 1 to {2**16}"
        )
    return int(sides[0]), int(sides[1])


def rotation(value: Any, what: str = "the rotation") -> np.ndarray:
    """Return a proper rotation (3, 3), orthogonal to 1e-4 (0.06 mm at 600 mm) in the file, orthonormalised."""
    matrix = array(value, (3, 3), what)
    if np.abs(matrix @ matrix.T - np.eye(3)).max() > 1e-4:
        raise UnusableInputError(f"{what} is not a rotation: its rows are not orthonormal; export it again")
    if np.linalg.det(matrix) < 0:
        raise UnusableInputError(
            f"{what} contains a reflection; flip the image's columns and give the geometry of the flipped image"
        )
    left, _, right = np.linalg.svd(matrix)
    return left @ right


def extrinsic(value: Any) -> np.ndarray:
    """Return rotation and translation (3, 4) of a matrix (4, 4) from world to camera."""
    matrix = array(value, (4, 4), "the extrinsic matrix")
    return np.column_stack([rotation(matrix[:3, :3], "the extrinsic's rotation"), matrix[:3, 3]])


def pixel_size(value: Any, what: str) -> tuple[float, float] | None:
    """Return the size of a pixel along u and v, both above zero; None for None."""
    if value is None:
        return None
    u, v = (positive(side, what) for side in array(value, (2,), what))
    return u, v


def json_bytes(document: dict[str, Any] | list[dict[str, Any]]) -> bytes:
    """Return a document of plain types as JSON. Raises ValueError for a number that is not finite, which is a bug."""
    return json.dumps(document, indent=1, allow_nan=False).encode()
