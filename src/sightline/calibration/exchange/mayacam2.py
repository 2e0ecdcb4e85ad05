"""MayaCam 2 text of XMALab and Autoscoper: image size, and OpenCV's camera matrix, rotation and translation."""

import numpy as np

from sightline.calibration.exchange import reading
from sightline.calibration.exchange.pinhole import Pinhole
from sightline.errors import UnusableInputError

_HEADINGS = (("image size", 1, 2), ("camera matrix", 3, 3), ("rotation", 3, 3), ("translation", 3, 1))


def write(pinhole: Pinhole) -> dict[str, bytes]:
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


def read(data: bytes, name: str) -> Pinhole:
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
