"""Lines of sight of everything picked in two views, as one vector of numbers with one covariance.

What two drawings have in common, the focal points, the maps, the frame, is so counted once, whatever is computed from
them together.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from sightline.calibration.view import CalibratedView, LinesOfSight
from sightline.planning.line_residuals import refuse_two_frames

# Of one drawing in one view: pixels (M, 2) and their covariance (2M, 2M).
Drawn = tuple[np.ndarray, np.ndarray]


@dataclass(frozen=True, eq=False)
class Sights:
    """z = (F, xy, xy ... of the first view, then of the second), mm; `rows` says which lines a drawing has in a view.

    `picks_px2`: for each view, the covariance of all its pixels (2N, 2N), u v by turns.
    """

    lines: tuple[LinesOfSight, LinesOfSight]
    rows: tuple[dict[str, slice], dict[str, slice]]
    picks_px2: tuple[np.ndarray, np.ndarray]

    @staticmethod
    def of(views: Sequence[CalibratedView], drawn: Sequence[Mapping[str, Drawn]]) -> "Sights":
        """Of the named drawings of two views. Raises OutsideRegionError, ReconstructionRefusedError."""
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
        return Sights((lines[0], lines[1]), (rows[0], rows[1]), (picks[0], picks[1]))

    @property
    def values(self) -> np.ndarray:
        """z."""
        return np.concatenate([part for one in self.lines for part in (one.focal_point_mm, one.xy_mm.ravel())])

    @property
    def covariance(self) -> np.ndarray | None:
        """Of z; None where a view's error is unknown. Only the frame's error is shared by two views."""
        first, second = self.lines
        if first.covariance is None or second.covariance is None:
            return None
        size = 3 + 2 * len(first.xy_mm)
        whole = np.zeros((size + 3 + 2 * len(second.xy_mm),) * 2)
        for at, one, picks_px2 in ((0, first, self.picks_px2[0]), (size, second, self.picks_px2[1])):
            assert one.covariance is not None  # noqa: S101 - looked at above
            own = np.sum(list(one.covariance.values()), axis=0)
            count = len(one.xy_mm)
            on_plane = np.zeros((count, 2, count, 2))
            on_plane[range(count), :, range(count), :] = one.jacobian
            on_plane = on_plane.reshape(2 * count, 2 * count)
            own[3:, 3:] += on_plane @ picks_px2 @ on_plane.T
            whole[at : at + len(own), at : at + len(own)] = own
        if first.frame_factor is not None and second.frame_factor is not None:
            whole[:size, size:] = first.frame_factor @ second.frame_factor.T
            whole[size:, :size] = whole[:size, size:].T
        return whole

    def index(self, name: str) -> np.ndarray:
        """Which numbers of z belong to a drawing: of each view that has it the focal point, then its xy."""
        out, start = [], 0
        for one, rows in zip(self.lines, self.rows, strict=True):
            if name in rows:
                numbers = np.arange(3 + 2 * len(one.xy_mm)) + start
                out += [numbers[:3], numbers[3 + 2 * rows[name].start : 3 + 2 * rows[name].stop]]
            start += 3 + 2 * len(one.xy_mm)
        return np.concatenate(out)

    def rays(self, name: str, z: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
        """For each view that has a drawing, from its numbers (K, n): focal point (K, 1, 3) and points (K, M, 3)."""
        out, start = [], 0
        for one, rows in zip(self.lines, self.rows, strict=True):
            if name in rows:
                count = rows[name].stop - rows[name].start
                xy = z[:, start + 3 : start + 3 + 2 * count].reshape(len(z), count, 2)
                out.append((z[:, None, start : start + 3], one.plane.to_space(xy)))
                start += 3 + 2 * count
        return out
