"""An undistorted image as a file."""

import io
from datetime import datetime

import cv2
import numpy as np

from sightline.calibration.exchange.pinhole import Pinhole
from sightline.errors import UnusableInputError


def encode(kind: str, name: str, pixels: np.ndarray, white: float, pinhole: Pinhole) -> dict[str, bytes]:
    """Return an image (H, W) as one file, by its name. `kind`: png, npy or dicom. Raises UnusableInputError."""
    if kind == "npy":
        out = io.BytesIO()
        np.save(out, pixels)
        return {f"{name}.npy": out.getvalue()}
    if kind not in ("png", "dicom"):
        raise UnusableInputError(f"{kind!r} is not an image format; choose png, npy or dicom")
    if pixels.dtype not in (np.uint8, np.uint16):
        raise UnusableInputError(f"the image has {pixels.dtype} pixels, which {kind} cannot hold; choose npy")
    if kind == "png":
        return {f"{name}.png": cv2.imencode(".png", pixels)[1].tobytes()}
    from sightline.case.interop.dicom import ExportIdentity, capture, file_bytes

    identity = ExportIdentity("undistorted", datetime.now().replace(microsecond=0))
    return {f"{name}.dcm": file_bytes(capture((pixels, white), pinhole, identity, f"{name}, undistorted", 1))}
