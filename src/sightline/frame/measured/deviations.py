"""Deviations of a measured frame from its nominal one, by ball and by body: plates, or a solid."""

from dataclasses import dataclass

import numpy as np

from sightline.common.geometry.rigid import displacement
from sightline.frame.model import Frame
from sightline.frame.plate import Plate, RigidBody

# [ours] prior s.d., mm, of a rigid motion of the whole frame, which is not an error of a plate.
WHOLE_FRAME_MM = 10.0


@dataclass(frozen=True, eq=False)
class Completed:
    """All M balls of a frame: `moved_mm` (M, 3), displacements from nominal; `covariance_mm2` (3M, 3M) of these.

    `sigma` (N,): distance of each measured ball from its prediction by all others and the tolerances, in standard
    deviations.
    """

    moved_mm: np.ndarray
    covariance_mm2: np.ndarray
    sigma: np.ndarray


def complete(frame: Frame, rows: np.ndarray, moved_mm: np.ndarray, covariance_mm2: np.ndarray) -> Completed:
    """Return all balls, from `moved_mm` (N, 3) of the measured balls `rows` (N,) and its covariance (3N, 3N).

    Measured balls keep their measured places. The others are predicted from these and the frame's tolerances.
    """
    all_xyz = frame.xyz_mm
    centred = all_xyz - all_xyz.mean(axis=0)
    whole = displacement(centred).reshape(-1, 6) * WHOLE_FRAME_MM
    whole[:, :3] /= np.linalg.norm(centred, axis=1).mean()
    tolerance = np.hstack([frame.error_factor, whole])
    seen = (3 * rows[:, None] + np.arange(3)).ravel()
    unseen = np.setdiff1d(np.arange(len(tolerance)), seen)
    own, others = tolerance[seen], tolerance[unseen]
    precision = np.linalg.inv(own @ own.T + covariance_mm2)
    pull = (precision @ moved_mm.ravel()).reshape(-1, 3)
    n = len(rows)
    blocks = precision.reshape(n, 3, n, 3)[range(n), :, range(n), :]
    sigma = np.sqrt(np.einsum("na,na->n", pull, np.linalg.solve(blocks, pull[..., None])[..., 0]))
    gain = others @ own.T @ precision
    out, error = np.zeros(len(tolerance)), np.zeros((len(tolerance), len(tolerance)))
    out[seen], out[unseen] = moved_mm.ravel(), gain @ moved_mm.ravel()
    error[np.ix_(seen, seen)] = covariance_mm2
    error[np.ix_(unseen, seen)] = gain @ covariance_mm2
    error[np.ix_(seen, unseen)] = error[np.ix_(unseen, seen)].T
    error[np.ix_(unseen, unseen)] = others @ others.T - gain @ own @ others.T
    return Completed(out.reshape(-1, 3), (error + error.T) / 2, sigma)


@dataclass(frozen=True, eq=False)
class PlateDeviation:
    """Deviations of one plate from the frame file: motion as a whole (CFCS), expansion about its mean, balls within it.

    `in_plane_rms_mm`, `across_rms_mm`: deviations of the balls per axis from the moved and expanded plate, including
    the instrument's error, `instrument_mm` per axis. Of a solid `in_plane_rms_mm` has all three axes, and
    `across_rms_mm` is None.
    """

    view: str
    plate: str
    measured: int
    shift_mm: np.ndarray
    turn_rad: np.ndarray
    growth_ppm: float
    in_plane_rms_mm: float
    across_rms_mm: float | None
    instrument_mm: float

    @property
    def manufacturing_mm(self) -> float:
        """S.d. per axis of the bores in the plate, the instrument's noise subtracted."""
        return float(np.sqrt(max(0.0, self.in_plane_rms_mm**2 - self.instrument_mm**2)))


def plate_deviations(
    frame: Frame, rows: np.ndarray, moved_mm: np.ndarray, covariance_mm2: np.ndarray
) -> tuple[PlateDeviation, ...]:
    """Return the deviations of each plate, or of the solid; arguments as for `complete`."""
    variances = np.diag(covariance_mm2).reshape(-1, 3)
    out, start = [], 0
    for view, role, body in bodies(frame):
        own = (rows >= start) & (rows < start + len(body.ids))
        out.append(_deviation(view, role, body, rows[own] - start, moved_mm[own], variances[own]))
        start += len(body.ids)
    return tuple(out)


def _deviation(  # noqa: PLR0917
    view: str, role: str, body: RigidBody, rows: np.ndarray, moved: np.ndarray, variances: np.ndarray
) -> PlateDeviation:
    flat = isinstance(body, Plate)
    xyz = body.xyz_mm[rows]
    centred = xyz - body.xyz_mm.mean(axis=0)
    design = np.hstack([displacement(centred).reshape(-1, 6), centred.reshape(-1, 1)])
    parameters = np.linalg.lstsq(design, moved.ravel(), rcond=None)[0]
    residual = moved - (design @ parameters).reshape(-1, 3)
    free = 1 - len(parameters) / moved.size
    return PlateDeviation(
        view=view,
        plate=role,
        measured=len(rows),
        shift_mm=parameters[3:6],
        turn_rad=parameters[:3],
        growth_ppm=float(1e6 * parameters[6]),
        in_plane_rms_mm=float(np.sqrt(np.mean((residual @ body.plane.axes.T if flat else residual) ** 2) / free)),
        across_rms_mm=float(np.sqrt(np.mean((residual @ body.plane.normal) ** 2) / free)) if flat else None,
        instrument_mm=float(np.sqrt(variances.mean())),
    )


def bodies(frame: Frame) -> tuple[tuple[str, str, RigidBody], ...]:
    """Return (view, role, plate) of each plate, or ("solid", "", solid) and that on the detector, in the order of the
    frame's covariance."""
    if frame.solid is None:
        return frame.named_plates
    return tuple(zip(("solid", "detector"), ("", "plate"), frame.bodies, strict=False))
