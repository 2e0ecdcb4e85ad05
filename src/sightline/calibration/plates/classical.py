"""The paper's chain (sections 4.3 and 4.4): a map for each plate, then the focal point from lines through both.

The beads' noise and the frame's errors are propagated through the same linear algebra. The maps' own misfit is
estimated from their difference to the smooth fit of both plates beyond the beads' noise: its variance near each line of
sight, with the correlation length `MISFIT_LENGTH`. With too few beads for the smooth fit it is estimated from
leave-one-out residuals, which is too large, since leaving a bead out doubles the spacing there. The check "map misfit"
says which.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np

from sightline.calibration.maps.hull import Hull
from sightline.calibration.plates.beads import Beads
from sightline.calibration.plates.joint import JointFit
from sightline.calibration.view import LineErrors, Pencil, PlaneMap, Residuals, refuse_misplaced
from sightline.common.geometry.lines import meeting_point
from sightline.common.geometry.planes import Plane
from sightline.common.threads import one_blas_thread
from sightline.errors import CalibrationRefusedError, OutsideRegionError, ReconstructionRefusedError

PlateName = Literal["xrii", "source"]
# Correlation length of a map's misfit, in radii of the convex hull [ours]: about three spacings of 7 x 7 beads.
MISFIT_LENGTH = 0.5
PROBES = 12  # [ours] per side of the grid where a map is compared with the smooth one: nearly two between two beads
# The paper used 16 to 25 lines. Four lines leave five degrees of freedom, more than the three that are fitted [calc].
MIN_LINES = 4


class LinearMap(PlaneMap, Protocol):
    """A plane map that is linear in its controls' plane coordinates."""

    def weights(self, uv_px: np.ndarray) -> np.ndarray:
        """Return (N, controls): to_plane(uv) = weights @ the controls' plane coordinates."""
        ...


Fitter = Callable[[np.ndarray, np.ndarray], LinearMap]


@dataclass(frozen=True, eq=False)
class PlateFit:
    """The map of one plate, with its N beads.

    `leave_one_out_mm` (N, 2): valid where `predicted` (N,) is True; `noise_mm2` (N, 2, 2): the beads' noise on the
    plane; `probes`: comparison with the smooth fit, None without one.
    """

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
        """Return the fit of one plate's map.

        `noise_px`: replaces the beads' covariance where they have none. `joint`: the smooth fit of both plates, if any.
        """
        xy = plane.to_plane(beads.xyz_mm)
        plane_map = fit(beads.uv_px, xy)
        error, predicted = np.zeros_like(xy), np.zeros(len(xy), dtype=bool)
        for k in range(len(xy)):
            others = np.arange(len(xy)) != k
            try:
                error[k] = fit(beads.uv_px[others], xy[others]).to_plane(beads.uv_px[k : k + 1])[0] - xy[k]
                predicted[k] = True
            except (OutsideRegionError, CalibrationRefusedError):
                pass  # a corner bead: without it no triangle contains its pixel
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
        """Variance of the map's misfit per axis, averaged over the plate."""
        if self.probes is not None:
            return float(self.probes.misfit_mm2.mean())
        errors = self.leave_one_out_mm[self.predicted]
        noise = 0.5 * float(np.trace(self.noise_mm2.mean(axis=0)))
        return max(float(np.mean(errors**2)) - 1.5 * noise, 0.0) if len(errors) else 0.0

    def misfit(self, a_px: np.ndarray, b_px: np.ndarray) -> np.ndarray:
        """Return the covariance (2N, 2M), mm², of the map's misfit at pixels (N, 2) and (M, 2)."""
        correlation = np.exp(-0.5 * self._distance2(a_px, b_px))
        return np.kron(self._misfit_sd(a_px)[:, None] * correlation * self._misfit_sd(b_px), np.eye(2))

    def _misfit_sd(self, uv_px: np.ndarray) -> np.ndarray:
        """Return (N,), mm per axis, at pixels (N, 2): weighted mean over the probes near each."""
        if self.probes is None:
            return np.full(len(uv_px), np.sqrt(self.misfit_mm2))
        weights = np.exp(-0.5 * self._distance2(uv_px, self.probes.uv_px))
        return np.sqrt(weights @ self.probes.misfit_mm2 / weights.sum(axis=1))

    def _distance2(self, a_px: np.ndarray, b_px: np.ndarray) -> np.ndarray:
        """Return (N, M) squared distances of pixels, in correlation lengths."""
        difference = (a_px[:, None] - b_px[None]) / (MISFIT_LENGTH * self.hull.radius_px)
        return (difference**2).sum(axis=-1)


@dataclass(frozen=True, eq=False)
class Probes:
    """Pixels `uv_px` (M, 2) on a grid over a plate's convex hull, and the misfit of the plate's map there.

    `misfit_mm2` (M,): variance per axis beyond the noise, from the smooth fit of both plates.
    """

    uv_px: np.ndarray
    misfit_mm2: np.ndarray

    @staticmethod
    def of(plane: Plane, plane_map: LinearMap, noise_mm2: np.ndarray, hull: Hull, joint: JointFit) -> "Probes | None":
        """Return the probes of a plate's map; None where the map is defined at none of the grid's pixels.

        The map's mean squared error is its squared difference from the smooth map plus the variance of that; the beads'
        noise is subtracted, since the map's own weights already propagate it.
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
        difference = plane_map.to_plane(uv) - plane.central_projection(joint.pencil.focal_point_mm, seen)
        return Probes(uv, np.maximum((difference**2).mean(axis=1) + smooth - noise, 0.0))


def _inward(uv_px: np.ndarray) -> np.ndarray:
    """Return the pixels moved slightly towards their mean, so that those of the convex hull lie inside a triangle."""
    return uv_px + 1e-3 * (uv_px.mean(axis=0) - uv_px)


@dataclass(frozen=True, eq=False)
class ClassicalFit:
    """Maps of both plates and the focal point; lines of sight go through the plate called `through`.

    `lines` (L,): the XRII beads whose lines give the focal point, each from `from_mm` (L, 3) through `to_mm` (L, 3).
    """

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

    @one_blas_thread
    def line_errors(self, uv_px: np.ndarray) -> LineErrors:
        """Return the errors of focal point and lines of sight of pixels (N, 2). Raises OutsideRegionError."""
        beads = [self.xrii.beads, self.source.beads]
        sizes = [len(b) for b in beads]
        at_lines = self.xrii.beads.uv_px[self.lines]
        by_from, by_to = focal_point_response(self.from_mm, self.to_mm, self.focal_point_mm)
        in_source = self.source.plane.axes
        to_plane2 = np.einsum("nij,kj->nik", by_to, in_source)  # F by the source plane's coordinates (L, 3, 2)
        n = len(uv_px)
        # Derivatives by the beads' plane coordinates (sum(sizes), 2), through which all errors enter.
        by_control = np.zeros((3 + 2 * n, sum(sizes), 2))
        by_control[:3, sizes[0] :] = np.einsum("lik,lb->ibk", to_plane2, self.source.map.weights(at_lines))
        own = self.plate.map.weights(uv_px)
        first = 0 if self.through == "xrii" else sizes[0]
        block = by_control[3:].reshape(n, 2, sum(sizes), 2)
        for axis in range(2):
            block[:, axis, first : first + own.shape[1], axis] += own
        # The pixel of an XRII bead determines where its line meets the source plate.
        by_pixel = np.zeros((3 + 2 * n, sizes[0], 2))
        by_pixel[:3, self.lines] = np.einsum("lik,lkj->ilj", to_plane2, self.source.map.jacobian(at_lines))
        return LineErrors(
            self._noise(by_control, by_pixel),
            self._misfit(to_plane2, at_lines, uv_px),
            self._frame(by_control, by_from, sizes),
        )

    def _noise(self, by_control: np.ndarray, by_pixel: np.ndarray) -> np.ndarray:
        """Return the covariance by the beads' noise: a pixel error du acts on the map like a displacement by -dh du."""
        count = by_pixel.shape[1]
        slopes = self.xrii.map.jacobian(_inward(self.xrii.beads.uv_px))
        by_plate = by_control.copy()
        by_plate[:, :count] -= np.einsum("ilj,ljk->ilk", by_pixel, np.linalg.inv(slopes))
        covariance = np.concatenate([self.xrii.noise_mm2, self.source.noise_mm2])
        return np.einsum("ilj,ljk,mlk->im", by_plate, covariance, by_plate, optimize=True)

    def _misfit(self, to_plane2: np.ndarray, at_lines: np.ndarray, uv_px: np.ndarray) -> np.ndarray:
        n = len(uv_px)
        to_focal = to_plane2.transpose(1, 0, 2).reshape(3, -1)
        covariance = np.zeros((3 + 2 * n, 3 + 2 * n))
        covariance[:3, :3] = to_focal @ self.source.misfit(at_lines, at_lines) @ to_focal.T
        covariance[3:, 3:] = self.plate.misfit(uv_px, uv_px)
        if self.through == "source":
            covariance[:3, 3:] = to_focal @ self.source.misfit(at_lines, uv_px)
            covariance[3:, :3] = covariance[:3, 3:].T
        return covariance

    def _frame(self, by_control: np.ndarray, by_from: np.ndarray, sizes: list[int]) -> np.ndarray:
        """Return the response to the frame's errors: displaced beads act through their projections onto the plate."""
        on_plate = [
            Pencil.through(fit.plane, self.focal_point_mm).by_point(fit.beads.xyz_mm)
            for fit in (self.xrii, self.source)
        ]
        by_bead = np.einsum("ilk,lkj->ilj", by_control, np.concatenate(on_plate))
        by_bead[:3, self.lines] += by_from.transpose(1, 0, 2)
        factor = np.concatenate([self.xrii.beads.frame_factor(), self.source.beads.frame_factor()])
        return -by_bead.reshape(len(by_control), -1) @ factor


def fit_plates(
    beads: Beads, fit: Fitter, through: PlateName, noise_px: float | None, joint: JointFit | None
) -> ClassicalFit:
    """Return both plates' maps and the focal point. `joint`: the smooth fit of the same beads, if any.

    Raises CalibrationRefusedError.
    """
    view = beads.frame.view(beads.view)
    xrii = PlateFit.of(view.xrii.plane, beads.where(beads.on_xrii), fit, noise_px, joint)
    source = PlateFit.of(view.source.plane, beads.where(~beads.on_xrii), fit, noise_px, joint)
    lines = np.flatnonzero(_defined(source.map, source.hull, xrii.beads.uv_px))
    from_mm = xrii.beads.xyz_mm[lines]
    to_mm = source.plane.to_space(source.map.to_plane(xrii.beads.uv_px[lines]))
    focal = focal_point(from_mm, to_mm)
    refuse_misplaced(Pencil.through(xrii.plane, focal), beads.xyz_mm)
    return ClassicalFit(xrii, source, through, focal, lines, from_mm, to_mm)


def _defined(plane_map: PlaneMap, hull: Hull, uv_px: np.ndarray) -> np.ndarray:
    """Return (N,) bool: pixels inside a convex hull at which the map is defined."""
    inside = hull.contains(uv_px)
    for k in np.flatnonzero(inside):
        try:
            plane_map.to_plane(uv_px[k : k + 1])
        except OutsideRegionError:
            inside[k] = False
    return inside


def classical_residuals(fit: ClassicalFit, given: Beads, used: np.ndarray) -> Residuals:
    """Return the residuals of every bead given, on its own plate's plane; `used` (N,): the beads that `fit` used."""
    residual, error, sigma = np.zeros((len(given), 2)), np.zeros((len(given), 2)), np.zeros(len(given))
    predicted = np.zeros(len(given), dtype=bool)
    for plate, on_plate in ((fit.xrii, given.on_xrii), (fit.source, ~given.on_xrii)):
        fitted = on_plate & used
        residual[fitted] = plate.map.to_plane(_inward(plate.beads.uv_px)) - plate.plane.to_plane(plate.beads.xyz_mm)
        error[fitted], predicted[fitted] = plate.leave_one_out_mm, plate.predicted
        others = np.flatnonzero(on_plate & ~used)
        predicted[others] = _defined(plate.map, plate.hull, given.uv_px[others])
        others = others[predicted[others]]
        error[others] = plate.map.to_plane(given.uv_px[others]) - plate.plane.to_plane(given.xyz_mm[others])
        residual[others] = error[others]
        spread = 2 * plate.noise_mm2.mean(axis=0) + plate.misfit_mm2 * np.eye(2)
        mine = error[on_plate]
        sigma[on_plate] = np.sqrt(np.einsum("ia,ia->i", mine, np.linalg.solve(spread, mine.T).T))
    return Residuals(given.ids, given.uv_px, residual, error, predicted, sigma, used)


def focal_point(from_mm: np.ndarray, to_mm: np.ndarray) -> np.ndarray:
    """Return the least-squares intersection (3,) of lines through `from_mm` (N, 3) and `to_mm` (N, 3).

    Raises CalibrationRefusedError for too few or parallel lines.
    """
    if len(from_mm) < MIN_LINES:
        raise CalibrationRefusedError(
            f"only {len(from_mm)} lines of sight run through the beads of both plates (at least {MIN_LINES} are "
            "needed, 16 or more are good): move the frame so that the plates' images overlap"
        )
    try:
        return meeting_point(from_mm, to_mm - from_mm)
    except ReconstructionRefusedError as refused:
        raise CalibrationRefusedError(f"no focal point: {refused}") from refused


def focal_point_response(
    from_mm: np.ndarray, to_mm: np.ndarray, focal_point_mm: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the derivatives (N, 3, 3) of `focal_point` by `from_mm` and by `to_mm`, to first order in the distances.

    A line through A and B passes F at A + t (B - A); displacements a of A and b of B move it there by (1 - t) a + t b,
    of which only the component perpendicular to the line counts.
    """
    along = to_mm - from_mm
    length2 = np.einsum("ni,ni->n", along, along)
    across = np.eye(3) - along[:, :, None] * along[:, None, :] / length2[:, None, None]
    t = np.einsum("ni,ni->n", focal_point_mm - from_mm, along) / length2
    gain = np.linalg.solve(across.sum(axis=0), across)
    return (1 - t)[:, None, None] * gain, t[:, None, None] * gain
