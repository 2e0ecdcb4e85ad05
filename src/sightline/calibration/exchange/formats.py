"""The formats of a view, by name."""

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np

from sightline.bounded import regular_file
from sightline.calibration.exchange import deepdrr, diffdrr, mayacam2, opencv, reading, rtk, xreg
from sightline.calibration.exchange.pinhole import Pinhole
from sightline.errors import UnusableInputError

_WRITE: dict[str, Callable[[Pinhole], dict[str, bytes]]] = {
    "opencv": opencv.write,
    "mayacam2": mayacam2.write,
    "diffdrr": diffdrr.write,
    "deepdrr": deepdrr.write,
}
_WRITE_WITH_IMAGE = {"rtk": rtk.write, "xreg": xreg.write}
_READ: dict[str, Callable[[bytes, str], Pinhole]] = {  # RTK's takes the head of its image too
    "opencv": opencv.read,
    "mayacam2": mayacam2.read,
    "diffdrr": diffdrr.read,
    "deepdrr": deepdrr.read,
    "xreg": xreg.read,
}
_MAX_BYTES = {"xreg": xreg.MAX_BYTES}  # its images are in the same file
FORMATS = (*_WRITE, *_WRITE_WITH_IMAGE)


def write_view(pinhole: Pinhole, kind: str, pixels: np.ndarray | None = None) -> dict[str, bytes]:
    """Files of one view by name; RTK's and xReg's hold the image too. Raises UnusableInputError."""
    if known(kind) in _WRITE_WITH_IMAGE:
        return _WRITE_WITH_IMAGE[kind](pinhole, pixels)
    return _WRITE[kind](pinhole)


def read_view(path: str | Path, kind: str | None = None, name: str | None = None) -> Pinhole:
    """A view from a file of another program; without `kind`, the file's name tells (`pa.xreg.h5`).

    `name`: of the view, "pa" or "lateral", or of one of several in a file of xReg's, "proj-001"; by default the first
    word of the file's name. Raises UnusableInputError.
    """
    file = Path(path)
    words = file.name.lower().split(".")
    kind = known(kind or next((word for word in words[1:] if word in FORMATS), "opencv"))
    view = name or re.sub(r"[^\w-]", "_", words[0])[:32]
    data = reading.read_bytes(file, _MAX_BYTES.get(kind, reading.MAX_BYTES))
    try:
        if kind == "rtk":
            image = file.with_suffix(".mha")
            return rtk.read(data, view, _head(image) if image.is_file() else None)
        return _READ[kind](data, view)
    except UnusableInputError as error:
        raise UnusableInputError(f"{file.name} ({kind}): {error}") from None


def _head(image: Path) -> bytes:
    with regular_file(image) as stream:
        return stream.read(4096)


def known(kind: str) -> str:
    """The name of a format. Raises UnusableInputError."""
    if kind not in FORMATS:
        raise UnusableInputError(f"{kind!r} is no format of a view; choose of {', '.join(FORMATS)}")
    return kind
