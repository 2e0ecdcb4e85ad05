"""Lines of sight of picked points: their residuals on the reference planes, and their joint covariance per source.

The residual of a point X in a view is `xy - projection(F, X)`, mm on the view's reference plane: the line's xy by the
plane map minus the central projection of X from the focal point F. Its error follows from those of xy and F. All lines
are one vector of numbers, so that errors that drawings share (focal points, maps, frame) are counted once.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from itertools import combinations, pairwise

import numpy as np

from sightline.calibration.view import SOURCES, CalibratedView, LinesOfSight
from sightline.common.geometry.covariance import block_diagonal
from sightline.common.geometry.planes import refuse_behind
from sightline.errors import ReconstructionRefusedError, UnusableInputError

# Two X-ray sources nearer than this belong to one exposure given twice [ours]: two views are hundreds of mm apart.
MIN_BASELINE_MM = 1.0
CACHED = 8  # values kept by view: of a few cases, before and after a change [ours]
# One drawing in one view: pixels (M, 2) and their covariance (2M, 2M).
Drawn = tuple[np.ndarray, np.ndarray]


@dataclass(frozen=True, eq=False)
class LineResiduals:
    """Residuals of N points in one view.

    `xy_mm` (N, 2); `to_point` (N, 2, 3): d projection / d X; `to_focal` (2N, 3): d residual / d F.
    `reach` (N,): distance of X from the focal point over that of the line's point on the plane: a line displaced by
    r on the plane is displaced by reach * r (perpendicular to itself) at X; negative behind the X-ray source.
    """

    lines: LinesOfSight
    xy_mm: np.ndarray
    to_point: np.ndarray
    to_focal: np.ndarray
    reach: np.ndarray

    @staticmethod
    def at(lines: LinesOfSight, xyz_mm: np.ndarray) -> "LineResiduals":
        """Return the residuals of points (N, 3), one for each line. Raises OutsideRegionError."""
        projected, to_point, reach = lines.pencil.projected(xyz_mm)
        refuse_behind(reach)
        # On the plane, a shift of F by r has the effect of a shift of X by (reach - 1) r.
        to_focal = ((1.0 - reach)[:, None, None] * to_point).reshape(-1, 3)
        return LineResiduals(lines, lines.xy_mm - projected, to_point, to_focal, reach)

    @cached_property
    def to_line(self) -> np.ndarray:
        """(2N, 3 + 2N): d residual / d (F, every xy)."""
        return np.hstack([self.to_focal, np.eye(len(self.to_focal))])


def joint_covariance(lines: Sequence[LinesOfSight], groups: Sequence[Sequence[str]]) -> np.ndarray | None:
    """Return the covariance (G, Z, Z) of the numbers z = (F, xy, xy ... of the first view, then of the second, ...) by
    the errors of each of G groups of SOURCES; None where a view's error is unknown.

    The views are correlated through the errors that they share.
    """
    at = _places(lines)
    covariances = np.zeros((len(groups), at[-1].stop, at[-1].stop))
    for i, view in enumerate(lines):
        if view.covariance is None:
            return None
        for covariance, group in zip(covariances, groups, strict=True):
            for source in group:
                covariance[at[i], at[i]] += view.covariance[source]
        for j in range(i):
            for source in view.sources_shared_with(lines[j]):
                between = view.shared[source] @ lines[j].shared[source].T
                for covariance in (each for each, group in zip(covariances, groups, strict=True) if source in group):
                    covariance[at[i], at[j]] += between
                    covariance[at[j], at[i]] += between.T
    return covariances


def covariance_of_residuals(views: Sequence[LineResiduals], errors: np.ndarray) -> np.ndarray:
    """Return the covariance (..., R, R) of the residuals of all views (view, point, axis), from that of their lines'
    numbers, `errors` (..., Z, Z) as of `joint_covariance`."""
    at = _places([view.lines for view in views])
    half = [_residuals(errors[..., own, :], view.to_focal) for view, own in zip(views, at, strict=True)]
    half = np.swapaxes(np.concatenate(half, axis=-2), -1, -2)
    whole = [_residuals(half[..., own, :], view.to_focal) for view, own in zip(views, at, strict=True)]
    return np.concatenate(whole, axis=-2)


def _residuals(numbers: np.ndarray, to_focal: np.ndarray) -> np.ndarray:
    """Return the response (..., 2N, n) of one view's residuals from that of its numbers (..., 3 + 2N, n)."""
    return numbers[..., 3:, :] + to_focal @ numbers[..., :3, :]


def _places(lines: Sequence[LinesOfSight]) -> list[slice]:
    """Return the place of each view's numbers in z."""
    ends = np.cumsum([0, *(3 + 2 * len(view.xy_mm) for view in lines)])
    return [slice(int(a), int(b)) for a, b in pairwise(ends)]


@lru_cache(maxsize=CACHED)
def no_lines(view: CalibratedView) -> LinesOfSight:
    """Return no lines of sight of a view: they tell its frame."""
    return view.lines_of_sight(np.zeros((0, 2)))


def refuse_two_frames(lines: Sequence[LinesOfSight]) -> None:
    """Raise ReconstructionRefusedError for views of two frames, whose coordinates are unrelated.

    A view from a matrix has no frame and is accepted with any.
    """
    known = [(view.view, view.frame_key) for view in lines if view.frame_key is not None]
    for (first, frame), (second, other) in pairwise(known):
        if frame == other:
            continue
        names = [key.partition("#")[0].rstrip("/") for key in (frame, other)]
        which = (
            f"the frames {names[0]} and {names[1]}" if names[0] != names[1] else f"two files of the frame {names[0]}"
        )
        raise ReconstructionRefusedError(
            f"the views {first!r} and {second!r} were calibrated with {which}, whose coordinates differ; "
            "calibrate all views with the one file of the frame in the images"
        )


def refuse_repeated(views: Sequence[CalibratedView]) -> None:
    """Raise UnusableInputError for fewer than two views, ReconstructionRefusedError where two are one exposure."""
    if len(views) < 2:
        raise UnusableInputError(f"{len(views)} views given; give two or more to reconstruct a point")
    for first, second in combinations(views, 2):
        baseline = float(np.linalg.norm(first.focal_point_mm - second.focal_point_mm))
        if first is second or baseline < MIN_BASELINE_MM:
            raise ReconstructionRefusedError(
                f"one view is given twice ({first.name!r} and {second.name!r}, X-ray sources {baseline:.1f} mm apart); "
                "give images taken from different directions"
            )


def pick_covariance_mm2(lines: LinesOfSight, covariance_px2: np.ndarray) -> np.ndarray:
    """Return the picks' covariances (N, 2, 2), px², propagated to the plane, mm²."""
    return lines.jacobian @ covariance_px2 @ np.swapaxes(lines.jacobian, -1, -2)


@dataclass(frozen=True, eq=False)
class Sights:
    """The vector z = (F, xy, xy ... of the first view, then of the second, ...), mm.

    `rows`: the lines of each drawing in a view; `picks_px2`: for each view the covariance (2N, 2N) of all its pixels,
    u and v interleaved.
    """

    lines: tuple[LinesOfSight, ...]
    rows: tuple[dict[str, slice], ...]
    picks_px2: tuple[np.ndarray, ...]

    @staticmethod
    def of(views: Sequence[CalibratedView], drawn: Sequence[Mapping[str, Drawn]]) -> "Sights":
        """Return the lines of sight of the drawings of each view, by name.

        Raises OutsideRegionError, ReconstructionRefusedError.
        """
        lines, rows, picks = [], [], []
        for view, named in zip(views, drawn, strict=True):
            counts = np.cumsum([0, *(len(uv) for uv, _ in named.values())])
            rows.append({name: slice(int(a), int(b)) for name, a, b in zip(named, counts, counts[1:], strict=False)})
            covariance = np.zeros((2 * int(counts[-1]), 2 * int(counts[-1])))
            for at, (_, own) in zip(rows[-1].values(), named.values(), strict=True):
                covariance[2 * at.start : 2 * at.stop, 2 * at.start : 2 * at.stop] = own
            picks.append(covariance)
            lines.append(view.lines_of_sight(np.concatenate([np.zeros((0, 2)), *(uv for uv, _ in named.values())])))
        refuse_two_frames(lines)
        return Sights(tuple(lines), tuple(rows), tuple(picks))

    @cached_property
    def values(self) -> np.ndarray:
        """The vector z."""
        return np.concatenate([part for sight in self.lines for part in (sight.focal_point_mm, sight.xy_mm.ravel())])

    @property
    def covariance(self) -> np.ndarray | None:
        """The covariance of z; None where a view's error is unknown."""
        known = joint_covariance(self.lines, (SOURCES,))
        if known is None:
            return None
        for place, sight, picks_px2 in zip(_places(self.lines), self.lines, self.picks_px2, strict=True):
            on_plane, xy = block_diagonal(sight.jacobian), slice(place.start + 3, place.stop)
            known[0, xy, xy] += on_plane @ picks_px2 @ on_plane.T
        return known[0]

    def index(self, name: str) -> np.ndarray:
        """Return the indices in z of a drawing's numbers: for each view that has it the focal point, then its xy."""
        parts = []
        for place, rows in zip(_places(self.lines), self.rows, strict=True):
            if name in rows:
                numbers = np.arange(place.start, place.stop)
                parts += [numbers[:3], numbers[3 + 2 * rows[name].start : 3 + 2 * rows[name].stop]]
        return np.concatenate(parts)

    def rays(self, name: str, z: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
        """Return, for each view with the drawing, focal point (K, 1, 3) and points (K, M, 3) of its numbers (K, n)."""
        rays, start = [], 0
        for sight, rows in zip(self.lines, self.rows, strict=True):
            if name in rows:
                count = rows[name].stop - rows[name].start
                xy = z[:, start + 3 : start + 3 + 2 * count].reshape(len(z), count, 2)
                rays.append((z[:, None, start : start + 3], sight.plane.to_space(xy)))
                start += 3 + 2 * count
        return rays
