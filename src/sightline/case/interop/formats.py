"""The formats of a view, by name."""

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np

from sightline.case.interop import deepdrr, diffdrr, mayacam2, opencv, reading, rtk, xreg
from sightline.case.interop.pinhole import Pinhole
from sightline.errors import UnusableInputError

Write = Callable[[Pinhole], dict[str, bytes]]
Read = Callable[[bytes, str], Pinhole]
_PLAIN: dict[str, tuple[Write, Read]] = {
    "opencv": (opencv.write, opencv.read),
    "mayacam2": (mayacam2.write, mayacam2.read),
    "diffdrr": (diffdrr.write, diffdrr.read),
    "deepdrr": (deepdrr.write, deepdrr.read),
}
FORMATS = (*_PLAIN, "rtk", "xreg")


def write_view(pinhole: Pinhole, kind: str, pixels: np.ndarray | None = None) -> dict[str, bytes]:
    """Files of one view by name; RTK's and xReg's hold the image too. Raises UnusableInputError."""
    if known(kind) == "rtk":
        return rtk.write(pinhole, pixels)
    if kind == "xreg":
        return xreg.write(pinhole, pixels)
    return _PLAIN[kind][0](pinhole)


def read_view(path: str | Path, kind: str | None = None, name: str | None = None) -> Pinhole:
    """A view from a file of another program; without `kind`, the file's name tells (`pa.xreg.h5`).

    `name`: of the view, "pa" or "lateral", or of one of several in a file of xReg's, "proj-001"; by default the first
    word of the file's name. Raises UnusableInputError.
    """
    file = Path(path)
    words = file.name.lower().split(".")
    kind = known(kind or next((word for word in words[1:] if word in FORMATS), "opencv"))
    view = name or re.sub(r"[^\w-]", "_", words[0])[:32]
    data = reading.read_bytes(file, xreg.MAX_BYTES if kind == "xreg" else reading.MAX_BYTES)
    try:
        if kind == "xreg":
            return xreg.read(data, view)
        if kind == "rtk":
            image = file.with_suffix(".mha")
            return rtk.read(data, view, _head(image) if image.is_file() else None)
        return _PLAIN[kind][1](data, view)
    except UnusableInputError as error:
        raise UnusableInputError(f"{file.name} ({kind}): {error}") from None


def _head(image: Path) -> bytes:
    with image.open("rb") as stream:
        return stream.read(4096)


def known(kind: str) -> str:
    """The name of a format. Raises UnusableInputError."""
    if kind not in FORMATS:
        raise UnusableInputError(f"{kind!r} is no format of a view; choose of {', '.join(FORMATS)}")
    return kind
