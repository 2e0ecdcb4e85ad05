"""DeepDRR's `CameraProjection(intrinsic, extrinsic)`: index from camera, camera from world.

Index (0, 0) is the corner of its pixel (0, 0), not its centre: the principal point of a centred sensor is width / 2.
"""

import numpy as np

from sightline.calibration.exchange import reading
from sightline.calibration.exchange.pinhole import Pinhole
from sightline.calibration.exchange.reading import json_bytes

_HALF = np.array([[1.0, 0.0, 0.5], [0.0, 1.0, 0.5], [0.0, 0.0, 1.0]])


def write(pinhole: Pinhole) -> dict[str, bytes]:
    """Return the file of a view by its name. Raises UnusableInputError where the image's size is unknown."""
    height, width = pinhole.stated_shape()
    stated = {
        "view": pinhole.name,
        "coordinates": "CFCS",
        "units": "mm",
        "note": pinhole.note,
        "use": "geo.CameraProjection(intrinsic, extrinsic); set intrinsic.sensor_width and sensor_height too",
        "intrinsic": (_HALF @ pinhole.camera_matrix).tolist(),
        "extrinsic": pinhole.extrinsic.tolist(),
        "sensor_width": width,
        "sensor_height": height,
        "pixel_size": None if pinhole.pixel_mm is None else list(pinhole.pixel_mm),
    }
    return {f"{pinhole.name}.deepdrr.json": json_bytes(stated)}


def read(data: bytes, name: str) -> Pinhole:
    """Return the view in a file. Raises UnusableInputError."""
    given = reading.json_object(data)
    camera = np.linalg.inv(_HALF) @ reading.array(reading.entry(given, "intrinsic"), (3, 3), "the intrinsic matrix")
    extrinsic = reading.array(reading.entry(given, "extrinsic"), (4, 4), "the extrinsic matrix")
    rotation = reading.rotation(extrinsic[:3, :3], "the extrinsic's rotation")
    shape = reading.image_shape(reading.entry(given, "sensor_height"), reading.entry(given, "sensor_width"))
    size, pixel = given.get("pixel_size"), None
    if size is not None:
        u, v = (reading.positive(side, "pixel_size") for side in reading.array(size, (2,), "pixel_size"))
        pixel = (u, v)
    return Pinhole.of_matrix(camera @ np.column_stack([rotation, extrinsic[:3, 3]]), name, shape, pixel)
