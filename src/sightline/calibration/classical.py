"""The paper's chain (sections 4.3 and 4.4): a map for each plate, then the focal point from lines through both.

Its errors: beads' noise and frame errors are carried through the same linear algebra. What the maps themselves get
wrong is seen where they differ from the smooth fit of both plates by more than the beads' noise: that variance, about
each line of sight, correlated over `MISFIT_REACH` of the region. Where beads are too few for the smooth fit, it is
judged by leave-one-out residuals, and too large: a bead that is left out leaves a gap twice as wide as those between
beads. The check "map misfit" says which.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np

from sightline.calibration.beads import Beads
from sightline.calibration.focal_point import focal_point, focal_point_response
from sightline.calibration.hull import Hull
from sightline.calibration.joint import JointFit
from sightline.calibration.posterior import LineErrors
from sightline.calibration.projection import Pencil, refuse_misplaced
from sightline.calibration.residuals import Residuals
from sightline.calibration.view import PlaneMap
from sightline.errors import CalibrationRefusedError, OutsideRegionError
from sightline.geometry.planes import Plane

PlateName = Literal["xrii", "source"]
# Length of correlation of a map's misfit, in hull radii [ours]: about three spacings of 7 x 7 beads.
MISFIT_REACH = 0.5
PROBES = 12  # a side, of the square about a plate's hull where its map is compared with the smooth one [ours]


class LinearMap(PlaneMap, Protocol):
    """A plane map that is linear in its controls' coordinates."""

    def weights(self, uv_px: np.ndarray) -> np.ndarray:
        """(N, controls): to_plane(uv) = weights @ the controls' coordinates."""
        ...


Fitter = Callable[[np.ndarray, np.ndarray], LinearMap]


@dataclass(frozen=True, eq=False)
class PlateFit:
    """The map of one plate, with its beads. `leave_one_out_mm` (N, 2), rows where `predicted` is False do not hold."""

    plane: Plane
    beads: Beads
    map: LinearMap
    hull: Hull
    leave_one_out_mm: np.ndarray
    predicted: np.ndarray
    noise_mm2: np.ndarray
    probes: "Probes | None"

    @staticmethod
    def of(plane: Plane, beads: Beads, fit: Fitter, noise_px: float | None, joint: JointFit | None) -> "PlateFit":
        """`noise_px` replaces the covariance that the beads lack. `joint`: the smooth fit of both plates, if any."""
        xy = plane.to_plane(beads.xyz_mm)
        plane_map = fit(beads.uv_px, xy)
        error, predicted = np.zeros_like(xy), np.zeros(len(xy), dtype=bool)
        for k in range(len(xy)):
            others = np.arange(len(xy)) != k
            try:
                error[k] = fit(beads.uv_px[others], xy[others]).to_plane(beads.uv_px[k : k + 1])[0] - xy[k]
                predicted[k] = True
            except (OutsideRegionError, CalibrationRefusedError):
                pass  # a corner bead: nothing bounds it once it is gone
        slopes = plane_map.jacobian(_inward(beads.uv_px))
        covariance = (
            beads.covariance_px2 if noise_px is None else np.broadcast_to(noise_px**2 * np.eye(2), slopes.shape)
        )
        assert covariance is not None  # noqa: S101 - the caller states noise_px where the beads lack it
        noise = slopes @ covariance @ np.swapaxes(slopes, 1, 2)
        hull = Hull.of(beads.uv_px)
        probes = None if joint is None else Probes.of(plane, plane_map, noise, hull, joint)
        return PlateFit(plane, beads, plane_map, hull, error, predicted, noise, probes)

    @property
    def misfit_mm2(self) -> float:
        """Variance per axis, in the mean over the plate, of what the map gets wrong beyond the noise."""
        if self.probes is not None:
            return float(self.probes.misfit_mm2.mean())
        seen = self.leave_one_out_mm[self.predicted]
        noise = 0.5 * float(np.trace(self.noise_mm2.mean(axis=0)))
        return max(float(np.mean(seen**2)) - 1.5 * noise, 0.0) if len(seen) else 0.0

    def misfit(self, a_px: np.ndarray, b_px: np.ndarray) -> np.ndarray:
        """(2N, 2M) covariance of the map's misfit at pixels (N, 2) and (M, 2)."""
        alike = np.exp(-0.5 * self._apart2(a_px, b_px))
        return np.kron(self._misfit_sd(a_px)[:, None] * alike * self._misfit_sd(b_px), np.eye(2))

    def _misfit_sd(self, uv_px: np.ndarray) -> np.ndarray:
        """(N,) mm per axis, at pixels (N, 2): of the probes about each."""
        if self.probes is None:
            return np.full(len(uv_px), np.sqrt(self.misfit_mm2))
        weights = np.exp(-0.5 * self._apart2(uv_px, self.probes.uv_px))
        return np.sqrt(weights @ self.probes.misfit_mm2 / weights.sum(axis=1))

    def _apart2(self, a_px: np.ndarray, b_px: np.ndarray) -> np.ndarray:
        """(N, M) squared distances of pixels, in lengths of correlation."""
        gap = (a_px[:, None] - b_px[None]) / (MISFIT_REACH * self.hull.radius_px)
        return (gap**2).sum(axis=-1)


@dataclass(frozen=True, eq=False)
class Probes:
    """Pixels `uv_px` (M, 2) all over a plate's hull, and what the plate's map gets wrong there: `misfit_mm2` (M,),
    variance per axis beyond the noise, by the smooth fit of both plates."""

    uv_px: np.ndarray
    misfit_mm2: np.ndarray

    @staticmethod
    def of(plane: Plane, plane_map: LinearMap, noise_mm2: np.ndarray, hull: Hull, joint: JointFit) -> "Probes | None":
        """None where the map is defined at none of them.

        Given the beads, the map's squared error is that of its difference from the smooth one, and the variance that
        this states of itself; what the beads' noise takes of it is counted by the map's own weights already.
        """
        low, high = hull.corners_px.min(axis=0), hull.corners_px.max(axis=0)
        sides = [np.linspace(a, b, PROBES + 2)[1:-1] for a, b in zip(low, high, strict=True)]
        grid = np.stack(np.meshgrid(*sides), axis=-1).reshape(-1, 2)
        uv = grid[_defined(plane_map, hull, grid)]
        if not len(uv):
            return None
        own = np.trace(noise_mm2, axis1=1, axis2=2) / 2
        noise = plane_map.weights(uv) ** 2 @ own
        errors = joint.line_errors(uv)
        smooth = (errors.noise + errors.misfit).diagonal()[3:].reshape(-1, 2).mean(axis=1)
        seen = joint.beads.plane.to_space(joint.map.to_plane(uv))
        off = plane_map.to_plane(uv) - plane.central_projection(joint.pencil.focal_point_mm, seen)
        return Probes(uv, np.maximum((off**2).mean(axis=1) + smooth - noise, 0.0))


def _inward(uv_px: np.ndarray) -> np.ndarray:
    """The beads moved a little towards their middle, so that those of the hull lie within a triangle."""
    return uv_px + 1e-3 * (uv_px.mean(axis=0) - uv_px)


@dataclass(frozen=True, eq=False)
class ClassicalFit:
    """Maps of both plates and the focal point; lines of sight go through the plate called `through`."""

    xrii: PlateFit
    source: PlateFit
    through: PlateName
    focal_point_mm: np.ndarray
    lines: np.ndarray
    from_mm: np.ndarray
    to_mm: np.ndarray

    @property
    def plate(self) -> PlateFit:
        """The plate that lines of sight go through; its plane is the reference plane."""
        return self.xrii if self.through == "xrii" else self.source

    def line_errors(self, uv_px: np.ndarray) -> LineErrors:
        """Errors of focal point and lines of sight of pixels (N, 2). Raises OutsideRegionError."""
        beads = [self.xrii.beads, self.source.beads]
        sizes = [len(b) for b in beads]
        at_lines = self.xrii.beads.uv_px[self.lines]
        by_from, by_to = focal_point_response(self.from_mm, self.to_mm, self.focal_point_mm)
        in_source = self.source.plane.axes
        to_plane2 = np.einsum("nij,kj->nik", by_to, in_source)  # F by the source plane's coordinates (L, 3, 2)
        n = len(uv_px)
        # Displacements, on its plate, of what each bead teaches (sum(sizes), 2): all errors come through these.
        taught = np.zeros((3 + 2 * n, sum(sizes), 2))
        taught[:3, sizes[0] :] = np.einsum("lik,lb->ibk", to_plane2, self.source.map.weights(at_lines))
        own = self.plate.map.weights(uv_px)
        first = 0 if self.through == "xrii" else sizes[0]
        block = taught[3:].reshape(n, 2, sum(sizes), 2)
        for axis in range(2):
            block[:, axis, first : first + own.shape[1], axis] += own
        seen = np.zeros((3 + 2 * n, sizes[0], 2))  # an XRII bead seen elsewhere sends its line elsewhere
        seen[:3, self.lines] = np.einsum("lik,lkj->ilj", to_plane2, self.source.map.jacobian(at_lines))
        return LineErrors(
            self._noise(taught, seen), self._misfit(to_plane2, at_lines, uv_px), self._frame(taught, by_from, sizes)
        )

    def _noise(self, taught: np.ndarray, seen: np.ndarray) -> np.ndarray:
        """A bead seen at u + du teaches the map what a bead displaced by -dh du would."""
        count = seen.shape[1]
        slopes = self.xrii.map.jacobian(_inward(self.xrii.beads.uv_px))
        by_plate = taught.copy()
        by_plate[:, :count] -= np.einsum("ilj,ljk->ilk", seen, np.linalg.inv(slopes))
        covariance = np.concatenate([self.xrii.noise_mm2, self.source.noise_mm2])
        return np.einsum("ilj,ljk,mlk->im", by_plate, covariance, by_plate, optimize=True)

    def _misfit(self, to_plane2: np.ndarray, at_lines: np.ndarray, uv_px: np.ndarray) -> np.ndarray:
        n = len(uv_px)
        to_focal = to_plane2.transpose(1, 0, 2).reshape(3, -1)
        out = np.zeros((3 + 2 * n, 3 + 2 * n))
        out[:3, :3] = to_focal @ self.source.misfit(at_lines, at_lines) @ to_focal.T
        out[3:, 3:] = self.plate.misfit(uv_px, uv_px)
        if self.through == "source":
            out[:3, 3:] = to_focal @ self.source.misfit(at_lines, uv_px)
            out[3:, :3] = out[:3, 3:].T
        return out

    def _frame(self, taught: np.ndarray, by_from: np.ndarray, sizes: list[int]) -> np.ndarray:
        """Beads displaced in space count by where their rays then meet the plate's plane."""
        on_plate = [
            Pencil.through(fit.plane, self.focal_point_mm).by_point(fit.beads.xyz_mm)
            for fit in (self.xrii, self.source)
        ]
        by_bead = np.einsum("ilk,lkj->ilj", taught, np.concatenate(on_plate))
        by_bead[:3, self.lines] += by_from.transpose(1, 0, 2)
        factor = np.concatenate([self.xrii.beads.frame_factor(), self.source.beads.frame_factor()])
        return -by_bead.reshape(len(taught), -1) @ factor


def fit_plates(
    beads: Beads, fit: Fitter, through: PlateName, noise_px: float | None, joint: JointFit | None
) -> ClassicalFit:
    """The chain for a method's map. `joint`: the smooth fit of the same beads, if any. Raises
    CalibrationRefusedError."""
    view = beads.frame.view(beads.view)
    xrii = PlateFit.of(view.xrii.plane, beads.where(beads.on_xrii), fit, noise_px, joint)
    source = PlateFit.of(view.source.plane, beads.where(~beads.on_xrii), fit, noise_px, joint)
    lines = np.flatnonzero(_mapped(source, xrii.beads.uv_px))
    from_mm = xrii.beads.xyz_mm[lines]
    to_mm = source.plane.to_space(source.map.to_plane(xrii.beads.uv_px[lines]))
    focal = focal_point(from_mm, to_mm)
    refuse_misplaced(Pencil.through(xrii.plane, focal), beads.xyz_mm)
    return ClassicalFit(xrii, source, through, focal, lines, from_mm, to_mm)


def _mapped(plate: PlateFit, uv_px: np.ndarray) -> np.ndarray:
    """(N,) bool: pixels inside the plate's hull, where its map interpolates."""
    return _defined(plate.map, plate.hull, uv_px)


def _defined(plane_map: PlaneMap, hull: Hull, uv_px: np.ndarray) -> np.ndarray:
    """(N,) bool: pixels inside a hull, where the map interpolates."""
    inside = hull.contains(uv_px)
    for k in np.flatnonzero(inside):
        try:
            plane_map.to_plane(uv_px[k : k + 1])
        except OutsideRegionError:
            inside[k] = False
    return inside


def classical_residuals(fit: ClassicalFit, given: Beads, used: np.ndarray) -> Residuals:
    """Of every bead given, on its own plate's plane; `used` (N,) tells which of them `fit` has."""
    residual, error, sigma = np.zeros((len(given), 2)), np.zeros((len(given), 2)), np.zeros(len(given))
    predicted = np.zeros(len(given), dtype=bool)
    for plate, on_plate in ((fit.xrii, given.on_xrii), (fit.source, ~given.on_xrii)):
        taught = on_plate & used
        residual[taught] = plate.map.to_plane(_inward(plate.beads.uv_px)) - plate.plane.to_plane(plate.beads.xyz_mm)
        error[taught], predicted[taught] = plate.leave_one_out_mm, plate.predicted
        others = np.flatnonzero(on_plate & ~used)
        predicted[others] = _mapped(plate, given.uv_px[others])
        others = others[predicted[others]]
        error[others] = plate.map.to_plane(given.uv_px[others]) - plate.plane.to_plane(given.xyz_mm[others])
        residual[others] = error[others]
        spread = 2 * plate.noise_mm2.mean(axis=0) + plate.misfit_mm2 * np.eye(2)
        mine = error[on_plate]
        sigma[on_plate] = np.sqrt(np.einsum("ia,ia->i", mine, np.linalg.solve(spread, mine.T).T))
    return Residuals(given.ids, given.uv_px, residual, error, predicted, sigma, used)
