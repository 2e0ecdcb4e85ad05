"""The pose of a bone, its error, and what speaks for it."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from scipy.spatial.transform import RigidTransform

from sightline.common.checks import Check, failed
from sightline.common.geometry.covariance import length_quantile
from sightline.common.geometry.rigid import displacement
from sightline.common.show import Plotted, checks_lines, numbers
from sightline.errors import ErrorUnknownError
from sightline.from_images.registration import pictures
from sightline.from_images.registration.bone import ScannedBone
from sightline.from_images.registration.movement import Apart
from sightline.from_images.registration.observed import BoneShot


@dataclass(frozen=True, eq=False, repr=False)
class BonePose(Plotted):
    """The pose of a bone, which takes its CT's or mesh's coordinates, mm, to CFCS. Look at `checks` before you use it.

    `covariance` (6, 6): of a rotation vector about `centre_mm` (3,), CFCS, rad, and a shift, mm, both CFCS; None where
    a view's error is unknown. `apart`: the views' own poses. `loss`: mean of the differences of shadows and images, 0
    to 1; it compares poses of one bone in the same images, and nothing else.

    >>> import inspect
    >>> list(inspect.signature(sl.BonePose.covariance_at).parameters)
    ['self', 'xyz_mm']
    """

    pose: RigidTransform
    centre_mm: np.ndarray
    covariance: np.ndarray | None
    apart: Apart
    checks: tuple[Check, ...]
    bone: ScannedBone
    shots: Sequence[BoneShot]
    loss: float

    @property
    def trusted(self) -> bool:
        """Whether all checks passed."""
        return not failed(self.checks)

    def at(self, xyz_mm: np.ndarray) -> np.ndarray:
        """Return points (N, 3) of the CT or mesh in CFCS, mm."""
        return self.pose.apply(np.asarray(xyz_mm, dtype=np.float64))

    def covariance_at(self, xyz_mm: np.ndarray) -> np.ndarray:
        """Return the joint covariance (3N, 3N), mm², of points (N, 3) of the CT or mesh in CFCS.

        Raises ErrorUnknownError.
        """
        if self.covariance is None:
            raise ErrorUnknownError(
                "a view has no covariance, so the error of the bone's pose is unknown; calibrate the views from their "
                "beads, or give their matrices with a covariance"
            )
        by_pose = displacement(self.at(xyz_mm) - self.centre_mm).reshape(-1, 6)
        return by_pose @ self.covariance @ by_pose.T

    @cached_property
    def error_95_mm(self) -> float:
        """95 % bound of the error at the bone's centre. Raises ErrorUnknownError."""
        middle = self.bone.centre_mm
        return float(length_quantile(self.covariance_at(middle[None])))

    def summary(self) -> str:
        """Return the pose with its error, and the checks that failed."""
        return "\n".join([*self.sentences(), *checks_lines(self.checks, len(self.checks))])

    def sentences(self) -> list[str]:
        """Return the pose with its error."""
        turn = np.rad2deg(self.pose.rotation.as_rotvec())
        error = "error unknown"
        if self.covariance is not None:
            sd = np.rad2deg(np.sqrt(np.diag(self.covariance)[:3]).max())
            error = f"95 % error {self.error_95_mm:.2f} mm at its centre; rotation to {1.96 * sd:.2f}°"
        return [
            f"Bone in {len(self.shots)} views: {', '.join(shot.view.name for shot in self.shots)}",
            f"  centre {numbers(self.centre_mm, 2)} mm, CFCS; rotation vector {numbers(turn, 2)}°",
            f"  {error}",
        ]

    def document(self) -> dict[str, Any]:
        """Return pose, error and checks as JSON types; `matrix` is 4 x 4, mm."""
        return {
            "coordinates": "CFCS",
            "matrix": self.pose.as_matrix().tolist(),
            "centre_mm": self.centre_mm.tolist(),
            "covariance": None if self.covariance is None else self.covariance.tolist(),
            "trusted": self.trusted,
            "checks": [vars(check) for check in self.checks],
        }

    def _new_axes(self, figure: Any) -> Any:
        return pictures.new_axes(figure, len(self.shots))

    def _size_in(self) -> tuple[float, float]:
        return pictures.size_in(len(self.shots))

    def _draw(self, ax: Any) -> None:
        pictures.draw(ax, self.shots, self.bone, self.pose)
