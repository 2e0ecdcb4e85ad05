"""What is drawn of a plan in an image: image-matching curves, and the planned wire with its 95 % band.

An image-matching curve is the line of sight of a pick in one view, drawn in the other.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, partial

import numpy as np

from sightline.calibration.view import CalibratedView, LinesOfSight
from sightline.common.geometry.covariance import TWO_SIDED_95
from sightline.common.geometry.lines import cross, unit
from sightline.errors import OutsideRegionError, UnusableInputError
from sightline.planning.points.lines_of_sight import (
    LineResiduals,
    no_lines,
    pick_covariance_mm2,
    refuse_repeated,
    refuse_two_frames,
)
from sightline.planning.points.picks import DEFAULT_PICK_SD_PX, Pick
from sightline.planning.points.trajectory import Trajectory

# Steps along a curve and along a wire, about 10 and 25 px: chords of the distorted lines deviate from them by less than
# 0.01 and 0.06 px, which no screen shows [ours].
STEP_MM, _STEP_MM = 2.0, 5.0
TICK_MM = 10.0  # a centimetre, as on a ruler
_BAND_EVERY = 5  # samples: the band varies as slowly as the map's covariance, over the beads' pitch
# A click farther than this from the curve was not meant for it: about 8 mm at the hip [ours].
MAX_SNAP_PX = 25.0
WIRE_DIAMETER_MM = 2.5  # physics.md, Planning values [paper]


@dataclass(frozen=True, eq=False)
class MatchingCurve:
    """A line of sight of `from_view` as `to_view` shows it, S samples every 2 mm where `to_view` is calibrated.

    `depth_mm` (S,): distance along the line of sight from the reference plane of `from_view` (for views of a frame its
    XRII plate), positive towards the X-ray source.
    `uv_px` (S, 2) and unit vectors `tangent_px` (S, 2), IDCS of `to_view`: they follow the view's own map, so the curve
    bends with its distortion and may run in any direction. `xyz_mm` (S, 3), CFCS. `is_tick` (S,) bool: every 10 mm.
    `band`: returns `half_width_px`.
    """

    from_view: str
    to_view: str
    depth_mm: np.ndarray
    xyz_mm: np.ndarray
    uv_px: np.ndarray
    tangent_px: np.ndarray
    is_tick: np.ndarray
    band: Callable[[], np.ndarray | None]

    @cached_property
    def half_width_px(self) -> np.ndarray | None:
        """(S,) half width of the band that holds the true line with a probability of 95 %, the pick's own error
        included; None where a view's error is unknown. It is computed when it is first read."""
        return self.band()

    @property
    def across_px(self) -> np.ndarray:
        """(S, 2) unit vectors across the curve."""
        return _perpendicular(self.tangent_px)


def matching_curve(
    from_view: CalibratedView, uv_px: np.ndarray, to_view: CalibratedView, uv_covariance_px2: np.ndarray | None = None
) -> MatchingCurve:
    """Return the line of sight of pixel `uv_px` (2,) of one view, drawn in another (the paper, section 4.3, Fig. 12).

    `uv_covariance_px2` (2, 2): of the pick; 0.5 px per axis where not given. Raises OutsideRegionError where no part
    of the line lies in the other view's calibrated region, ReconstructionRefusedError for views of two frames or of one
    exposure.
    """
    uv = np.asarray(uv_px, dtype=np.float64)
    if uv.shape != (2,) or not np.isfinite(uv).all():
        raise UnusableInputError(f"give one finite pixel (u, v) for an image-matching curve, not {uv_px!r}")
    refuse_repeated((from_view, to_view))
    line = from_view.lines_of_sight(uv[None])
    towards = -line.directions[0]
    length = float(np.linalg.norm(line.points_mm[0] - line.focal_point_mm))
    depth = STEP_MM * np.arange(-(length // STEP_MM), length // STEP_MM)
    xyz = line.points_mm[0] + depth[:, None] * towards
    curve_px, seen = _seen(to_view, xyz)
    if len(curve_px) < 3:
        raise OutsideRegionError(
            f"no part of the line of sight picked in view {from_view.name!r} lies in the calibrated region of view "
            f"{to_view.name!r}; pick a point that both images show, or acquire the images again with the target nearer "
            "to their middle"
        )
    depth, xyz = depth[seen], xyz[seen]
    tangent = unit(np.gradient(curve_px, depth, axis=0, edge_order=2))
    pick = DEFAULT_PICK_SD_PX**2 * np.eye(2) if uv_covariance_px2 is None else np.asarray(uv_covariance_px2)
    refuse_two_frames((line, no_lines(to_view)))
    return MatchingCurve(
        from_view=from_view.name,
        to_view=to_view.name,
        depth_mm=depth,
        xyz_mm=xyz,
        uv_px=curve_px,
        tangent_px=tangent,
        is_tick=np.isclose(depth % TICK_MM, 0.0),
        band=partial(_half_width_px, line, pick, 1.0 - depth / length, to_view, xyz, curve_px, tangent),
    )


def snap(curve: MatchingCurve, uv_px: np.ndarray, sd_px: float = DEFAULT_PICK_SD_PX) -> Pick:
    """Return the point of the curve nearest to a click `uv_px` (2,), a one-dimensional pick along the curve.

    `sd_px`: its standard deviation along the curve. Raises UnusableInputError where the click is too far from the
    curve, OutsideRegionError where it is beyond its ends.
    """
    click = Pick.free(uv_px, sd_px).uv_px
    start, chord = curve.uv_px[:-1], np.diff(curve.uv_px, axis=0)
    share = np.clip(np.einsum("ij,ij->i", click - start, chord) / np.einsum("ij,ij->i", chord, chord), 0.0, 1.0)
    nearest = start + share[:, None] * chord
    distance = np.linalg.norm(click - nearest, axis=1)
    best = int(np.argmin(distance))
    if best + share[best] in (0.0, len(chord)) and distance[best] > 0.0:
        raise OutsideRegionError(
            f"the click is {distance[best]:.0f} px beyond the end of the matching curve, where view "
            f"{curve.to_view!r} is not calibrated; pick nearer to the beads, or move the frame"
        )
    if not distance[best] <= MAX_SNAP_PX:
        raise UnusableInputError(
            f"the click is {distance[best]:.0f} px from the matching curve in view {curve.to_view!r} (at most "
            f"{MAX_SNAP_PX:.0f} px); click on the curve, or pick the point freely"
        )
    tangent = unit((1.0 - share[best]) * curve.tangent_px[best] + share[best] * curve.tangent_px[best + 1])
    return Pick(nearest[best], sd_px**2 * np.outer(tangent, tangent), _perpendicular(tangent))


def _seen(view: CalibratedView, xyz_mm: np.ndarray) -> tuple[np.ndarray, slice]:
    """Return the pixels (M, 2) of the points (S, 3) of a line that the view can project, and their slice of the points.

    Of several stretches the one nearest to the foot of the line is returned (its point nearest to the focal point).
    """
    uv, seen = view.project_seen(xyz_mm)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], seen, [False]]).astype(np.int8))).reshape(-1, 2)
    if not len(edges):
        return uv, slice(0, 0)
    nearest = 0
    if len(edges) > 1:
        foot = int(np.argmin(np.linalg.norm(xyz_mm - view.focal_point_mm, axis=1)))
        nearest = int(np.argmin(np.maximum(np.maximum(edges[:, 0] - foot, foot - edges[:, 1] + 1), 0)))
    first, last = (int(k) for k in edges[nearest])
    before = int(np.count_nonzero(seen[:first]))
    return uv[before : before + last - first], slice(first, last)


def _perpendicular(tangent_px: np.ndarray) -> np.ndarray:
    """Return the vectors (..., 2) rotated by 90°."""
    return np.stack([-tangent_px[..., 1], tangent_px[..., 0]], axis=-1)


def _half_width_px(  # noqa: PLR0917
    line: LinesOfSight,
    pick_px2: np.ndarray,
    reach: np.ndarray,
    to_view: CalibratedView,
    xyz_mm: np.ndarray,
    uv_px: np.ndarray,
    tangent_px: np.ndarray,
) -> np.ndarray | None:
    """Return `MatchingCurve.half_width_px` (S,) of samples at `xyz_mm` (S, 3), `uv_px` (S, 2)."""
    some = np.unique(np.r_[0 : len(reach) : _BAND_EVERY, len(reach) - 1])
    there = LineResiduals.at(to_view.lines_of_sight(uv_px[some]), xyz_mm[some])
    sd = _sd_across_px(line, pick_px2, reach[some], there, _perpendicular(tangent_px[some]))
    return None if sd is None else np.interp(-reach, -reach[some], TWO_SIDED_95 * sd)


def _sd_across_px(
    line: LinesOfSight, pick_px2: np.ndarray, reach: np.ndarray, samples: LineResiduals, across_px: np.ndarray
) -> np.ndarray | None:
    """Return (S,) the standard deviation of the true line's distance across the curve; None where an error is unknown.

    `reach` (S,): place of each sample on the line, 0 at the focal point, 1 at the plane; `across_px` (S, 2): unit
    vectors across the curve.
    """
    line_covariance, view_covariance = line.total_covariance, samples.lines.total_covariance
    if line_covariance is None or view_covariance is None:
        return None
    n = len(samples.xy_mm)
    across = np.einsum("ij,ijk->ik", across_px, np.linalg.inv(samples.lines.jacobian))  # px per mm on the plane
    # Derivatives of the distance across the curve by the picked line (F, xy) and by the other view's line.
    by_point = np.einsum("ij,ijb->ib", across, samples.to_point)
    by_line = np.hstack([(1.0 - reach)[:, None] * by_point, reach[:, None] * (by_point @ line.plane.axes.T)])
    by_view = np.einsum("ij,ijk->ik", across, samples.to_line.reshape(n, 2, -1))
    line_covariance = line_covariance.copy()
    line_covariance[3:, 3:] += pick_covariance_mm2(line, pick_px2[None])[0]
    variance = np.einsum("ip,pq,iq->i", by_line, line_covariance, by_line)
    variance += np.einsum("ip,pq,iq->i", by_view, view_covariance, by_view)
    for source in line.sources_shared_with(samples.lines):
        shared = by_line @ line.shared[source], by_view @ samples.lines.shared[source]
        variance -= 2.0 * np.einsum("ik,ik->i", *shared)
    return np.sqrt(variance)


@dataclass(frozen=True, eq=False)
class Corridor:
    """The planned wire in one view at S stations along it, as far as the view is calibrated.

    `along_mm` (S,): distance from the entry point; `uv_px` (S, 2): centre line and `across_px` (S, 2): unit vectors
    across it, IDCS; `px_per_mm` (S,): scale across it; `wire_half_px` (S,): half the wire's width. `half_95_px` (S,):
    half width of the band that holds the drilled wire with a probability of 95 %; None where
    `trajectory.error_stated` is False.
    """

    along_mm: np.ndarray
    uv_px: np.ndarray
    across_px: np.ndarray
    px_per_mm: np.ndarray
    wire_half_px: np.ndarray
    half_95_px: np.ndarray | None


def corridor(
    view: CalibratedView,
    trajectory: Trajectory,
    wire_mm: float = WIRE_DIAMETER_MM,
    beyond_mm: float = 0.0,
) -> Corridor:
    """Return the corridor of a trajectory, to `beyond_mm` past its end point; `wire_mm`: diameter of the wire.

    The error of the point at fraction s of the length is (1 - s) times the entry's error plus s times the end's.
    Raises OutsideRegionError where no part of the wire lies in the view's calibrated region.
    """
    length = trajectory.length_mm
    along = np.linspace(0.0, length + beyond_mm, 2 + int((length + beyond_mm) / _STEP_MM))
    xyz = trajectory.entry_mm + along[:, None] * trajectory.direction
    sideways = unit(cross(trajectory.direction, xyz - view.focal_point_mm))
    uv, seen = view.project_seen(np.concatenate([xyz, xyz - sideways / 2, xyz + sideways / 2]))
    whole = seen.reshape(3, -1).all(axis=0)
    pixels = np.zeros((len(seen), 2))
    pixels[seen] = uv
    middle, left, right = pixels.reshape(3, -1, 2)[:, whole]
    if len(middle) < 2:
        raise OutsideRegionError(
            f"no part of the plan lies in the calibrated region of view {view.name!r}; move the frame so that its "
            "beads surround it"
        )
    tangent = unit(np.gradient(middle, along[whole], axis=0))
    across = np.stack([-tangent[:, 1], tangent[:, 0]], axis=1)
    px_per_mm = np.abs(np.einsum("ij,ij->i", across, right - left))
    half_95 = None
    if trajectory.error_stated:
        share = (along / length)[whole, None]
        response = np.hstack([(1.0 - share) * sideways[whole], share * sideways[whole]])
        half_95 = (
            TWO_SIDED_95 * px_per_mm * np.sqrt(np.einsum("ip,pq,iq->i", response, trajectory.covariance_mm2, response))
        )
    return Corridor(along[whole], middle, across, px_per_mm, px_per_mm * wire_mm / 2, half_95)
