"""A start from points of the CT or mesh that a person clicked in the images."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from sightline.calibration import CalibratedView
from sightline.calibration.exchange import reading
from sightline.calibration.exchange.markups import read_table
from sightline.common.geometry.lines import unit
from sightline.common.geometry.rigid import rigid_fit
from sightline.errors import UnusableInputError
from sightline.from_images.registration.bone import ScannedBone
from sightline.from_images.registration.search import BoneStart, meeting

MAX_APART_MM = 10.0  # [ours] of a clicked point from its place in the CT: the reach of a start
# [ours] rms distance of the points from their common axis, below which clicks do not tell the rotation about it: errors
# of 2 mm turn it by more than 10°.
_MIN_SPREAD_MM = 8.0
_MIN_LENGTH_MM = 20.0  # [ours] of an axis: the same errors tilt it by 8°
_TURNS = 36  # [ours] every 10°: 5° off at most
_COLUMNS = ("name", "view", "u", "v")

Clicks = Mapping[str, Mapping[str, np.ndarray]]


@dataclass(frozen=True, eq=False, kw_only=True)
class AxisStart(BoneStart):
    """A start whose rotation about the axis through two points `ends_mm` (2, 3), CFCS, is not known."""

    ends_mm: np.ndarray

    def known_mm(self, bone: ScannedBone) -> np.ndarray:
        """Return the middle of the axis."""
        return self.ends_mm.mean(axis=0)

    def turned(self, bone: ScannedBone) -> list[RigidTransform]:
        """Return poses of all rotations about the axis."""
        angles = 2 * np.pi * np.arange(_TURNS) / _TURNS
        turns = Rotation.from_rotvec(angles[:, None] * unit(self.ends_mm[1] - self.ends_mm[0]))
        at = self.ends_mm[0]
        return [RigidTransform.from_components(at - turn.apply(at), turn) * self.pose for turn in turns]


def read_clicks(path: str | Path) -> Clicks:
    """Return the pixels (2,) of a table `name,view,u,v`, by name and view. Raises UnusableInputError."""
    file = Path(path)
    clicks: dict[str, dict[str, np.ndarray]] = {}
    for row in read_table(file, _COLUMNS):
        seen, what = clicks.setdefault(row["name"], {}), f"{file.name}: {row['name']} in {row['view']}"
        if row["view"] in seen:
            raise UnusableInputError(f"{what} stands twice; give one pixel")
        seen[row["view"]] = reading.array([row["u"], row["v"]], (2,), what)
    return clicks


def start_of_clicks(points_mm: Mapping[str, np.ndarray], clicks: Clicks, views: Sequence[CalibratedView]) -> BoneStart:
    """Return the start at which points (3,) of the CT or mesh lie where their clicks' lines of sight meet.

    Two points, or points near one line, leave the rotation about it open: all are tried. Raises UnusableInputError for
    fewer than two points, unknown names, and clicks that do not fit the points; ReconstructionRefusedError and
    OutsideRegionError for clicks that give no point.
    """
    by_name = {view.name: view for view in views}
    if len(by_name) < len(views):
        raise UnusableInputError(f"two views are named {next(iter(by_name))}; name them apart, with --view NAME:VIEW")
    unknown = sorted(
        (set(clicks) - set(points_mm)) | {view for seen in clicks.values() for view in seen} - set(by_name)
    )
    if unknown:
        raise UnusableInputError(
            f"the clicks name {', '.join(unknown)}, neither points nor views; points: {', '.join(points_mm)}; views: "
            f"{', '.join(by_name)}"
        )
    both = [name for name, seen in clicks.items() if len(seen) > 1]
    if len(both) < 2:
        raise UnusableInputError(f"{len(both)} points are clicked in two views; click two points or more in each")
    given = np.array([points_mm[name] for name in both])
    found = np.array([meeting((by_name[view], uv) for view, uv in clicks[name].items()) for name in both])
    pose = rigid_fit(given, found)
    apart = np.linalg.norm(pose.apply(given) - found, axis=1)
    if apart.max() > MAX_APART_MM:
        raise UnusableInputError(
            f"{both[int(apart.argmax())]} is clicked {apart.max():.0f} mm from its place among the points (at most "
            f"{MAX_APART_MM:.0f} mm); check the names of points and views, and click again"
        )
    spread = np.linalg.svd(given - given.mean(axis=0), compute_uv=False)[1] / len(given) ** 0.5
    if spread >= _MIN_SPREAD_MM:
        return BoneStart(pose)
    length = np.linalg.norm(found - found[0], axis=1)
    far = int(length.argmax())
    if length[far] < _MIN_LENGTH_MM:
        raise UnusableInputError(
            f"the clicked points are {length[far]:.0f} mm apart (at least {_MIN_LENGTH_MM:.0f} mm are needed for an "
            "axis); click points further apart"
        )
    return AxisStart(pose=pose, ends_mm=found[[0, far]])
