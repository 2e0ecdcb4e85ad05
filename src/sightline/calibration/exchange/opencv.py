"""Projection matrices by OpenCV's convention: JSON (ours, or any with "matrix"), CSV of 3 x 4 numbers, or `.npy`.

Also MayaCam 2 text of XMALab and Autoscoper: image size, and OpenCV's camera matrix, rotation and translation; and,
read only, the VTK camera of AutoscoperM.
"""

import io
from typing import Any

import numpy as np

from sightline.calibration.exchange import reading
from sightline.calibration.exchange.pinhole import MAX_DIFFERENCE, Pinhole
from sightline.calibration.exchange.reading import json_bytes
from sightline.common.bounded import npy_array
from sightline.common.geometry.lines import unit
from sightline.errors import UnusableInputError

CONVENTION = (
    "(u w, v w, w) = camera_matrix (rotation X + translation_mm), X in CFCS mm; pixel (0, 0) is the centre of the "
    "top-left pixel, u to the right, v down; z from the X-ray source to the detector; no distortion"
)


def document(pinhole: Pinhole) -> dict[str, Any]:
    """Return a pinhole as JSON types."""
    return {
        "view": pinhole.name,
        "coordinates": "CFCS",
        "units": "mm",
        "note": pinhole.note,
        "convention": CONVENTION,
        "matrix": pinhole.matrix.tolist(),
        "camera_matrix": pinhole.camera_matrix.tolist(),
        "rotation": pinhole.rotation.tolist(),
        "translation_mm": pinhole.translation_mm.tolist(),
        "image_size": None if pinhole.shape is None else [pinhole.shape[1], pinhole.shape[0]],
        "mirrored": pinhole.mirrored,
        "pixel_mm": None if pinhole.pixel_mm is None else list(pinhole.pixel_mm),
        "covariance_of_matrix": None if pinhole.covariance is None else pinhole.covariance.tolist(),
    }


def of_document(given: dict[str, Any], name: str) -> Pinhole:
    """Return the pinhole of JSON types: "matrix", or "camera_matrix", "rotation" and "translation_mm".

    Raises UnusableInputError; also where lens distortion is stated, or the matrix and its parts disagree.
    """
    if np.any(given.get("distortion") or 0):
        raise UnusableInputError(
            "undistort the image and give the matrix of the result: the file states a lens distortion"
        )
    matrix = reading.array(given["matrix"], (3, 4), "the matrix") if "matrix" in given else _of_parts(given)
    if "matrix" in given and "camera_matrix" in given:
        _refuse_two(matrix, _of_parts(given))
    size, pixel, covariance = (given.get(key) for key in ("image_size", "pixel_mm", "covariance_of_matrix"))
    shape = None if size is None else reading.image_shape(*reading.array(size, (2,), "the image size")[::-1])
    if covariance is not None:
        covariance = reading.array(covariance, (12, 12), "the covariance of the matrix")
    return Pinhole.of_matrix(
        matrix, str(given.get("view", name)), shape, reading.pixel_size(pixel, "the pixel size"), covariance
    )


def _of_parts(given: dict[str, Any]) -> np.ndarray:
    rotation = reading.rotation(reading.entry(given, "rotation"))
    translation = reading.array(reading.entry(given, "translation_mm"), (3,), "the translation")
    camera = reading.array(reading.entry(given, "camera_matrix"), (3, 3), "the camera matrix")
    return camera @ np.column_stack([rotation, translation])


def _refuse_two(whole: np.ndarray, parts: np.ndarray) -> None:
    """Raise UnusableInputError where a matrix and its parts differ by more than scale."""
    first, second = whole / np.linalg.norm(whole), parts / np.linalg.norm(parts)
    if min(np.abs(first - second).max(), np.abs(first + second).max()) > MAX_DIFFERENCE:
        raise UnusableInputError(
            "export the file again: its matrix disagrees with its camera matrix, rotation and translation"
        )


def write(pinhole: Pinhole) -> dict[str, bytes]:
    """Return the files of a view by their names: JSON with everything, the matrix alone as CSV and .npy."""
    rows = "".join(",".join(repr(float(x)) for x in row) + "\n" for row in pinhole.matrix)
    binary = io.BytesIO()
    np.save(binary, pinhole.matrix)
    stem = f"{pinhole.name}.opencv"
    return {
        f"{stem}.json": json_bytes(document(pinhole)),
        f"{stem}.csv": rows.encode(),
        f"{stem}.npy": binary.getvalue(),
    }


def read(data: bytes, name: str) -> Pinhole:
    """Return the view in any of the three files; the first bytes show which. Raises UnusableInputError."""
    if data.startswith(b"\x93NUMPY"):
        return Pinhole.of_matrix(_npy(data), name)
    if data.lstrip()[:1] in (b"{", b"["):
        value = reading.json_value(data)
        return of_document(value if isinstance(value, dict) else {"matrix": value}, name)
    lines = [line.replace(",", " ").split() for line in reading.text(data).splitlines() if line.strip()]
    return Pinhole.of_matrix(reading.array(lines, (3, 4), "the matrix"), name)


def _npy(data: bytes) -> np.ndarray:
    """Return the matrix (3, 4) of a NumPy file. Raises UnusableInputError."""

    def refuse_other(shape: tuple[int, ...], dtype: np.dtype) -> None:
        if shape != (3, 4) or dtype.kind not in "fiu":
            raise ValueError("another array")

    try:
        matrix = npy_array(data, refuse_other)
    except ValueError:
        raise UnusableInputError("save the matrix again: this is not a complete NumPy file of 3 x 4 numbers") from None
    return reading.array(matrix, (3, 4), "the matrix")


_HEADINGS = (("image size", 1, 2), ("camera matrix", 3, 3), ("rotation", 3, 3), ("translation", 3, 1))


def write_mayacam2(pinhole: Pinhole) -> dict[str, bytes]:
    """Return the file of a view by its name, width before height as the two programs read it.

    Raises UnusableInputError where the image's size is unknown.
    """
    height, width = pinhole.stated_shape()
    blocks = (np.array([[width, height]]), pinhole.camera_matrix, pinhole.rotation, pinhole.translation_mm[:, None])
    parts = [
        f"{heading}\n" + "".join(",".join(_number(x) for x in row) + "\n" for row in block)
        for (heading, _, _), block in zip(_HEADINGS, blocks, strict=True)
    ]
    return {f"{pinhole.name}.mayacam2.txt": "\n".join(parts).encode()}


def _number(value: float) -> str:
    return str(int(value)) if value == int(value) else repr(float(value))


def read_mayacam2(data: bytes, name: str) -> Pinhole:
    """Return the view in a file. Raises UnusableInputError."""
    lines = [line.strip() for line in reading.text(data).splitlines() if line.strip()]
    wanted = sum(1 + rows for _, rows, _ in _HEADINGS)
    if len(lines) != wanted:
        raise UnusableInputError(f"a MayaCam 2 file has {wanted} lines of text; this one has {len(lines)}")
    at, blocks = 0, []
    for heading, rows, columns in _HEADINGS:
        if lines[at].lower() != heading:
            raise UnusableInputError(f"found {lines[at][:40]!r} where the heading {heading!r} was expected")
        block = [line.split(",") for line in lines[at + 1 : at + 1 + rows]]
        blocks.append(reading.array(block, (rows, columns), f"the numbers under {heading!r}"))
        at += 1 + rows
    (size,), camera, rotation, translation = blocks
    matrix = camera @ np.column_stack([reading.rotation(rotation), translation])
    return Pinhole.of_matrix(matrix, name, reading.image_shape(size[1], size[0]))


def read_vtkcam(data: bytes, name: str) -> Pinhole:
    """Return the view in a VTKCam 1.0 file (JSON), as AutoscoperM writes it; world coordinates are the file's.

    The beam through the image's middle runs from `camera-position` to `focal-point`; `view-angle` spans the image,
    degrees. Raises UnusableInputError; also for an image that is not square, which Autoscoper stretches and VTK does
    not.
    """
    given = reading.json_object(data)
    if reading.number(reading.entry(given, "version"), "the version") != 1.0:
        raise UnusableInputError("this is another version of VTKCam than 1.0; export MayaCam 2 instead")
    position, target, up = (
        reading.array(reading.entry(given, key), (3,), key) for key in ("camera-position", "focal-point", "view-up")
    )
    height, width = reading.image_shape(reading.entry(given, "image-height"), reading.entry(given, "image-width"))
    if height != width:
        raise UnusableInputError(
            f"the image has {width} x {height} pixels, and Autoscoper and VTK read the view angle of an image that is "
            "not square differently; export MayaCam 2 instead"
        )
    angle = np.deg2rad(reading.positive(reading.entry(given, "view-angle"), "view-angle"))
    side = np.cross(target - position, up)
    if angle >= np.pi or np.linalg.norm(side) <= MAX_DIFFERENCE * np.linalg.norm(target - position) * np.linalg.norm(
        up
    ):
        raise UnusableInputError("view-angle must be below 180 degrees, and view-up must not lie along the beam")
    beam, across = unit(target - position), unit(side)
    rotation = np.stack([across, np.cross(beam, across), beam])
    focal, middle = 0.5 * width / np.tan(0.5 * angle), 0.5 * (width - 1)
    camera = np.array([[focal, 0.0, middle], [0.0, focal, middle], [0.0, 0.0, 1.0]])
    return Pinhole.of_matrix(camera @ np.column_stack([rotation, -rotation @ position]), name, (height, width))
