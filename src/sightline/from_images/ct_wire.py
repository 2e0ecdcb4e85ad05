"""A wire that was planned on a CT or mesh, placed in CFCS by the registration of its bone."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from sightline.common.checks import CheckCode
from sightline.common.show import Plotted, checks_lines
from sightline.errors import UnusableInputError
from sightline.from_images.registration import pictures
from sightline.from_images.registration.result import BonePose
from sightline.planning import Procedure, SpacePoints, Trajectory, Verdict, judge
from sightline.planning.plan import verdict_document
from sightline.planning.verdict.bone_checks import not_made


@dataclass(frozen=True, eq=False, repr=False)
class CtWire(Plotted):
    """A wire from entry to end with the registration's error, judged by a procedure's limits and the bone's checks.

    The procedure's checks of the wire against the bone need drawings in the images: with any of them the wire is
    incomplete.
    """

    trajectory: Trajectory
    verdict: Verdict
    kind: Procedure
    side: str | None
    bone: BonePose

    def summary(self) -> str:
        """Return the verdict, entry and end with their error bounds, and the checks that failed."""
        first = f"Wire of a {self.kind.name}, planned on the CT: {self.verdict.state.upper()}"
        path = self.trajectory.summary().splitlines()[1:]
        return "\n".join([first, *path, *checks_lines(self.verdict.checks, 4)])

    def document(self) -> dict[str, Any]:
        """Return the wire as the JSON types of `PlanDocument`, with `bone`, the registration."""
        return {
            **verdict_document(self.verdict, self.kind, self.side),
            "trajectory": self.trajectory.document(),
            "bone": self.bone.document(),
            "checks": [vars(check) for check in self.verdict.checks],
        }

    def _size_in(self) -> tuple[float, float]:
        return pictures.size_in(len(self.bone.shots))

    def _new_axes(self, figure: Any) -> Any:
        return pictures.new_axes(figure, len(self.bone.shots))

    def _draw(self, ax: Any) -> None:
        pictures.draw(ax, self.bone.shots, self.bone.bone, self.bone.pose, self.trajectory.points.xyz_mm)


def ct_wire(found: BonePose, ends_mm: np.ndarray, kind: Procedure, side: str | None = None) -> CtWire:
    """Return the wire from entry to end (2, 3), mm, in the coordinates of the CT or mesh.

    Raises UnusableInputError for points that are too near to each other, and for one of several wires.
    """
    if kind.several:
        raise UnusableInputError(
            f"{kind.document.key} has several wires, whose relations are checked on images; plan them with "
            "`sightline plan`"
        )
    xyz = found.at(ends_mm)
    covariance = None if found.covariance is None else found.covariance_at(ends_mm)
    none = np.zeros(2)
    budget = None if covariance is None else {"bone": covariance}
    trajectory = Trajectory(SpacePoints(xyz, none, none > 0, None, covariance, budget, _inside(found, xyz)))
    views = [shot.view for shot in found.shots]
    judged = judge(trajectory, views, kind.limits).checks
    # Movement is judged by the bone's own check, which needs no landmarks.
    own = [check for check in judged if check.code is not CheckCode.MOVEMENT]
    wanting = not_made(kind.checks, "it needs the bone drawn in the images; judge the wire there with `sightline plan`")
    return CtWire(trajectory, Verdict(tuple(dict.fromkeys([*found.checks, *own, *wanting]))), kind, side, found)


def _inside(found: BonePose, xyz_mm: np.ndarray) -> np.ndarray:
    """Return which points (N, 3) lie within the beads' convex hull in all views, (N,) bool."""
    inside = np.ones(len(xyz_mm), dtype=bool)
    for shot in found.shots:
        uv, seen = shot.view.project_seen(xyz_mm)
        inside &= seen
        inside[seen] &= shot.view.lines_of_sight(uv).inside_hull
    return inside
