"""The image intensifier: mapping of the input plane (detector coordinates, mm) to pixels and back, and its prior.

    uv = centre + (m / pitch) D(xi),   m = 1 / (1 + k1 R²)

so that the useful field of radius R fills the image for any pincushion.
"""

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from sightline.errors import OutsideRegionError, SetUpError
from sightline.twin.xray.distortion import DistortionMap, disc_mm, monomials
from sightline.twin.xray.presets import ImageChain

NEWTON_STEPS = 30
NEWTON_MM = 1e-10
MIN_DETERMINANT = 0.2  # of D' anywhere in the field; a map with a smaller one counts as folded [ours]
FIELD_MARGIN = 1.1  # the map must not fold within this multiple of the useful field's radius [ours]


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
