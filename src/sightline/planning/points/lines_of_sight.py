"""Lines of sight of everything picked in several views, as one vector of numbers with one joint covariance.

Errors that drawings share (focal points, maps, frame) are thereby counted once in any quantity computed from them.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from sightline.calibration.view import SOURCES, CalibratedView, LinesOfSight
from sightline.planning.points.line_residuals import joint_covariance, refuse_two_frames

# One drawing in one view: pixels (M, 2) and their covariance (2M, 2M).
Drawn = tuple[np.ndarray, np.ndarray]


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
        return np.concatenate([part for one in self.lines for part in (one.focal_point_mm, one.xy_mm.ravel())])

    @property
    def covariance(self) -> np.ndarray | None:
        """The covariance of z; None where a view's error is unknown."""
        found, start = joint_covariance(self.lines, (SOURCES,)), 0
        if found is None:
            return None
        (out,) = found
        for one, picks_px2 in zip(self.lines, self.picks_px2, strict=True):
            count = len(one.xy_mm)
            on_plane = np.zeros((count, 2, count, 2))
            on_plane[range(count), :, range(count), :] = one.jacobian
            on_plane = on_plane.reshape(2 * count, 2 * count)
            own = slice(start + 3, start + 3 + 2 * count)
            out[own, own] += on_plane @ picks_px2 @ on_plane.T
            start = own.stop
        return out

    def index(self, name: str) -> np.ndarray:
        """Return the indices in z of a drawing's numbers: for each view that has it the focal point, then its xy."""
        out, start = [], 0
        for one, rows in zip(self.lines, self.rows, strict=True):
            if name in rows:
                numbers = np.arange(3 + 2 * len(one.xy_mm)) + start
                out += [numbers[:3], numbers[3 + 2 * rows[name].start : 3 + 2 * rows[name].stop]]
            start += 3 + 2 * len(one.xy_mm)
        return np.concatenate(out)

    def rays(self, name: str, z: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
        """Return, for each view with the drawing, focal point (K, 1, 3) and points (K, M, 3) of its numbers (K, n)."""
        out, start = [], 0
        for one, rows in zip(self.lines, self.rows, strict=True):
            if name in rows:
                count = rows[name].stop - rows[name].start
                xy = z[:, start + 3 : start + 3 + 2 * count].reshape(len(z), count, 2)
                out.append((z[:, None, start : start + 3], one.plane.to_space(xy)))
                start += 3 + 2 * count
        return out
