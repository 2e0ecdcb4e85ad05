"""An image with its position in space as NRRD, which 3D Slicer and ITK read: LPS, mm."""

import gzip

import numpy as np

from sightline.calibration.exchange.pinhole import Pinhole

_TYPES = {"uint8": "unsigned char", "uint16": "unsigned short", "float32": "float"}


def plate_corner(pinhole: Pinhole) -> tuple[np.ndarray, np.ndarray]:
    """Return the centre (3,) of the plate image's first pixel, CFCS mm, and the steps (3, 3) to the next column, to the
    next row, and of 1 mm along the beam."""
    distance, across, down = pinhole.detector_mm()
    cu, cv = pinhole.camera_matrix[:2, 2]
    corner = pinhole.focal_point_mm + pinhole.rotation.T @ [-cu * across, -cv * down, distance]
    return corner, np.diag([across, down, 1.0]) @ pinhole.rotation


def nrrd_bytes(pixels: np.ndarray, pinhole: Pinhole, T_lps_cfcs: np.ndarray, statement: str) -> bytes:
    """Return an undistorted image (H, W) at the position of its plate, one voxel thick. Raises UnusableInputError."""
    corner, steps = plate_corner(pinhole)
    rotation = T_lps_cfcs[:3, :3]
    height, width = pinhole.own_image(pixels).shape
    lines = (
        "NRRD0005",
        f"type: {_TYPES[pixels.dtype.name]}",
        "dimension: 3",
        "space: left-posterior-superior",
        f"sizes: {width} {height} 1",
        "space directions: " + " ".join(_vector(rotation @ step) for step in steps),
        "kinds: domain domain domain",
        "endian: little",
        "encoding: gzip",
        f"space origin: {_vector(rotation @ corner + T_lps_cfcs[:3, 3])}",
        f"sightline:={statement}",
    )
    raw = pixels.astype(pixels.dtype.newbyteorder("<"), copy=False).tobytes()
    return ("\n".join(lines) + "\n\n").encode("ascii", "replace") + gzip.compress(raw, mtime=0)


def _vector(xyz: np.ndarray) -> str:
    return "(" + ",".join(repr(float(x) + 0.0) for x in xyz) + ")"
