"""xReg's camera model, under the names that its HDF5 files have: `num-rows`, `row-spacing`, `intrinsic`, `extrinsic`.

All three of its coordinate frames are read; written is `origin-at-focal-pt-det-pos-z`, which is OpenCV's.
"""

import numpy as np

from sightline.case.interop import reading
from sightline.case.interop.pinhole import Pinhole
from sightline.case.interop.writing import json_bytes
from sightline.errors import UnusableInputError

_WRITTEN = "origin-at-focal-pt-det-pos-z"
_FRAMES = (_WRITTEN, "origin-at-focal-pt-det-neg-z", "origin-on-det")


def write(pinhole: Pinhole) -> dict[str, bytes]:
    """Raises UnusableInputError where pixel size or image size are unknown."""
    _, across, down = pinhole.detector_mm()
    height, width = pinhole.stated_shape()
    stated = {
        "xreg-type": "cam-model",
        "view": pinhole.name,
        "coordinates": "CFCS",
        "units": "mm",
        "note": pinhole.note,
        "num-rows": height,
        "num-cols": width,
        "row-spacing": down,
        "col-spacing": across,
        "cam-coord-frame-type": _WRITTEN,
        "intrinsic": pinhole.camera_matrix.tolist(),
        "extrinsic": pinhole.extrinsic.tolist(),
    }
    return {f"{pinhole.name}.xreg.json": json_bytes(stated)}


def read(data: bytes, name: str) -> Pinhole:
    """Raises UnusableInputError."""
    given = reading.json_object(data)
    frame = reading.entry(given, "cam-coord-frame-type")
    if frame not in _FRAMES:
        raise UnusableInputError(f"cam-coord-frame-type is {str(frame)[:40]!r}; one of {', '.join(_FRAMES)}")
    shape = reading.image_shape(reading.entry(given, "num-rows"), reading.entry(given, "num-cols"))
    across, down = (reading.positive(reading.entry(given, key), key) for key in ("col-spacing", "row-spacing"))
    camera = reading.array(reading.entry(given, "intrinsic"), (3, 3), "the intrinsic matrix")
    extrinsic = reading.array(reading.entry(given, "extrinsic"), (4, 4), "the extrinsic matrix")
    placed = np.column_stack([reading.rotation(extrinsic[:3, :3], "the extrinsic's rotation"), extrinsic[:3, 3]])
    if frame == "origin-on-det":  # its z runs from the detector to the source, at z = focal length
        focal = 0.5 * (abs(camera[0, 0] * across) + abs(camera[1, 1] * down))
        placed = np.diag([1.0, 1.0, -1.0]) @ placed + np.array([[0, 0, 0, 0], [0, 0, 0, 0], [0, 0, 0, focal]])
    return Pinhole.of_matrix(camera @ placed, name, shape, (across, down))
