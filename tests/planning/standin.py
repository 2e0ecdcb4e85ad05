"""A calibrated view whose every error is known: a cubic plane map with stated parameter covariance."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.spatial.transform import Rotation

from sightline.calibration.view import LinesOfSight
from sightline.common.checks import Check
from sightline.common.geometry.planes import Plane
from sightline.errors import OutsideRegionError

CENTRE_PX = 512.0
SCALE_PX = 512.0
LIMIT_PX = 500.0
HULL_PX = 300.0


OF_U, OF_V = np.array([(a, b) for a in range(4) for b in range(4 - a)]).T  # powers of the cubic monomials


def _powers(uv_px: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The powers 0 to 3 of scaled u and v, (N, 4) each."""
    u, v = ((np.asarray(uv_px) - CENTRE_PX) / SCALE_PX).T[..., None] ** np.arange(4)
    return u, v


def _basis(uv_px: np.ndarray) -> np.ndarray:
    """(N, 10) cubic monomials of scaled pixels, and their derivatives (N, 2, 10) per pixel."""
    u, v = _powers(uv_px)
    return u[:, OF_U] * v[:, OF_V]


def _slope(uv_px: np.ndarray) -> np.ndarray:
    u, v = _powers(uv_px)
    by_u, by_v = OF_U * u[:, np.maximum(OF_U - 1, 0)] * v[:, OF_V], OF_V * u[:, OF_U] * v[:, np.maximum(OF_V - 1, 0)]
    return np.stack([by_u, by_v], axis=1) / SCALE_PX


@dataclass(frozen=True, eq=False)
class StandInView:
    """Parameters p = (F, 10 coefficients of x, 10 of y); `factors[source]` (23, K): errors of p, per source."""

    name: str
    plane: Plane
    focal_point_mm: np.ndarray
    coefficients: np.ndarray
    factors: dict[str, np.ndarray] | None
    frame_key: str | None = "test frame/1"
    checks: tuple[Check, ...] = field(default=())
    method: str = "smooth"

    def to_plane(self, uv_px: np.ndarray) -> np.ndarray:
        return _basis(uv_px) @ self.coefficients.T

    def jacobian(self, uv_px: np.ndarray) -> np.ndarray:
        return np.einsum("ikp,cp->ick", _slope(uv_px), self.coefficients)

    def to_image(self, xy_mm: np.ndarray) -> np.ndarray:
        uv = np.full_like(xy_mm, CENTRE_PX)
        for _ in range(6):
            uv = uv + np.linalg.solve(self.jacobian(uv), (xy_mm - self.to_plane(uv))[..., None])[..., 0]
        return uv

    def project(self, xyz_mm: np.ndarray) -> np.ndarray:
        uv = self.to_image(self.plane.central_projection(self.focal_point_mm, xyz_mm))
        return self._within(uv)

    def project_seen(self, xyz_mm: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        xy, seen = self.plane.shadows(self.focal_point_mm, xyz_mm)
        uv = self.to_image(xy)
        inside = np.linalg.norm(uv - CENTRE_PX, axis=-1) < LIMIT_PX
        seen[seen] = inside
        return uv[inside], seen

    def _within(self, uv_px: np.ndarray) -> np.ndarray:
        if not (np.linalg.norm(uv_px - CENTRE_PX, axis=-1) < LIMIT_PX).all():
            raise OutsideRegionError(f"view {self.name!r}: a point lies outside the calibrated region")
        return uv_px

    def response(self, uv_px: np.ndarray) -> np.ndarray:
        """(3 + 2N, 23): derivative of the lines of sight by p."""
        out = np.zeros((3 + 2 * len(uv_px), 23))
        out[:3, :3] = np.eye(3)
        out[3::2, 3:13] = out[4::2, 13:] = _basis(uv_px)
        return out

    def lines_of_sight(self, uv_px: np.ndarray) -> LinesOfSight:
        uv = self._within(np.asarray(uv_px, dtype=np.float64))
        response = self.response(uv)
        covariance, shared = None, {}
        if self.factors is not None:
            covariance = {s: response @ f @ f.T @ response.T for s, f in self.factors.items()}
            shared = {"frame": response @ self.factors["frame"]}
        return LinesOfSight(
            view=self.name,
            plane=self.plane,
            focal_point_mm=self.focal_point_mm,
            xy_mm=self.to_plane(uv),
            jacobian=self.jacobian(uv),
            covariance=covariance,
            shared=shared,
            frame_key=self.frame_key,
            inside_hull=np.linalg.norm(uv - CENTRE_PX, axis=-1) < HULL_PX,
        )

    def erring(self, errors: dict[str, np.ndarray]) -> "StandInView":
        """The estimate of this view that independent unit-variance errors lead to."""
        assert self.factors is not None
        step = sum((self.factors[s] @ e for s, e in errors.items()), np.zeros(23))
        return replace(
            self,
            focal_point_mm=self.focal_point_mm + step[:3],
            coefficients=self.coefficients + step[3:].reshape(2, 10),
        )

    def draw_errors(self, rng: np.random.Generator) -> dict[str, np.ndarray]:
        assert self.factors is not None
        return {s: rng.standard_normal(f.shape[1]) for s, f in self.factors.items()}


def stand_in(name: str, turn_rad: float = 0.0, scale: float = 1.0, seed: int = 5) -> StandInView:
    """A Γ view ("pa" along Z, "lateral" along X) with pincushion, its image rotated by `turn_rad`.

    Errors about those of a frame with 0.05 mm tolerances, times `scale`.
    """
    rng = np.random.default_rng(seed + len(name))
    normal = {"pa": 2, "lateral": 0}[name]
    others = [a for a in range(3) if a != normal]
    axes = np.eye(3)[others]
    origin = 300.0 * np.eye(3)[normal]
    turn = np.array([[np.cos(turn_rad), -np.sin(turn_rad)], [np.sin(turn_rad), np.cos(turn_rad)]])
    coefficients = np.zeros((2, 10))
    for k, (a, b) in enumerate(zip(OF_U, OF_V, strict=True)):
        if a + b == 1:
            coefficients[:, k] = 110.0 * turn[:, b]
        if a + b == 3:  # pincushion: -6 % of (u, v) (u² + v²), and something without symmetry
            coefficients[:, k] = -6.6 * turn[:, b % 2] + rng.normal(0.0, 0.8, 2)
    factors = {}
    for source, focal_mm, map_mm in (
        ("beads", 0.5, 0.02),
        ("map", 0.2, 0.02),
        ("focal_point", 0.5, 0.0),
        ("frame", 1.0, 0.05),
    ):
        columns = 30 if source == "frame" else 23
        sd = np.r_[np.full(3, focal_mm), np.full(20, map_mm)]
        sd[normal] *= 5.0
        factors[source] = scale * sd[:, None] * rng.normal(size=(23, columns)) / np.sqrt(columns)
    focal = -620.0 * np.eye(3)[normal] + np.array([7.0, -4.0, 3.0])
    return StandInView(name, Plane(origin, axes), focal, coefficients, factors)


def pair(scale: float = 0.3) -> list[StandInView]:
    """PA and lateral view."""
    return [stand_in("pa", 0.4, scale), stand_in("lateral", -0.2, scale)]


def estimates(views: Sequence[StandInView], rng: np.random.Generator) -> list[StandInView]:
    """Views as they would be estimated: the frame's errors are the same numbers in all."""
    drawn = [view.draw_errors(rng) for view in views]
    return [view.erring(errors | {"frame": drawn[0]["frame"]}) for view, errors in zip(views, drawn, strict=True)]


def turned(view: StandInView, axis: str, degrees: float, name: str) -> StandInView:
    """The same view with source and detector rotated about an axis of CFCS through the origin."""
    rotation = Rotation.from_euler(axis, degrees, degrees=True).as_matrix()
    assert view.factors is not None
    return replace(
        view,
        name=name,
        plane=Plane(rotation @ view.plane.origin_mm, view.plane.axes @ rotation.T),
        focal_point_mm=rotation @ view.focal_point_mm,
        factors={s: np.vstack([rotation @ f[:3], f[3:]]) for s, f in view.factors.items()},
    )


ENTRY_MM, END_MM = np.array([31.0, 24.0, -9.0]), np.array([-22.0, -26.0, 11.0])


def wire_px(views: list[StandInView]) -> np.ndarray:
    """(2, 2, 2): pixels of a wire from ENTRY_MM to END_MM in both views."""
    return np.array([view.project(np.stack([ENTRY_MM, END_MM])) for view in views])
