"""A bone that was registered to views: what a plan on these views, and a check shot, take from its registration."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from scipy.spatial.transform import RigidTransform

from sightline.calibration.view import CalibratedView
from sightline.common.checks import Check, failed
from sightline.common.geometry.covariance import length_quantile
from sightline.common.geometry.rigid import displacement
from sightline.common.show import Shown, checks_lines, numbers
from sightline.errors import ErrorUnknownError, UnusableInputError

# Focal points of one image, calibrated twice, differ by less [as `_SAME_VIEW_MM` of saved views]; of two images, by
# 0.1 mm and more, as their noise does.
_SAME_VIEW_MM = 1e-3
_ARRAYS = "focal_point_mm", "own_matrix"  # of a BoneView


@dataclass(frozen=True, eq=False)
class BoneView:
    """A view that a bone was registered to: its name, its focal point (3,), CFCS, and a hash of its image's pixels.

    `own_matrix` (4, 4): the bone's pose as this view alone shows it; `along_beam_95_mm`: 95 % bound of its error along
    the beam, None where the view's error is unknown.
    """

    view: str
    focal_point_mm: np.ndarray
    pixels_sha256: str
    own_matrix: np.ndarray
    along_beam_95_mm: float | None


@dataclass(frozen=True, eq=False, repr=False)
class RegisteredBone(Shown):
    """Where a bone lies in the images of `views`, with its error and its checks.

    `matrix` (4, 4): takes its CT's or mesh's coordinates, mm, to CFCS. `covariance` (6, 6): of a rotation vector about
    `centre_mm` (3,), CFCS, rad, and a shift, mm, both CFCS; None where a view's error is unknown. `volume_sha256`:
    tells CTs and meshes apart.
    """

    matrix: np.ndarray
    centre_mm: np.ndarray
    covariance: np.ndarray | None
    checks: tuple[Check, ...]
    views: tuple[BoneView, ...]
    volume_sha256: str

    @staticmethod
    def of(document: Mapping[str, Any]) -> "RegisteredBone":
        """Return the bone of `document`."""
        covariance = document["covariance"]
        return RegisteredBone(
            matrix=np.array(document["matrix"], dtype=np.float64),
            centre_mm=np.array(document["centre_mm"], dtype=np.float64),
            covariance=None if covariance is None else np.array(covariance, dtype=np.float64),
            checks=tuple(Check.of(check) for check in document["checks"]),
            views=tuple(
                BoneView(**seen | {name: np.array(seen[name], dtype=np.float64) for name in _ARRAYS})
                for seen in document["views"]
            ),
            volume_sha256=document["volume_sha256"],
        )

    @cached_property
    def pose(self) -> RigidTransform:
        """The pose, which takes the CT's or mesh's coordinates to CFCS."""
        return RigidTransform.from_matrix(self.matrix)

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
        by_pose = displacement(self.at(xyz_mm) - self.centre_mm).reshape(-1, 6)
        return by_pose @ self._known_covariance @ by_pose.T

    @property
    def error_95_mm(self) -> float:
        """95 % bound of the error at the bone's centre. Raises ErrorUnknownError."""
        return float(length_quantile(self._known_covariance[3:, 3:]))

    @property
    def _known_covariance(self) -> np.ndarray:
        if self.covariance is None:
            raise ErrorUnknownError(
                "a view has no covariance, so the error of the bone's pose is unknown; calibrate the views from their "
                "beads, or give their matrices with a covariance"
            )
        return self.covariance

    def refuse_other_views(self, views: Sequence[CalibratedView]) -> None:
        """Raise UnusableInputError unless the bone was registered to these views, and to no others."""
        registered, names = {seen.view: seen for seen in self.views}, [view.name for view in views]
        if sorted(registered) != sorted(names):
            raise UnusableInputError(
                f"the bone was registered in the views {', '.join(registered)}, and these are {', '.join(names)}; "
                "register it in these views, and in no others"
            )
        for view in views:
            off_mm = float(np.linalg.norm(registered[view.name].focal_point_mm - view.focal_point_mm))
            if not off_mm <= _SAME_VIEW_MM:
                raise UnusableInputError(
                    f"the bone was registered in another image of view {view.name}, or in another calibration of it: "
                    f"the focal points lie {off_mm:.3f} mm apart (at most {_SAME_VIEW_MM:g} mm); register it in these "
                    "images, calibrated alike"
                )

    def refuse_other_images(self, pixels_sha256: Mapping[str, str]) -> None:
        """Raise UnusableInputError where the bone was registered in an image with other pixels; hashes by view."""
        for seen in self.views:
            if pixels_sha256.get(seen.view, seen.pixels_sha256) != seen.pixels_sha256:
                raise UnusableInputError(
                    f"the bone was registered in another {seen.view} image than this one; register it in these images"
                )

    def movement_to(self, now: "RegisteredBone", xyz_mm: np.ndarray) -> tuple[RigidTransform, np.ndarray]:
        """Return how the bone moved until it was registered `now`: the motion from the CFCS of the one to that of the
        other, and its covariance (6, 6) of a rotation vector, rad, about the point (3,) and a shift, mm, there.

        It is an upper bound for what is seen in the same views, whose errors would cancel in part. Raises
        UnusableInputError for another CT or mesh, ErrorUnknownError.
        """
        if now.volume_sha256 != self.volume_sha256:
            raise UnusableInputError(
                "the bone was registered with another CT or mesh than in the plan, which has other coordinates; "
                "register the same file"
            )
        movement = now.pose * self.pose.inv()
        before = _about(xyz_mm - self.centre_mm, self._known_covariance)
        turned = np.kron(np.eye(2), movement.rotation.as_matrix())
        after = _about(movement.apply(xyz_mm) - now.centre_mm, now._known_covariance)
        return movement, turned @ before @ turned.T + after

    def checks_beside(self, judged: Sequence[Check]) -> tuple[Check, ...]:
        """Return the registration's checks that are not among those `judged` of the same views."""
        known = {(check.code, check.view) for check in judged}
        return tuple(check for check in self.checks if (check.code, check.view) not in known)

    def summary(self) -> str:
        """Return the pose with its error, and the checks that failed."""
        return "\n".join([*self.sentences(), *checks_lines(self.checks, len(self.checks))])

    def sentences(self) -> list[str]:
        """Return the pose with its error."""
        turn = np.rad2deg(self.pose.rotation.as_rotvec())
        return [
            f"Bone in {len(self.views)} views: {', '.join(seen.view for seen in self.views)}",
            f"  centre {numbers(self.centre_mm, 2)} mm, CFCS; rotation vector {numbers(turn, 2)}°",
            f"  {self.error_sentence()}",
            *(
                f"  {seen.view} alone: to {seen.along_beam_95_mm:.1f} mm along its beam (95 %)"
                for seen in self.views
                if seen.along_beam_95_mm is not None
            ),
        ]

    def error_sentence(self) -> str:
        """Return the 95 % bounds of the pose's error."""
        if self.covariance is None:
            return "error unknown"
        sd = np.rad2deg(np.sqrt(np.diag(self.covariance)[:3]).max())
        return f"95 % error {self.error_95_mm:.2f} mm at its centre; rotation to {1.96 * sd:.2f}°"

    def document(self) -> dict[str, Any]:
        """Return pose, error, checks and views as JSON types; `matrix` is 4 x 4, mm."""
        return {
            "coordinates": "CFCS",
            "matrix": self.matrix.tolist(),
            "centre_mm": self.centre_mm.tolist(),
            "covariance": None if self.covariance is None else self.covariance.tolist(),
            "trusted": self.trusted,
            "checks": [vars(check) for check in self.checks],
            "views": [vars(seen) | {name: getattr(seen, name).tolist() for name in _ARRAYS} for seen in self.views],
            "volume_sha256": self.volume_sha256,
        }


def _about(arm_mm: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """Return the covariance (6, 6) of rotation and shift at the end of an arm (3,)."""
    to_end = np.vstack([np.eye(3, 6), displacement(arm_mm)])
    return to_end @ covariance @ to_end.T
