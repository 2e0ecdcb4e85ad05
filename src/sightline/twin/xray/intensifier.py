"""The image intensifier: its distortion, the map of the input plane to pixels and back, and its prior.

In detector coordinates xi (mm at the input plane, R the radius of the tube's own field, u = |xi| / R) the distortion is
linear in all its parameters but two:

    D(xi) = (1 + k1 |xi|²) Rot(turn(xi)) xi + shift(xi) + cubic(xi) + random(xi)
    turn(xi)  = (1 - 0.79 u² + 0.23 u⁴) (t0 + t1 x/R + t2 y/R)       rotation by the axial magnetic field
    shift(xi) = (1 - 1.41 u² + 0.88 u⁴) S (1, x/R, y/R)              shift by the transverse magnetic field

The radial factors are constant beyond 1.1 R, so that points far outside do not fold back into the field. With R the
radius of the useful field, which then fills the image for any pincushion:

    uv = centre + (m / pitch) D(xi),   m = 1 / (1 + k1 R²)
"""

from dataclasses import dataclass, field
from functools import cached_property, lru_cache

import numpy as np

from sightline.errors import OutsideRegionError, SetUpError
from sightline.twin.xray.distributions import Distortion
from sightline.twin.xray.presets import ImageChain

FADE_HOLD = 1.1
TURN = Distortion.turn_fade
SHIFT = Distortion.shift_fade
NEWTON_STEPS = 30
NEWTON_MM = 1e-10
# A map with a smaller determinant of D' counts as folded; it must not fold within this multiple of the useful field's
# radius: what is farther out is blanked [ours].
MIN_DETERMINANT, FIELD_MARGIN = 0.2, 1.1


def _fade(u2: np.ndarray, coefficients: tuple[float, float]) -> tuple[np.ndarray, np.ndarray]:
    """Return 1 + a u² + b u⁴, constant beyond FADE_HOLD, and its derivative with respect to u²."""
    held = u2 > FADE_HOLD**2
    v = np.minimum(u2, FADE_HOLD**2)
    a, b = coefficients
    return 1 + a * v + b * v * v, np.where(held, 0.0, a + 2 * b * v)


@lru_cache(maxsize=8)
def disc_mm(radius_mm: float, across: int = 41) -> np.ndarray:
    """Return points (N, 2) of a square lattice within a disc, over which means over the field are taken."""
    side = np.linspace(-radius_mm, radius_mm, across)
    x, y = np.meshgrid(side, side)
    inside = x * x + y * y <= radius_mm**2 * (1 + 1e-12)
    points = np.stack([x[inside], y[inside]], axis=-1)
    points.flags.writeable = False
    return points


def monomials(unit_xy: np.ndarray, degree: int) -> np.ndarray:
    """Return the powers x^i y^j with i + j <= degree, by rising degree: (N, (degree + 1)(degree + 2) / 2)."""
    x, y = unit_xy[..., 0], unit_xy[..., 1]
    return np.stack([x ** (d - j) * y**j for d in range(degree + 1) for j in range(d + 1)], axis=-1)


@lru_cache(maxsize=8)
def _cubic_basis(radius_mm: float) -> np.ndarray:
    """Return the coefficients (10, 7) of seven cubics in x/R, y/R with unit rms over the disc, orthogonal there to each
    other and to linear functions."""
    points = monomials(disc_mm(radius_mm) / radius_mm, 3)
    r = np.linalg.qr(points)[1]
    basis = np.linalg.inv(r)[:, 3:] * np.sqrt(len(points))
    basis.flags.writeable = False
    return basis


def _cubics(xi_mm: np.ndarray, radius_mm: float) -> np.ndarray:
    """Return the seven cubics (N, 7) of the asymmetric part at points (N, 2)."""
    return monomials(xi_mm / radius_mm, 3) @ _cubic_basis(radius_mm)


def _cubic_gradients(xi_mm: np.ndarray, radius_mm: float) -> np.ndarray:
    """Return the gradients (N, 7, 2) of the cubics at points (N, 2), per mm."""
    x, y = (xi_mm / radius_mm).T
    zero, unity = np.zeros_like(x), np.ones_like(x)
    by_x = [zero, unity, zero, 2 * x, y, zero, 3 * x * x, 2 * x * y, y * y, zero]
    by_y = [zero, zero, unity, zero, x, 2 * y, zero, x * x, 2 * x * y, 3 * y * y]
    both = np.stack([np.stack(by_x, -1), np.stack(by_y, -1)], -1)
    return np.swapaxes(np.swapaxes(both, 1, 2) @ _cubic_basis(radius_mm), 1, 2) / radius_mm


@dataclass(frozen=True, eq=False)
class RandomField:
    """Gaussian bumps on a square lattice; independent weights make a Gaussian random field.

    `side_mm` (n,): coordinates of the lattice in x and in y, `width_mm` apart; K = n² bumps of that width, x the slower
    index. The covariance is exactly that of the finite basis. Inside the field it agrees with exp(-d² / 2 l²),
    l = sqrt(2) width, to 2e-3, because the lattice is as fine as the bumps are wide.
    """

    side_mm: np.ndarray
    width_mm: float

    @staticmethod
    def over(radius_mm: float, correlation_mm: float) -> "RandomField":
        """Return the field of a correlation length over a disc, with bumps up to three widths beyond it."""
        width = correlation_mm / np.sqrt(2)
        n = int(np.ceil((radius_mm + 3 * width) / width))
        return RandomField(np.arange(-n, n + 1) * width, width)

    def __len__(self) -> int:
        return len(self.side_mm) ** 2

    def _bumps(self, x_mm: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return one-dimensional bumps and their slopes (N, n), scaled so that unit weights give unit variance."""
        gap = (x_mm[:, None] - self.side_mm) / self.width_mm
        bumps = np.pi**-0.25 * np.exp(-0.5 * gap * gap)
        return bumps, -bumps * gap / self.width_mm

    def values(self, xi_mm: np.ndarray) -> np.ndarray:
        """Return the values (N, K) of all bumps at points (N, 2)."""
        bx, by = self._bumps(xi_mm[:, 0])[0], self._bumps(xi_mm[:, 1])[0]
        return (bx[:, :, None] * by[:, None, :]).reshape(len(xi_mm), -1)

    def sums(self, xi_mm: np.ndarray, weights: np.ndarray) -> np.ndarray:
        """Return the sums (N, 2) of the bumps with weights (K, 2)."""
        bx, by = self._bumps(xi_mm[:, 0])[0], self._bumps(xi_mm[:, 1])[0]
        return self._sum(bx, by, weights)

    def sum_gradients(self, xi_mm: np.ndarray, weights: np.ndarray) -> np.ndarray:
        """Return the derivatives (N, 2, 2) of `sums` with respect to xi, per mm."""
        (bx, dx), (by, dy) = self._bumps(xi_mm[:, 0]), self._bumps(xi_mm[:, 1])
        return np.stack([self._sum(dx, by, weights), self._sum(bx, dy, weights)], axis=-1)

    @staticmethod
    def _sum(bx: np.ndarray, by: np.ndarray, weights: np.ndarray) -> np.ndarray:
        n = bx.shape[1]
        rows = (bx @ weights.reshape(n, 2 * n)).reshape(-1, n, 2)
        return np.einsum("nia,ni->na", rows, by)


@dataclass(frozen=True, eq=False)
class DistortionMap:
    """One drawn distortion, D(xi) of the module's docstring, mm to mm.

    `k1` per mm²; `turn` (3,) rad; `shift_mm` (2, 3); weights `cubic_mm` (7, 2) and `random_mm` (K, 2).
    """

    radius_mm: float
    k1: float
    turn: np.ndarray
    shift_mm: np.ndarray
    cubic_mm: np.ndarray
    field: RandomField
    random_mm: np.ndarray

    @cached_property
    def parameters(self) -> np.ndarray:
        """All parameters (1 + 3 + 6 + 14 + 2K,): k1, turn, shift, cubic, random; the order of `derivatives`."""
        parts = (self.turn, self.shift_mm.ravel(), self.cubic_mm.ravel(), self.random_mm.ravel())
        return np.concatenate([[self.k1], *parts])

    def _terms(self, xi_mm: np.ndarray) -> tuple[np.ndarray, ...]:
        """Return (1, x/R, y/R) (N, 3), and rho², u² and 1 + k1 rho² (N,)."""
        rho2 = (xi_mm**2).sum(-1)
        linear = np.concatenate([np.ones((len(xi_mm), 1)), xi_mm / self.radius_mm], axis=-1)
        return linear, rho2, rho2 / self.radius_mm**2, 1 + self.k1 * rho2

    def apply(self, xi_mm: np.ndarray) -> np.ndarray:
        """Return D (N, 2) at points (N, 2)."""
        linear, _, u2, stretch = self._terms(xi_mm)
        angle = _fade(u2, TURN)[0] * (linear @ self.turn)
        turned = stretch[:, None] * _rotate(xi_mm, angle)
        shift = _fade(u2, SHIFT)[0][:, None] * (linear @ self.shift_mm.T)
        cubic = _cubics(xi_mm, self.radius_mm) @ self.cubic_mm
        return turned + shift + cubic + self.field.sums(xi_mm, self.random_mm)

    def jacobian(self, xi_mm: np.ndarray) -> np.ndarray:
        """Return dD / dxi (N, 2, 2) at points (N, 2)."""
        R = self.radius_mm
        linear, _, u2, stretch = self._terms(xi_mm)
        fade, slope = _fade(u2, TURN)
        du2 = 2 * xi_mm / R**2
        angle = fade * (linear @ self.turn)
        angle_grad = (slope * (linear @ self.turn))[:, None] * du2 + fade[:, None] * self.turn[1:] / R
        turned, normal = _rotate(xi_mm, angle), _rotate(xi_mm, angle + np.pi / 2)
        jacobian = turned[:, :, None] * (2 * self.k1 * xi_mm)[:, None, :]
        jacobian += stretch[:, None, None] * (_rotations(angle) + normal[:, :, None] * angle_grad[:, None, :])
        fade, slope = _fade(u2, SHIFT)
        jacobian += (linear @ self.shift_mm.T)[:, :, None] * (slope[:, None] * du2)[:, None, :]
        jacobian += fade[:, None, None] * self.shift_mm[:, 1:] / R
        jacobian += np.swapaxes(np.swapaxes(_cubic_gradients(xi_mm, R), 1, 2) @ self.cubic_mm, 1, 2)
        return jacobian + self.field.sum_gradients(xi_mm, self.random_mm)

    def derivatives(self, xi_mm: np.ndarray) -> np.ndarray:
        """Return dD / dparameters (N, 2, P) at points (N, 2), in the order of `parameters`."""
        linear, rho2, u2, stretch = self._terms(xi_mm)
        fade = _fade(u2, TURN)[0]
        angle = fade * (linear @ self.turn)
        by_k1 = rho2[:, None] * _rotate(xi_mm, angle)
        normal = stretch[:, None] * _rotate(xi_mm, angle + np.pi / 2)
        by_turn = normal[:, :, None] * (fade[:, None] * linear)[:, None, :]
        by_shift = _each_component(_fade(u2, SHIFT)[0][:, None] * linear, component_first=True)
        by_cubic = _each_component(_cubics(xi_mm, self.radius_mm))
        by_random = _each_component(self.field.values(xi_mm))
        return np.concatenate([by_k1[:, :, None], by_turn, by_shift, by_cubic, by_random], axis=-1)


def _rotate(xy: np.ndarray, angle: np.ndarray) -> np.ndarray:
    c, s = np.cos(angle), np.sin(angle)
    return np.stack([c * xy[:, 0] - s * xy[:, 1], s * xy[:, 0] + c * xy[:, 1]], axis=-1)


def _rotations(angle: np.ndarray) -> np.ndarray:
    c, s = np.cos(angle), np.sin(angle)
    return np.stack([np.stack([c, -s], -1), np.stack([s, c], -1)], -2)


def _each_component(values: np.ndarray, component_first: bool = False) -> np.ndarray:
    """Expand scalar basis values (N, K) to responses (N, 2, 2K) of weights (K, 2), or (2, K) with `component_first`."""
    n, k = values.shape
    responses = np.zeros((n, 2, 2, k) if component_first else (n, 2, k, 2))
    for c in range(2):
        if component_first:
            responses[:, c, c, :] = values
        else:
            responses[:, c, :, c] = values
    return responses.reshape(n, 2, 2 * k)


@dataclass(frozen=True, eq=False)
class DistortionPrior:
    """Second moments of the prior of a distortion: parameters deviate from their means by factor @ N(0, 1).

    `smooth_factor` (24, 24): for k1, turn (3), shift (6) and cubic (14) of `DistortionMap.parameters`. `random_sd_mm`:
    standard deviation of each weight of the random field, for this view's correlation length.
    """

    smooth_factor: np.ndarray
    random_sd_mm: float

    def spread(self, derivatives: np.ndarray) -> np.ndarray:
        """Convert derivatives by the parameters (..., P) to responses to P independent unit-variance numbers."""
        n = len(self.smooth_factor)
        return np.concatenate(
            [derivatives[..., :n] @ self.smooth_factor, derivatives[..., n:] * self.random_sd_mm], axis=-1
        )


@dataclass(frozen=True, eq=False)
class Intensifier:
    """The intensifier, or flat panel, of one exposure. `centre_px` (2,): the undistorted centre of the field.

    Raises SetUpError if the map folds within the field.
    """

    chain: ImageChain
    distortion: DistortionMap
    prior: DistortionPrior
    centre_px: np.ndarray = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "centre_px", self.chain.centre_px)
        xi = FIELD_MARGIN * disc_mm(self.chain.field_mm / 2, 21)
        if np.linalg.det(self.distortion.jacobian(xi)).min() < MIN_DETERMINANT:
            raise SetUpError("the distortion folds the image; draw it again or reduce its amplitudes")

    @property
    def px_per_mm(self) -> float:
        """Scale in the centre, m / pitch."""
        return 1 / (1 + self.distortion.k1 * (self.chain.field_mm / 2) ** 2) / self.chain.pitch_mm

    def to_image(self, xi_mm: np.ndarray) -> np.ndarray:
        """Map detector coordinates (..., 2), mm, to pixels (..., 2)."""
        xi = np.asarray(xi_mm, dtype=np.float64)
        return self.centre_px + self.px_per_mm * self.distortion.apply(xi.reshape(-1, 2)).reshape(xi.shape)

    def jacobian(self, xi_mm: np.ndarray) -> np.ndarray:
        """Return d(to_image)/d(xi) (N, 2, 2) at points (N, 2), px/mm."""
        return self.px_per_mm * self.distortion.jacobian(np.asarray(xi_mm, dtype=np.float64))

    def to_detector(self, uv_px: np.ndarray) -> np.ndarray:
        """Map pixels (..., 2) to detector coordinates (..., 2), mm, by Newton's method to 1e-9 mm.

        Raises OutsideRegionError if it does not converge for a pixel.
        """
        uv = np.asarray(uv_px, dtype=np.float64)
        goal = ((uv - self.centre_px) / self.px_per_mm).reshape(-1, 2)
        xi = goal.copy()
        for _ in range(NEWTON_STEPS):
            step = np.linalg.solve(self.distortion.jacobian(xi), (goal - self.distortion.apply(xi))[..., None])[..., 0]
            xi += step
            if not np.isfinite(xi).all():
                break
            if len(xi) == 0 or np.abs(step).max() < NEWTON_MM:
                return xi.reshape(uv.shape)
        raise OutsideRegionError("some pixels correspond to no point of the intensifier's input plane")

    def in_field(self, uv_px: np.ndarray, margin_px: float | np.ndarray = 0.0) -> np.ndarray:
        """Whether pixels (..., 2) lie at least `margin_px` inside the field: bool (...,)."""
        return self.chain.rim_px(uv_px) >= margin_px

    def response_px(self, xi_mm: np.ndarray) -> np.ndarray:
        """Return the responses (N, 2, P) of `to_image` to the prior's unit-variance numbers, px, at points (N, 2)."""
        by_parameter = self.distortion.derivatives(xi_mm)
        square = (self.chain.field_mm / 2) ** 2
        by_scale = -square / (1 + self.distortion.k1 * square)
        by_parameter[..., 0] += by_scale * self.distortion.apply(xi_mm)  # m depends on k1 too
        return self.px_per_mm * self.prior.spread(by_parameter)

    def _inverse_response(self, uv_px: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return, at the points of pixels (N, 2): the Jacobian (N, 2, 2), the response (N, 2, P) of the points to the
        prior's unit-variance numbers, mm, and the ten cubic monomials (N, 10) of the pixels."""
        xi = self.to_detector(uv_px)
        jacobian = self.jacobian(xi)
        moves = -np.linalg.solve(jacobian, self.response_px(xi))
        return jacobian, moves, monomials((uv_px - self.centre_px) / self.chain.mask_px, 3)

    @cached_property
    def _cubic_part(self) -> np.ndarray:
        """The cubic (10, 2, P) of the pixels that fits the points' response to the prior best over the field."""
        _, moves, powers = self._inverse_response(self.centre_px + disc_mm(self.chain.mask_px, 31))
        return np.linalg.lstsq(powers, moves.reshape(len(moves), -1))[0].reshape(10, *moves.shape[1:])

    def beyond_cubic_factor(self, uv_px: np.ndarray) -> np.ndarray:
        """Return the response (2N, P), px, of pixels (N, 2) to P independent unit-variance numbers, without the part
        that a cubic can describe.

        The prior contains pincushion, rotation, shift, asymmetric cubic and random field by the second moments of their
        distributions, given this view's beam direction and the correlation length and amplitude of its random field. It
        is linearised about the drawn map. The part removed is the cubic that fits the map from pixels to the input
        plane best, in the mean square over the round field. The priors of the views are independent.
        """
        uv = np.asarray(uv_px, dtype=np.float64)
        jacobian, moves, powers = self._inverse_response(uv)
        remainder = moves - np.einsum("nk,kcp->ncp", powers, self._cubic_part)
        return -(jacobian @ remainder).reshape(2 * len(uv), -1)

    def beyond_cubic_covariance(self, uv_px: np.ndarray) -> np.ndarray:
        """Return the covariance (2N, 2N) of `beyond_cubic_factor`, px², in the order u1, v1, u2, ...."""
        factor = self.beyond_cubic_factor(uv_px)
        return factor @ factor.T
