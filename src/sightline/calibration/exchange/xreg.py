"""xReg's projection data, HDF5: `num-projs`, and in each `proj-000` a group `cam` (camera, sizes) and a group `img`.

The writer writes one projection in `origin-at-focal-pt-det-pos-z`, which is OpenCV's; the reader accepts all three of
xReg's coordinate frames, and a file of a camera alone. See lib/file_formats/xregH5ProjDataIO.cpp, xregH5CamModelIO.cpp.
"""

import io
from collections.abc import Generator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import numpy as np

from sightline.calibration.exchange import reading
from sightline.calibration.exchange.pinhole import Pinhole
from sightline.errors import UnusableInputError

if TYPE_CHECKING:
    import h5py

_WRITTEN = "origin-at-focal-pt-det-pos-z"
_FRAMES = (_WRITTEN, "origin-at-focal-pt-det-neg-z", "origin-on-det")
_MAX_PROJECTIONS = 1000  # their names have three digits
_STATED = (
    "num-projs",
    "num-rows",
    "num-cols",
    "row-spacing",
    "col-spacing",
    "cam-coord-frame-type",
    "intrinsic",
    "extrinsic",
)
_MAX_ENTRIES, _MAX_BYTES = 16, 64  # of a dataset that is read: a matrix, with each number or word of this size


def write(pinhole: Pinhole, pixels: np.ndarray | None = None) -> dict[str, bytes]:
    """Return the file of one projection by its name, with its image (H, W) where there is one.

    Raises UnusableInputError where pixel size or image size are unknown.
    """
    _, across, down = pinhole.detector_mm()
    height, width = pinhole.stated_shape()
    buffer = io.BytesIO()
    with _library().File(buffer, "w") as file:
        file.attrs["xreg-type"] = np.bytes_("proj-data")
        file["num-projs"] = np.uint64(1)
        camera = file.create_group("proj-000/cam")
        stated = {"xreg-type": "cam-model", "coordinates": "CFCS", "units": "mm", "note": pinhole.note}
        camera.attrs.update({key: np.bytes_(text.encode()) for key, text in stated.items() if text})
        camera["num-rows"], camera["num-cols"] = np.uint64(height), np.uint64(width)
        camera["row-spacing"], camera["col-spacing"] = down, across
        camera["cam-coord-frame-type"] = np.bytes_(_WRITTEN)
        camera["intrinsic"], camera["extrinsic"] = pinhole.camera_matrix, pinhole.extrinsic
        if pixels is not None:
            image = file.create_group("proj-000/img")
            image.attrs["xreg-type"] = np.bytes_("image-2D")
            image["dir-mat"], image["origin"] = np.eye(2), np.zeros((2, 1))
            image["spacing"], image["pixels"] = np.array([[across], [down]]), pinhole.own_image(pixels)
    return {f"{pinhole.name}.xreg.h5": buffer.getvalue()}


def read(data: bytes, name: str) -> Pinhole:
    """Return the only projection of a file, or of several the one called `name` ("proj-001").

    Raises UnusableInputError.
    """
    with _opened(data) as file:
        given = _camera(file, name)
    frame = reading.entry(given, "cam-coord-frame-type")
    if frame not in _FRAMES:
        raise UnusableInputError(f"cam-coord-frame-type is {str(frame)[:40]!r}; write one of {', '.join(_FRAMES)}")
    shape = reading.image_shape(reading.entry(given, "num-rows"), reading.entry(given, "num-cols"))
    across, down = (reading.positive(reading.entry(given, key), key) for key in ("col-spacing", "row-spacing"))
    camera = reading.array(reading.entry(given, "intrinsic"), (3, 3), "the intrinsic matrix")
    placed = reading.extrinsic(reading.entry(given, "extrinsic"))
    if frame == "origin-on-det":  # z runs from the detector to the source, which is at z = focal length
        focal = 0.5 * (abs(camera[0, 0] * across) + abs(camera[1, 1] * down))
        placed = np.diag([1.0, 1.0, -1.0]) @ placed + np.array([[0, 0, 0, 0], [0, 0, 0, 0], [0, 0, 0, focal]])
    return Pinhole.of_matrix(camera @ placed, name, shape, (across, down))


def _library() -> Any:
    try:
        import h5py
    except ModuleNotFoundError:
        raise UnusableInputError("install sightline[xreg]: xReg's files are HDF5, which needs h5py") from None
    return h5py


@contextmanager
def _opened(data: bytes) -> "Generator[h5py.File]":
    """Open a file from its bytes; any error of the library about a damaged file becomes one UnusableInputError."""
    library = _library()
    try:
        with library.File(io.BytesIO(data), "r") as file:
            yield file
    except UnusableInputError:
        raise
    except Exception as error:
        raise UnusableInputError(f"the file is not readable HDF5 ({type(error).__name__}); write it again") from None


def _camera(file: "h5py.File", name: str) -> dict[str, Any]:
    """Return the camera of a projection, by xReg's names: small numbers and one word."""
    if _has(file, "num-rows"):
        return _values(file)
    count = reading.number(_values(file).get("num-projs", 0), "num-projs")
    names = [
        name_in_file
        for name_in_file in (f"proj-{k:03d}" for k in range(min(int(count), _MAX_PROJECTIONS)))
        if _has(file, name_in_file)
    ]
    if name not in names and (len(names) != 1 or name.startswith("proj-")):
        known = ", ".join(names[:3]) or "none"
        raise UnusableInputError(f"the file has no projection {name!r}; its {len(names)} projections are: {known}")
    projection: Any = file[name if name in names else names[0]]
    if not _has(projection, "cam"):
        raise UnusableInputError("write the file with xReg again: the projection has no group 'cam'")
    return _values(projection["cam"])


def _has(group: Any, name: str) -> bool:
    """Whether the file itself has something of this name: a soft or external link could lead to any other file."""
    library = _library()
    if not isinstance(group, library.Group):
        raise UnusableInputError("write the file with xReg again: it has numbers where a group was expected")
    return isinstance(group.get(name, getlink=True), library.HardLink)


def _values(group: "h5py.Group") -> dict[str, Any]:
    """Return the values of the group: small datasets of a known type, stored uncompressed in the file itself."""
    values: dict[str, Any] = {}
    for key in (key for key in _STATED if _has(group, key)):
        held: Any = group[key]
        if not isinstance(held, _library().Dataset) or held.size is None:
            continue
        here = held.chunks is None and held.external is None and not held.is_virtual
        small = held.size <= _MAX_ENTRIES and held.dtype.itemsize <= _MAX_BYTES
        if here and small and held.dtype.kind in "iufSO":
            value = held[()]
            values[key] = value.decode("ascii", "replace") if isinstance(value, bytes) else value
    return values
