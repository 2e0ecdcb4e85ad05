"""A pinhole: what all other programs mean by a view of an image without distortion."""

import re
from dataclasses import dataclass

import numpy as np
from scipy.linalg import rq

from sightline.calibration.matrix import MatrixView, view_from_matrix
from sightline.errors import UnusableInputError

# Focal lengths along u and v, in mm, that differ by less than this share are one [ours]: 0.001 mm at 1000 mm.
_ONE_FOCAL = 1e-6
_PIXELS = ("uint8", "uint16", "float32")  # numbers that other programs' images are of


@dataclass(frozen=True, eq=False)
class Pinhole:
    """(u w, v w, w) = `camera_matrix` (`rotation` X + `translation_mm`), X in CFCS, as OpenCV has it.

    Camera axes: x along u (to the right), y along v (down), z from the X-ray source to the detector; right-handed.
    `camera_matrix` (3, 3), px: upper triangular, last entry 1, positive diagonal; of a mirrored image (seen from the
    detector's side) the first entry is negative. `shape`: height and width in px.
    `pixel_mm`: size of a pixel along u and v on the detector; it fixes where the detector stands. None: not stated.
    `covariance` (12, 12) of the matrix's entries, row by row, at the scale of `matrix`; None: unknown.
    `note`: what its reader should know.
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
            raise UnusableInputError(f"a view is named by 1 to 32 letters, digits, _ or -, not {self.name[:40]!r}")

    @staticmethod
    def of_matrix(
        matrix: np.ndarray,
        name: str,
        shape: tuple[int, int] | None = None,
        pixel_mm: tuple[float, float] | None = None,
        covariance: np.ndarray | None = None,
    ) -> "Pinhole":
        """Taken apart from a matrix (3, 4) of either sign and any scale; `covariance` is at its scale.

        Raises UnusableInputError where it is no perspective projection.
        """
        p = view_from_matrix(matrix, covariance).matrix  # refuses what has no focal point
        if p[2, 3] == 0:
            raise UnusableInputError(
                "the origin of the matrix's world is its X-ray source; give the matrix of a world, such as CFCS, whose "
                "origin lies before the source"
            )
        scale = np.linalg.norm(p[2, :3]) * np.sign(p[2, 3])  # the CFCS origin lies before the source, not behind it
        p = p / scale
        camera, turn = rq(p[:, :3])
        signs = np.sign(np.diag(camera))
        camera, turn = camera * signs, turn * signs[:, None]
        if np.linalg.det(turn) < 0:
            camera[0, 0], turn[0] = -camera[0, 0], -turn[0]
        translation = np.linalg.solve(camera, p[:, 3])
        scaled = None if covariance is None else np.asarray(covariance, dtype=np.float64) / scale**2
        return Pinhole(name, camera, turn, translation, shape, pixel_mm, scaled)

    @property
    def mirrored(self) -> bool:
        """Whether the image is seen from the detector's side."""
        return bool(self.camera_matrix[0, 0] < 0)

    @property
    def matrix(self) -> np.ndarray:
        """(3, 4), scaled so that w is the depth from the source along z, mm."""
        return self.camera_matrix @ np.column_stack([self.rotation, self.translation_mm])

    @property
    def extrinsic(self) -> np.ndarray:
        """(4, 4): CFCS to camera."""
        out = np.eye(4)
        out[:3, :3], out[:3, 3] = self.rotation, self.translation_mm
        return out

    @property
    def focal_point_mm(self) -> np.ndarray:
        """(3,) the X-ray source, CFCS."""
        return -self.rotation.T @ self.translation_mm

    def view(self) -> MatrixView:
        """The view to plan on. Without a covariance every verdict on it is NO-GO."""
        return view_from_matrix(self.matrix, self.covariance, self.name)

    def stated_shape(self) -> tuple[int, int]:
        """`shape`. Raises UnusableInputError where it is not known."""
        if self.shape is None:
            raise UnusableInputError("the format needs the image's size; read the view from a format that states it")
        return self.shape

    def own_image(self, pixels: np.ndarray) -> np.ndarray:
        """(H, W) as it is. Raises UnusableInputError where its size or its kind of numbers is not a projection's."""
        if pixels.shape != self.stated_shape() or pixels.dtype.name not in _PIXELS:
            raise UnusableInputError(f"the image of view {self.name} does not belong to its geometry: {pixels.shape}")
        return pixels

    def detector_mm(self) -> tuple[float, float, float]:
        """Source-to-detector distance and pixel size along u and v.

        Raises UnusableInputError for a camera with a skew, with two focal lengths, or without a pixel size: formats of
        flat detectors cannot state them.
        """
        if self.pixel_mm is None:
            raise UnusableInputError(
                "the format needs the size of a pixel in mm; read the view from one that states it"
            )
        fx, skew, fy = abs(self.camera_matrix[0, 0]), self.camera_matrix[0, 1], self.camera_matrix[1, 1]
        along_u, along_v = fx * self.pixel_mm[0], fy * self.pixel_mm[1]
        if abs(along_u - along_v) > _ONE_FOCAL * along_u or abs(skew) > _ONE_FOCAL * fx:
            raise UnusableInputError(
                f"the format has one focal length and square axes; this camera has {along_u:.3f} and {along_v:.3f} mm "
                f"and a skew of {skew:.3g} px: resample its image first"
            )
        return float(along_u), *self.pixel_mm
