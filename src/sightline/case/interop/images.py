"""An undistorted image as a file."""

import io
from datetime import datetime

import cv2
import numpy as np

from sightline.calibration.exchange.pinhole import Pinhole
from sightline.errors import UnusableInputError


def encode(kind: str, name: str, pixels: np.ndarray, white: float, pinhole: Pinhole) -> dict[str, bytes]:
    """`kind` png, npy or dicom. Raises UnusableInputError."""
    if kind == "npy":
        out = io.BytesIO()
        np.save(out, pixels)
        return {f"{name}.npy": out.getvalue()}
    if kind not in ("png", "dicom"):
        raise UnusableInputError(f"{kind!r} is no format of an image; choose of png, npy, dicom")
    if pixels.dtype not in (np.uint8, np.uint16):
        raise UnusableInputError(f"the image has {pixels.dtype} pixels, which {kind} does not hold; choose npy")
    if kind == "png":
        return {f"{name}.png": cv2.imencode(".png", pixels)[1].tobytes()}
    from sightline.case.interop.dicom_capture import capture
    from sightline.case.interop.dicom_parts import Filed, file_bytes

    filed = Filed("undistorted", datetime.now().replace(microsecond=0))
    return {f"{name}.dcm": file_bytes(capture((pixels, white), pinhole, filed, f"{name}, undistorted", 1))}
