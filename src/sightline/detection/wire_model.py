"""Model of a steel wire's shadow on a background, fitted to pixels near a path: piecewise across it, and at its tip.

A pixel lies at s along the path and x across it, px. Without blur, the light is B (1 - T S) + c S: background B, shadow
S of the chord (0 to 1), share T of the primary radiation that steel absorbs, scatter c in the shadow.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter, gaussian_filter1d, map_coordinates
from scipy.spatial import KDTree

# Attenuation of steel at 40, 50 and 60 keV, 1/mm [physics.md, C-arm], and the energies' shares behind 20 cm of hip,
# for a beam of 70 kVp with 45, 35 and 20 % before it [calc].
_PER_MM, _SHARE = np.array([3.03, 1.60, 1.01]), np.array([0.22, 0.39, 0.39])
# Of the primary radiation: 0.93-0.97 for 2.5 mm of steel; less gives scatter its own slope [twin, as for beads].
_ABSORBED = 0.9
_FINE = 0.05  # radii; step of the sharp profile
_CELL = 0.25  # px; step of the template of a tip
_RAY_MM = 0.05  # steps along a ray through it
_MAX_ITERATIONS = 12
_CONVERGED = 0.005  # px
_MIN_BLUR, _MAX_BLUR = 0.3, 0.7  # px; radii
BEND = 3  # degree of a wire's curve about the expected path, as in check_shot
# S.d. of a known bead's place about the one that its view predicts, px: frame, map and the bead's own error [twin].
_BEAD_SD_PX = 0.4
_MAX_WIDTH_RATIO = 1.7  # limit of the fitted over the expected radius, either way; beyond, the fit has lost the wire


@dataclass(frozen=True, eq=False)
class ImagePath:
    """A smooth line through an image in steps of about a pixel: points `uv_px` (M, 2), arc lengths `s_px` (M,)."""

    uv_px: np.ndarray
    s_px: np.ndarray

    @staticmethod
    def through(uv_px: np.ndarray) -> "ImagePath":
        """Return the path through points (M, 2)."""
        steps = np.hypot(*np.diff(uv_px, axis=0).T)
        return ImagePath(uv_px, np.append(0.0, np.cumsum(steps)))

    @property
    def tangents(self) -> np.ndarray:
        """(M, 2) unit vectors."""
        way = np.gradient(self.uv_px, axis=0)
        return way / np.linalg.norm(way, axis=1, keepdims=True)

    def at(self, s_px: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return points, unit tangents and unit normals (N, 2) at s (N,), extrapolated straight beyond the ends."""
        inside = np.clip(s_px, self.s_px[0], self.s_px[-1])
        both = np.hstack([self.uv_px, self.tangents])
        u, v, a, b = (np.interp(inside, self.s_px, column) for column in both.T)
        along = np.stack([a, b], axis=-1)
        along /= np.linalg.norm(along, axis=-1, keepdims=True)
        on = np.stack([u, v], axis=-1) + (s_px - inside)[..., None] * along
        return on, along, np.stack([-along[..., 1], along[..., 0]], axis=-1)

    def moved(self, across_px: np.ndarray) -> "ImagePath":
        """Return the path with its points moved by (M,) px along their normals."""
        along = self.tangents
        return ImagePath.through(self.uv_px + across_px[:, None] * np.stack([-along[:, 1], along[:, 0]], axis=-1))

    def places(self, uv_px: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return s and x (N,) of pixels (N, 2)."""
        nearest = np.asarray(KDTree(self.uv_px).query(uv_px)[1])
        off, along = uv_px - self.uv_px[nearest], self.tangents[nearest]
        return self.s_px[nearest] + (off * along).sum(1), off[:, 1] * along[:, 0] - off[:, 0] * along[:, 1]


@dataclass(frozen=True, eq=False)
class WireFit:
    """A least-squares fit of a wire's shadow.

    `values` (P,): the parameters; `influence` (P, N): their derivatives by each pixel's light, in units of its noise;
    `model` (N,): fitted light; `shadow`, `beside`: fitted light in the shadow and beside it. `by_prior` (P,): variance
    from what was known beforehand.
    """

    values: np.ndarray
    influence: np.ndarray
    model: np.ndarray
    shadow: float
    beside: float
    converged: bool
    by_prior: np.ndarray

    @property
    def contrast(self) -> float:
        """Change of log light in the shadow's middle; negative."""
        return float(np.log(max(self.shadow, 0.01 * abs(self.beside)) / abs(self.beside)))


@dataclass(frozen=True)
class SteelWire:
    """A steel wire: diameter, length of its conical point (0: plain), sine of its angle to the rays, scale along it."""

    diameter_mm: float
    point_mm: float
    sine: float
    px_per_mm: float

    @property
    def point_px(self) -> float:
        """Length of its point in the image."""
        return self.point_mm * self.px_per_mm

    @property
    def depth_mm(self) -> float:
        """Path length in steel of a ray through the axis."""
        return self.diameter_mm / self.sine


def profile(x_px: np.ndarray, wire: SteelWire, radius_px: float, blur_px: float) -> np.ndarray:
    """Return the blurred shadow (N,) of a wire at x; 1 is the middle of the sharp shadow."""
    reach = 1.0 + 5.0 * blur_px / radius_px
    rho = np.arange(-reach, reach + _FINE, _FINE)
    fine = rho[:, None] + _FINE * (np.arange(8) - 3.5) / 8  # averaged over cells, because the rim is steep
    sharp = _absorbed(wire.depth_mm * np.sqrt(np.clip(1 - fine**2, 0.0, None))).mean(axis=1)
    blurred = gaussian_filter1d(sharp, blur_px / radius_px / _FINE, mode="constant")
    return np.interp(x_px / radius_px, rho, blurred / _absorbed(np.array(wire.depth_mm)))


def _absorbed(chord_mm: np.ndarray) -> np.ndarray:
    """Return the share of the primary radiation that steel absorbs."""
    absorbed = np.zeros(chord_mm.shape)
    for mu, share in zip(_PER_MM, _SHARE, strict=True):
        absorbed += share * (1 - np.exp(-mu * chord_mm))
    return absorbed


def fit_across(  # noqa: PLR0917
    s_px: np.ndarray,
    x_px: np.ndarray,
    light: np.ndarray,
    noise: np.ndarray,
    start: tuple[float, float, float],
    wire: SteelWire,
) -> WireFit:
    """Fit offset, radius and blur, px, of a piece of wire to the light (N,) of pixels with s.d. `noise` (N,)."""
    reach, half = float(np.abs(x_px).max()), float(np.ptp(s_px)) / 2
    along, across = (s_px - s_px.mean()) / max(half, 1.0), x_px / reach
    background = np.stack([*(across**k for k in range(4)), *(along * across**k for k in range(3)), along**2], axis=-1)

    def shape(p: np.ndarray) -> np.ndarray:
        return profile(x_px - p[0], wire, p[1], p[2])

    def keep(p: np.ndarray, step: np.ndarray) -> np.ndarray:
        moved = p + np.clip(step, [-2.0, -0.2 * p[1], -0.3 * p[2]], [2.0, 0.2 * p[1], 0.3 * p[2]])
        moved[2] = np.clip(moved[2], _MIN_BLUR, _MAX_BLUR * start[1])
        return np.append(
            moved[0], [np.clip(moved[1], start[1] / _MAX_WIDTH_RATIO, start[1] * _MAX_WIDTH_RATIO), moved[2]]
        )

    return _fitted(shape, keep, np.array(start), background, light, noise)


def fit_tip(  # noqa: PLR0917
    s_px: np.ndarray,
    x_px: np.ndarray,
    light: np.ndarray,
    noise: np.ndarray,
    start: tuple[float, float],
    wire: SteelWire,
    appearance: tuple[float, float],
    beads: np.ndarray,
) -> WireFit:
    """Fit where a wire ends along the path, and its offset there, px; `appearance`: its radius and blur, px.

    `beads` (K, 3): s, x and radius, px, of steel balls over it, whose places are fitted too, about the given ones.
    """
    reach, half = float(np.abs(x_px).max()), float(np.ptp(s_px)) / 2
    along, across = (s_px - s_px.mean()) / half, x_px / reach
    powers = [(a, b) for a in range(4) for b in range(4 - a)]
    background = np.stack([across**a * along**b for a, b in powers], axis=-1)
    whole = float(_absorbed(np.array(wire.depth_mm)))
    mm_per_px = wire.diameter_mm / 2 / appearance[0]
    templates = [_tip_template(wire, *appearance, reach)]
    templates += [_ball_template(float(radius), appearance[1], mm_per_px) for radius in beads[:, 2]]

    def shape(p: np.ndarray) -> np.ndarray:
        passes = np.ones(len(s_px))
        for (template, corner), (s, x) in zip(templates, p.reshape(-1, 2), strict=True):
            at = np.stack([s_px - s, x_px - x]) / _CELL - corner[:, None]
            passes = passes * (1.0 - map_coordinates(template, at, order=1, mode="nearest"))
        return (1.0 - passes) / whole

    def keep(p: np.ndarray, step: np.ndarray) -> np.ndarray:
        return p + np.clip(step, -3.0, 3.0)

    sd = np.append([np.inf, np.inf], np.full(2 * len(beads), _BEAD_SD_PX))
    return _fitted(shape, keep, np.append(start, beads[:, :2]), background, light, noise, sd)


def _tip_template(wire: SteelWire, radius: float, blur: float, reach: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the share of light that a wire's end absorbs, over s and x with the tip at s = 0, and its first cell."""
    behind = 4 * radius + wire.point_px + 5 * blur + reach
    corner = np.round(np.array([-behind, -reach - 5 * blur - 4.0]) / _CELL)
    s = _CELL * (corner[0] + np.arange(round((behind + radius + 5 * blur + 4.0) / _CELL)))
    x = _CELL * (corner[1] + np.arange(1 - 2 * round(corner[1])))
    chord = _chord_mm(wire, s * wire.sine / wire.px_per_mm, x * wire.diameter_mm / 2 / radius)
    return gaussian_filter(_absorbed(chord), blur / _CELL, mode="nearest"), corner


def _ball_template(radius: float, blur: float, mm_per_px: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the share of light that a steel ball absorbs, over s and x from its centre, and its first cell (2,)."""
    reach = round((radius + 5 * blur) / _CELL)
    rho2 = (_CELL / radius * np.arange(-reach, reach + 1)) ** 2
    chord = 2 * radius * mm_per_px * np.sqrt(np.clip(1.0 - rho2[:, None] - rho2, 0.0, None))
    return gaussian_filter(_absorbed(chord), blur / _CELL), np.array([-reach, -reach])


def _chord_mm(wire: SteelWire, s_mm: np.ndarray, x_mm: np.ndarray) -> np.ndarray:
    """Return the chord (S, X) of parallel rays at s and x (across the rays) in a wire with its tip at 0."""
    cosine = np.sqrt(1 - wire.sine**2)
    half = wire.diameter_mm / wire.sine
    chord = np.zeros((len(s_mm), len(x_mm)))
    for depth in np.arange(-half, half, _RAY_MM) + _RAY_MM / 2:
        # The range of depths is centred on the wire's axis.
        t = depth + s_mm * cosine / wire.sine
        behind, off = -(s_mm * wire.sine + t * cosine), s_mm * cosine - t * wire.sine
        radius = wire.diameter_mm / 2 * (np.clip(behind / wire.point_mm, 0, 1) if wire.point_mm > 0 else behind > 0)
        chord += _RAY_MM * ((radius**2 - off**2)[:, None] > x_mm**2)
    return chord


def _fitted(  # noqa: PLR0917
    shape: Callable[[np.ndarray], np.ndarray],
    keep: Callable[[np.ndarray, np.ndarray], np.ndarray],
    start: np.ndarray,
    background: np.ndarray,
    light: np.ndarray,
    noise: np.ndarray,
    prior_sd: np.ndarray | None = None,
) -> WireFit:
    """Fit the parameters of `shape` by Gauss-Newton, jointly with background and scatter, which are linear.

    `prior_sd` (P,): of the parameters about `start`; without it nothing is known of them.
    """
    p, converged = start, False
    known = np.zeros(len(p)) if prior_sd is None else 1.0 / prior_sd
    for _ in range(_MAX_ITERATIONS):
        model, linear, columns = _linearised(shape, p, background, light, noise)
        rows = np.pad(np.diag(known), ((0, 0), (0, columns.shape[1] - len(p))))
        off = np.append((light - model) / noise, known * (start - p))
        step = np.linalg.lstsq(np.vstack([columns, rows]), off)[0][: len(p)]
        moved = keep(p, step)
        converged = bool(np.abs(moved - p)[0] < _CONVERGED)
        p = moved
        if converged:
            break
    model, linear, columns = _linearised(shape, p, background, light, noise)
    rows = np.pad(np.diag(known), ((0, 0), (0, columns.shape[1] - len(p))))
    influence = np.linalg.pinv(np.vstack([columns, rows]))[: len(p)]
    beside, count = float(linear[0]), len(light)
    by_prior = (influence[:, count:] ** 2).sum(axis=1)
    shadow = (1 - _ABSORBED) * beside + float(linear[-1])
    return WireFit(p, influence[:, :count], model, shadow, beside, converged, by_prior)


def _linearised(
    shape: Callable[[np.ndarray], np.ndarray],
    p: np.ndarray,
    background: np.ndarray,
    light: np.ndarray,
    noise: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the model, its linear coefficients, and its derivatives by all parameters over the noise."""
    share = shape(p)
    basis = np.column_stack([background * (1 - _ABSORBED * share)[:, None], share])
    linear = np.linalg.lstsq(basis / noise[:, None], light / noise)[0]
    by_share = linear[-1] - _ABSORBED * background @ linear[:-1]
    h = 0.02
    slopes = [(shape(p + h * e) - shape(p - h * e)) / (2 * h) * by_share for e in np.eye(len(p))]
    return basis @ linear, linear, np.column_stack([*slopes, basis]) / noise[:, None]
