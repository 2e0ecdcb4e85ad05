"""The distortion map of an image of one sheet: a dot grid or a perforated plate on the intensifier's face, without ids.

The lattice has no origin and no first row, so that the map is known up to a similarity whose scale the pitch gives. The
similarity is the one that moves the sheet's points least: an undistorted image has the size of the original, and its
pixels lie `spacing_mm` apart on the sheet.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import cv2
import numpy as np
from scipy.interpolate import RectBivariateSpline

from sightline.calibration.maps.hull import Hull
from sightline.calibration.maps.smooth import MAX_CONTROLS, FittedSmoothMap
from sightline.common.checks import FALSE_ALARM
from sightline.common.fitting import monomials
from sightline.common.show import Plotted
from sightline.detection import Detections
from sightline.detection.lattice import HEXAGONAL, SQUARE, Lattice, lattice_of_sheet
from sightline.errors import CalibrationRefusedError, UnusableInputError

# Largest ratio of the sheet's scales along and across: a sheet tilted by 18 degrees [calc]. Above, it is rather a sheet
# whose rows have another pitch than its columns, or an image whose pixels are not square.
MAX_STRETCH = 1.05
MAX_SD = 2.0  # [ours] times the usual error of a centre: cut by the edge of the field, points are off by 1 px [twin]
MIN_POINTS = 40  # [ours] with fewer, every second row does not tell the error of rows
MAX_LEFT_OUT = 0.1  # [ours] share of points that contradict the others: more is a damaged sheet
# Rows of a perforated sheet are punched together, and have common errors: the correlation of neighbours' leave-one-out
# residuals along a row is 0.6 in a real sheet [ARCADIS], at most 0.16 where errors are independent [twin].
_ROWS, _CORRELATED = ((1, 0), (0, 1), (1, -1)), 0.25
# Two square sheets, one shifted by half a diagonal, make one lattice. The upper one looks larger, by a thousandth for
# each mm, and is turned.
MAX_APART_PX, _APART_SD = 0.05, 5.0  # [ours] rms of what size and rotation do; and in standard deviations
MAX_ROW_ERROR_PX = 0.3  # [ours] s.d. of what rows have in common; half a sheet shifted by a tenth of its pitch has 0.4
# Between nodes of the inverse map, px: linear interpolation is within 0.004 px for 5 % of distortion at the rim [calc].
_NODE_PX = 8
_FAR_PX = -(2**14)  # outside of any image, and within the 16 bits of OpenCV's maps
_SAMPLES = 24  # [ours] side of the grid over the image on which the error is stated


@dataclass(frozen=True, eq=False, repr=False)
class GridMap(Plotted):
    """The distortion map of one intensifier at one zoom and place, from the points of a sheet.

    `uv_px` (N, 2): the points; `index` (N, 2): whole numbers along the axes of the lattice; `hexagonal`: whether these
    are 60 degrees apart, not 90; `pitch_mm`: between nearest points; `shape` (H, W) of the image; `kind`: ball or hole;
    `left_out`: points that contradicted the others. `pixels` (H, W): the image, where known.

    Raises CalibrationRefusedError where the points determine no map.
    """

    uv_px: np.ndarray
    index: np.ndarray
    hexagonal: bool
    pitch_mm: float
    shape: tuple[int, int]
    kind: str
    left_out: int = 0
    pixels: np.ndarray | None = None

    @cached_property
    def _lattice(self) -> np.ndarray:
        """(N, 2): the points on the ideal sheet, in pitches."""
        return self.index @ (HEXAGONAL if self.hexagonal else SQUARE)

    @cached_property
    def ideal_px(self) -> np.ndarray:
        """(N, 2): the points without distortion, by the similarity of the lattice that moves them least."""
        sheet = self._lattice - self._lattice.mean(axis=0)
        z, middle = sheet @ [1, 1j], self.uv_px.mean(axis=0)
        seen = (self.uv_px - middle) @ [1, 1j]
        if np.linalg.det(np.linalg.lstsq(sheet, self.uv_px - middle, rcond=None)[0]) < 0:
            z = z.conj()
        moved = z * (np.vdot(z, seen) / np.vdot(z, z).real)
        return middle + np.column_stack([moved.real, moved.imag])

    @cached_property
    def spacing_mm(self) -> float:
        """Distance of neighbouring pixels of an undistorted image on the sheet."""
        return self.pitch_mm * float(
            np.sqrt(np.square(self._lattice - self._lattice.mean(axis=0)).sum() / self._spread)
        )

    @property
    def _spread(self) -> float:
        return float(np.square(self.ideal_px - self.ideal_px.mean(axis=0)).sum())

    @cached_property
    def plane_map(self) -> FittedSmoothMap:
        """The map from pixels to the sheet, mm: `spacing_mm` times the pixels of the undistorted image."""
        return FittedSmoothMap.fit(self.uv_px, self.spacing_mm * self.ideal_px, None)

    @cached_property
    def hull(self) -> Hull:
        """The convex hull of the points in the image."""
        return Hull.of(self.uv_px)

    def covers(self, uv_px: np.ndarray) -> np.ndarray:
        """Return (N,) bool: whether pixels (N, 2) lie at most one pitch outside the convex hull of the points."""
        return self.hull.distance_px(uv_px) <= self.pitch_mm / self.spacing_mm

    def sd_px(self, uv_px: np.ndarray) -> np.ndarray:
        """Return (N,): the map's standard deviation per axis at pixels (N, 2), px of the undistorted image."""
        return self._row_factor * self._independent_sd_px(uv_px)

    def _independent_sd_px(self, uv_px: np.ndarray) -> np.ndarray:
        return np.sqrt(self.plane_map.covariance_mm2(uv_px).diagonal()) / self.spacing_mm

    @cached_property
    def leave_one_out(self) -> tuple[np.ndarray, np.ndarray]:
        """How each point is missed by the map of the others: (N, 2) px of the undistorted image, and its s.d. (N,)."""
        solution = self.plane_map.solution
        precision = solution.precision()
        return solution.dual / precision[:, None] / self.spacing_mm, 1 / np.sqrt(precision) / self.spacing_mm

    @cached_property
    def row_correlations(self) -> list[float]:
        """Correlation of neighbours' leave-one-out residuals along the rows of three directions."""
        off_px, place = self.leave_one_out[0], {(i, j): k for k, (i, j) in enumerate(self.index.tolist())}
        unit, values = int(np.gcd.reduce(self.index.ravel())), []
        for di, dj in unit * np.array(_ROWS):
            pairs = [(k, place[i + di, j + dj]) for (i, j), k in place.items() if (i + di, j + dj) in place]
            one, following = off_px[np.array(pairs, dtype=int).reshape(-1, 2).T]
            values.append(float((one * following).sum() / max(np.linalg.norm(one) * np.linalg.norm(following), 1e-300)))
        return values

    @property
    def row_error_px(self) -> float:
        """Standard deviation of what the points of a row have in common, px."""
        return float(np.sqrt(max(0.0, *self.row_correlations) * np.square(self.leave_one_out[0]).mean()))

    @cached_property
    def _row_factor(self) -> float:
        """By how much errors that rows have in common enlarge the map's: from the maps of every second row."""
        factor, at = 1.0, self.uv_px[:: 1 + len(self.uv_px) // _SAMPLES**2]
        for (di, dj), correlation in zip(_ROWS, self.row_correlations, strict=True):
            if correlation > _CORRELATED:
                row = self.index @ [-dj, di] // np.gcd.reduce(self.index.ravel())
                halves = [
                    FittedSmoothMap.fit(self.uv_px[row % 2 == k], self.spacing_mm * self.ideal_px[row % 2 == k], None)
                    for k in (0, 1)
                ]
                apart_px = (halves[0].to_plane(at) - halves[1].to_plane(at)) / self.spacing_mm
                independent_px2 = np.square(self._independent_sd_px(at)).mean()
                factor = max(factor, float(np.sqrt(np.square(apart_px / 2).mean() / independent_px2)))
        return factor

    def document(self) -> dict[str, Any]:
        """Return the results as JSON types; the error over an even grid of the pixels that the map covers."""
        grid = np.stack(np.meshgrid(*(np.linspace(0, n - 1, _SAMPLES) for n in self.shape[::-1])), axis=-1)
        covered = grid.reshape(-1, 2)[self.covers(grid.reshape(-1, 2))]
        sd_px = self.sd_px(covered)
        return {
            "pattern": "hexagonal" if self.hexagonal else "square",
            "kind": self.kind,
            "points": len(self.uv_px),
            "left_out": self.left_out,
            "spacing_mm": self.spacing_mm,
            "largest_distortion_px": float(np.linalg.norm(self.ideal_px - self.uv_px, axis=1).max()),
            "leave_one_out_rms_px": float(np.sqrt(np.square(self.leave_one_out[0]).mean())),
            "row_error_px": self.row_error_px,
            "sd_rms_px": float(np.sqrt(np.square(sd_px).mean())),
            "sd_max_px": float(sd_px.max()),
            "covered": len(covered) / _SAMPLES**2,
        }

    def sources(self) -> np.ndarray:
        """Return (H, W, 2), float32: the pixel of the original that each pixel of the undistorted image comes from.

        Far outside of the image where the map does not cover it.
        """
        axes = [np.linspace(0.0, n - 1, 2 + n // _NODE_PX) for n in self.shape]
        nodes = np.stack(np.meshgrid(*axes[::-1]), axis=-1).reshape(-1, 2)
        uv = nodes.copy()  # where the map ends, far from what it covers
        found, exists = self.plane_map.find_image(self.spacing_mm * nodes)
        uv[exists] = found
        uv = uv.reshape(*(len(axis) for axis in axes), 2)
        v, u = (np.arange(n) for n in self.shape)
        splines = (RectBivariateSpline(axes[0], axes[1], uv[..., k], kx=1, ky=1) for k in (0, 1))
        dense = np.stack([spline(v, u) for spline in splines], axis=-1)
        dense[~self.covers(dense.reshape(-1, 2)).reshape(self.shape)] = _FAR_PX
        return dense.astype(np.float32)

    def summary(self) -> str:
        """Return pattern, number of points and error."""
        known = self.document()
        return (
            f"GridMap: {known['points']} points, {known['pattern']}, {self.pitch_mm:g} mm\n"
            f"  error {known['sd_rms_px']:.3f} px rms, at most {known['sd_max_px']:.3f} px, 1 px is "
            f"{self.spacing_mm:.4f} mm"
        )

    def _draw(self, ax: Any) -> None:
        from sightline.common import draw

        off_px, _ = self.leave_one_out
        draw.image(ax, self.pixels, self.shape, self.uv_px, "")
        draw.marks(ax, self.uv_px, ".", draw.ORANGE, f"{self.kind}s ({len(self.uv_px)})")
        times = draw.arrows(ax, self.uv_px, off_px, self.spacing_mm, draw.BLUE)
        ax.set_title(f"leave-one-out residuals, {times:g} times as large", loc="left", fontsize="medium")
        draw.legend(ax)


def map_grid(beads: Detections, pitch_mm: float) -> GridMap:
    """Return the distortion map of an image of a sheet whose nearest balls or holes are `pitch_mm` apart.

    `beads`: the image's balls or holes, as `detect` finds them. Raises UnusableInputError, DetectionRefusedError and
    CalibrationRefusedError.
    """
    if not 0 < pitch_mm < np.inf:
        raise UnusableInputError(f"the pitch is {pitch_mm:g} mm; give the distance of nearest balls or holes, mm")
    lattice = lattice_of_sheet(beads.uv_px)
    if len(lattice) < MIN_POINTS:
        raise CalibrationRefusedError(
            f"the sheet shows {len(lattice)} points; at least {MIN_POINTS} are needed: use a finer sheet, or show more"
        )
    _refuse_stretched(lattice)
    _refuse_two_sheets(lattice)
    # Of a fine sheet every second row and column, or third, ...
    step = next(k for k in range(1, len(lattice)) if (lattice.index % k == 0).all(axis=1).sum() <= MAX_CONTROLS)
    sd_px = np.sqrt(np.trace(beads.covariance_px2[lattice.members], axis1=1, axis2=2))
    kept = np.flatnonzero((lattice.index % step == 0).all(axis=1) & (sd_px < MAX_SD * np.median(sd_px)))
    fixed = lattice.axes is HEXAGONAL, float(pitch_mm), beads.image_shape, "hole" if "hole" in beads.kind else "ball"
    off_px, off_sd_px = GridMap(lattice.uv_px[kept], lattice.index[kept], *fixed).leave_one_out
    good = np.square(off_px / off_sd_px[:, None]).sum(axis=1) < -2 * np.log(FALSE_ALARM)
    bad, kept = int((~good).sum()), kept[good]
    if bad > MAX_LEFT_OUT * len(good):
        raise CalibrationRefusedError(
            f"{bad} of {len(good)} points contradict the others (limit {MAX_LEFT_OUT:.0%}); show a flat sheet alone, "
            "with even holes or balls, and nothing before it"
        )
    grid = GridMap(lattice.uv_px[kept], lattice.index[kept], *fixed, bad, beads.pixels)
    if grid.row_error_px > MAX_ROW_ERROR_PX:
        raise CalibrationRefusedError(
            f"the points of a row have a common error of {grid.row_error_px:.2f} px (limit {MAX_ROW_ERROR_PX:g} px): "
            "rows of the sheet are shifted, or it is bent sharply; use a whole, flat sheet"
        )
    return grid


def _refuse_stretched(lattice: Lattice) -> None:
    off, off_px = (at - at.mean(axis=0) for at in (lattice.xy, lattice.uv_px))
    long, short = np.linalg.svd(np.linalg.lstsq(off, off_px, rcond=None)[0], compute_uv=False)
    if long > MAX_STRETCH * short:
        raise CalibrationRefusedError(
            f"the lattice is stretched by a factor of {long / short:.3f} along one direction (limit {MAX_STRETCH:g}): "
            "use a square or hexagonal sheet, lay it flat on the intensifier's face, and give an image with square "
            "pixels"
        )


def _refuse_two_sheets(lattice: Lattice) -> None:
    """Refuse a lattice whose every second point along each axis has another size or rotation than the others."""
    off = lattice.index - lattice.index.mean(axis=0)
    at = off / np.abs(off).max()
    linear = monomials(at, 1) * (1 - 2 * (lattice.index.sum(axis=1, keepdims=True) % 2))
    terms = np.hstack([monomials(at, 5), linear])
    found = np.linalg.lstsq(terms, lattice.uv_px, rcond=None)[0]
    apart_px, left_px = np.sqrt(
        [np.square(2 * linear[:, 1:] @ found[-2:]).mean(), np.square(lattice.uv_px - terms @ found).mean()]
    )
    if apart_px > max(MAX_APART_PX, _APART_SD * 4 * left_px / np.sqrt(len(at))):
        raise CalibrationRefusedError(
            f"every second point has another scale or rotation, {apart_px:.2f} px rms (limit {MAX_APART_PX:g} px): two "
            "sheets lie on each other, shifted by half a pitch; show one sheet alone"
        )


class Undistorter:
    """Resampling by a grid map's `sources`: `undistorter(pixels, white)` returns an image of the same size and type."""

    def __init__(self, grid: GridMap) -> None:
        self._shape, uv = grid.shape, grid.sources()
        self._maps = cv2.convertMaps(uv[..., 0], uv[..., 1], cv2.CV_16SC2)

    def __call__(self, pixels: np.ndarray, white: float) -> np.ndarray:
        """Return the pixels (H, W), 0 where the map does not cover them; `white`: the largest value of the original's.

        Raises UnusableInputError for another size than that of the sheet's image.
        """
        if pixels.shape != self._shape:
            (height, width), (rows, columns) = pixels.shape, self._shape
            raise UnusableInputError(
                f"an image has {width} x {height} pixels, the map is of {columns} x {rows}; take the sheet's image "
                "with the settings of the run"
            )
        resampled = cv2.remap(pixels, *self._maps, cv2.INTER_CUBIC)
        return np.clip(resampled, 0, pixels.dtype.type(white), out=resampled)  # a cubic overshoots at edges
