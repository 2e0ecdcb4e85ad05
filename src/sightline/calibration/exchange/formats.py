"""Reading and writing a view in a format given by name."""

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np

from sightline.calibration.exchange import drr, opencv, reading, rtk, xreg
from sightline.calibration.exchange.pinhole import Pinhole
from sightline.common.bounded import MAX_FILE_BYTES, MAX_TEXT_BYTES, regular_file
from sightline.errors import UnusableInputError

_WRITE: dict[str, Callable[[Pinhole], dict[str, bytes]]] = {
    "opencv": opencv.write,
    "mayacam2": opencv.write_mayacam2,
    "diffdrr": drr.write_diffdrr,
    "deepdrr": drr.write_deepdrr,
}
_WRITE_WITH_IMAGE = {"rtk": rtk.write, "xreg": xreg.write}
_READ: dict[str, Callable[[bytes, str], Pinhole]] = {  # RTK's reader needs its image's header too
    "opencv": opencv.read,
    "mayacam2": opencv.read_mayacam2,
    "diffdrr": drr.read_diffdrr,
    "deepdrr": drr.read_deepdrr,
    "xreg": xreg.read,
    "vtkcam": opencv.read_vtkcam,
}
_MAX_BYTES = {"xreg": MAX_FILE_BYTES}  # its file contains the images
FORMATS = (*_WRITE, *_WRITE_WITH_IMAGE)
_READABLE = (*FORMATS, "vtkcam")  # it cannot state a principal point, so our views cannot be written in it
ALIASES = {"autoscoper": "mayacam2", "xmalab": "mayacam2"}  # programs that read and write that format


def write_view(pinhole: Pinhole, kind: str, pixels: np.ndarray | None = None) -> dict[str, bytes]:
    """Return the files of one view by their names. Raises UnusableInputError.

    `pixels` (H, W): the image, which only RTK's and xReg's files hold. Without it RTK's image is all zeros, and xReg's
    file holds none.
    """
    kind = check_format(kind)
    if kind in _WRITE_WITH_IMAGE:
        return _WRITE_WITH_IMAGE[kind](pinhole, pixels)
    return _WRITE[kind](pinhole)


def read_view(path: str | Path, kind: str | None = None, name: str | None = None) -> Pinhole:
    """Return a view from a file of another program.

    `kind`: the format; by default from the file's name (`pa.xreg.h5`), else "mayacam2" or "opencv" by its content.
    `name`: of the view, "pa" or "lateral", or of one of several projections in a file of xReg or RTK, "proj-001"; by
    default the first word of the file's name. Raises UnusableInputError.

    >>> sl.read_view("pa.opencv.json").view().name
    'pa'
    """
    file = Path(path)
    words = file.name.lower().split(".")
    stated = kind or next((word for word in words[1:] if word in (*_READABLE, *ALIASES)), "")
    kind = check_format(stated or "opencv", _READABLE)
    view = name or re.sub(r"[^\w-]", "_", words[0])[:32]
    data = reading.read_bytes(file, _MAX_BYTES.get(kind, MAX_TEXT_BYTES))
    if not stated and data.startswith(b"image size"):  # XMALab gives its files any name
        kind = "mayacam2"
    try:
        if kind == "rtk":
            image = file.with_suffix(".mha")
            return rtk.read(data, view, _head(image) if image.is_file() else None)
        return _READ[kind](data, view)
    except UnusableInputError as error:
        raise UnusableInputError(f"{file.name} ({kind}): {error}") from None


def read_projections(path: str | Path) -> list[tuple[Pinhole, np.ndarray]]:
    """Return the views of RTK's geometry, "proj-000" first, and their images (H, W), top row first.

    The images are in the `.mha` beside it. Raises UnusableInputError.
    """
    file = Path(path)
    image = reading.read_bytes(file.with_suffix(".mha"), MAX_FILE_BYTES)
    try:
        return rtk.read_stack(reading.read_bytes(file), image)
    except UnusableInputError as error:
        raise UnusableInputError(f"{file.name} (rtk): {error}") from None


def _head(image: Path) -> bytes:
    with regular_file(image) as stream:
        return stream.read(4096)


def check_format(kind: str, formats: tuple[str, ...] = FORMATS) -> str:
    """Return the name of a format, given by itself or by a program's. Raises UnusableInputError for an unknown one."""
    if (name := ALIASES.get(kind, kind)) not in formats:
        known = ", ".join((*formats, *ALIASES))
        raise UnusableInputError(f"unknown format of a view {kind!r}; choose one of {known}")
    return name
