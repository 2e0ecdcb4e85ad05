"""The pinhole camera, the common model of a view in other programs: an image without distortion."""

import re
from dataclasses import dataclass

import numpy as np
from scipy.linalg import rq

from sightline.calibration.matrix_view import MatrixView, view_from_matrix
from sightline.errors import UnusableInputError

# Numbers that differ by a smaller share count as equal: files written with seven digits agree to that [ours].
MAX_DIFFERENCE = 1e-6
_PIXELS = ("uint8", "uint16", "float32")  # pixel types of other programs' images


@dataclass(frozen=True, eq=False)
class Pinhole:
    """(u w, v w, w) = `camera_matrix` (`rotation` X + `translation_mm`), X in CFCS, as in OpenCV.

    Camera axes: x along u (to the right), y along v (down), z from the X-ray source to the detector; right-handed.
    `camera_matrix` (3, 3), px: upper triangular, last entry 1, second diagonal entry positive. The first diagonal entry
    is positive, or negative for a mirrored image (seen from the detector's side). `shape`: height and width in px.
    `pixel_mm`: size of a pixel along u and v on the detector, which determines the detector's place; None: not stated.
    `covariance` (12, 12): of the matrix's entries, row by row, at the scale of `matrix`; None: unknown.
    `note`: a remark for the reader of the file.
    """

    name: str
    camera_matrix: np.ndarray
    rotation: np.ndarray
    translation_mm: np.ndarray
    shape: tuple[int, int] | None = None
    pixel_mm: tuple[float, float] | None = None
    covariance: np.ndarray | None = None
    note: str = ""

    def __post_init__(self) -> None:
        if not re.fullmatch(r"[\w-]{1,32}", self.name):  # it becomes the name of files
            raise UnusableInputError(f"name the view with 1 to 32 letters, digits, _ or -, not {self.name[:40]!r}")

    @staticmethod
    def of_matrix(
        matrix: np.ndarray,
        name: str,
        shape: tuple[int, int] | None = None,
        pixel_mm: tuple[float, float] | None = None,
        covariance: np.ndarray | None = None,
    ) -> "Pinhole":
        """Return the decomposition of a matrix (3, 4) of either sign and any scale; `covariance` is at its scale.

        Raises UnusableInputError where the matrix is not a perspective projection.
        """
        p = view_from_matrix(matrix, covariance).matrix  # refuses a matrix without a focal point
        if p[2, 3] == 0:
            raise UnusableInputError(
                "give the matrix for world coordinates, such as CFCS, whose origin lies in front of the X-ray source; "
                "the origin of this one is at the source's depth"
            )
        scale = np.linalg.norm(p[2, :3]) * np.sign(p[2, 3])  # the CFCS origin lies in front of the source
        p = p / scale
        camera, rotation = rq(p[:, :3])
        signs = np.sign(np.diag(camera))
        camera, rotation = camera * signs, rotation * signs[:, None]
        if np.linalg.det(rotation) < 0:
            camera[0, 0], rotation[0] = -camera[0, 0], -rotation[0]
        translation = np.linalg.solve(camera, p[:, 3])
        scaled = None if covariance is None else np.asarray(covariance, dtype=np.float64) / scale**2
        return Pinhole(name, camera, rotation, translation, shape, pixel_mm, scaled)

    @property
    def mirrored(self) -> bool:
        """Whether the image is seen from the detector's side."""
        return bool(self.camera_matrix[0, 0] < 0)

    @property
    def matrix(self) -> np.ndarray:
        """(3, 4) projection matrix, scaled so that w is the depth from the source along z, mm."""
        return self.camera_matrix @ np.column_stack([self.rotation, self.translation_mm])

    @property
    def extrinsic(self) -> np.ndarray:
        """(4, 4) matrix from CFCS to camera coordinates."""
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = self.rotation, self.translation_mm
        return matrix

    @property
    def focal_point_mm(self) -> np.ndarray:
        """(3,) the X-ray source, CFCS."""
        return -self.rotation.T @ self.translation_mm

    def view(self) -> MatrixView:
        """Return the view to plan on. Without a covariance every verdict on it is NO-GO."""
        return view_from_matrix(self.matrix, self.covariance, self.name)

    def stated_shape(self) -> tuple[int, int]:
        """Return `shape`. Raises UnusableInputError where it is unknown."""
        if self.shape is None:
            raise UnusableInputError("read the view from a format that states the image's size: this format needs it")
        return self.shape

    def own_image(self, pixels: np.ndarray) -> np.ndarray:
        """Return the image (H, W) unchanged. Raises UnusableInputError where its size or pixel type does not fit."""
        if pixels.shape != self.stated_shape() or pixels.dtype.name not in _PIXELS:
            raise UnusableInputError(
                f"the image of view {self.name} is {pixels.shape}, {pixels.dtype.name}; give {self.stated_shape()} of "
                f"{', '.join(_PIXELS)}"
            )
        return pixels

    def detector_mm(self) -> tuple[float, float, float]:
        """Return the source-detector distance and the pixel size along u and v, mm.

        Raises UnusableInputError for a camera with a skew, with two focal lengths, or without a pixel size, which
        formats of flat detectors cannot express.
        """
        if self.pixel_mm is None:
            raise UnusableInputError(
                "read the view from a format that states the size of a pixel in mm: this format needs it"
            )
        fx, skew, fy = abs(self.camera_matrix[0, 0]), self.camera_matrix[0, 1], self.camera_matrix[1, 1]
        along_u, along_v = fx * self.pixel_mm[0], fy * self.pixel_mm[1]
        if abs(along_u - along_v) > MAX_DIFFERENCE * along_u or abs(skew) > MAX_DIFFERENCE * fx:
            raise UnusableInputError(
                f"resample the image first: the format needs one focal length and no skew; this camera has "
                f"{along_u:.3f} and {along_v:.3f} mm and a skew of {skew:.3g} px"
            )
        return float(along_u), float(self.pixel_mm[0]), float(self.pixel_mm[1])  # formats write their digits by repr
