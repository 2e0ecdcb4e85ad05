"""Cramér-Rao bound of a bead's centre in one image of the twin, from the Fisher information of the true image.

The data are counted quanta (Poisson), blurred, with white electronic and rounding noise: covariance G Q G' + e². The
unknowns are centre, radius, contrast and blur of each bead in the window, and a quadratic background. Pixels changed by
another sharp object, saturated pixels and pixels outside the field carry no information.

Where two shadows overlap, this bound takes the light that both balls let through for known: the product of what each
lets through. No image says so: scatter and the beam's hardening change it. The bound with `own` pixels alone gives
pixels of two shadows no information.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.interpolate import LSQUnivariateSpline

from sightline.twin.scenes.hard import BeadTruth
from sightline.twin.xray.render import ELECTRONIC_SD

_BEYOND_PX = 6.0  # of the window beyond the rim
_MARGIN = 8  # px around the window: quanta there are blurred into it
_STRANGE = 0.08  # difference from the beads' shadows, share of the light, that indicates another object
_ALIKE = 0.05  # relative difference in radius of beads pooled for one profile
_STEPS = 40
_PRECISION = 1e-4
_RIM_BLURS = 2.0  # from a shadow's rim to where its blur no longer changes the light, in s.d. of the blur


@dataclass(frozen=True, eq=False)
class _Profile:
    """Shadow of beads of one size: `share` of the full contrast at r / radius; contrast of an isolated bead."""

    share: LSQUnivariateSpline
    contrast: float


def centroid_bounds(truth: BeadTruth, own: np.ndarray | None = None) -> np.ndarray:
    """Return the bounds (N, 2, 2), px²; infinite where the image does not determine a centre.

    `own` (N,) bool: of these beads alone, from the pixels that a single shadow changes.
    """
    exposure = truth.exposure
    ratio = np.where(exposure.field, exposure.quanta / np.maximum(exposure.open_quanta, 1e-9), 1.0)
    mean, white = exposure.mean_pixels(), exposure.chain.white
    sd = np.sqrt(np.maximum(mean, 1.0) * exposure.gain / (4 * np.pi * exposure.core_px**2))
    clear = exposure.field & (mean + sd < white)
    if own is not None:
        clear &= ~_shared(truth)
    profiles = [_profile(truth, ratio, i) for i in range(len(truth))]
    bounds = np.full((len(truth), 2, 2), np.inf)
    for i in range(len(truth)) if own is None else np.flatnonzero(own):
        bounds[i] = _bound(truth, ratio, clear, profiles, i)
    return bounds


def _shared(truth: BeadTruth) -> np.ndarray:
    """Return the pixels (H, W) bool that the shadows of two beads or more change."""
    count = np.zeros(truth.exposure.field.shape, np.uint8)
    for (u, v), radius, blur in zip(truth.shadow_px, truth.radius_px, truth.blur_px, strict=True):
        reach = radius + _RIM_BLURS * blur
        rows, columns = _box(count.shape, u, v, reach)
        x, y = np.arange(columns.start, columns.stop) - u, (np.arange(rows.start, rows.stop) - v)[:, None]
        count[rows, columns] += np.hypot(x, y) < reach
    return count > 1


def _profile(truth: BeadTruth, ratio: np.ndarray, i: int) -> _Profile | None:
    """Return the profile pooled from isolated beads of this size; None where there is none."""
    free = (truth.gap_px > 4) & (truth.rim_px > 4) & (abs(truth.radius_px / truth.radius_px[i] - 1) < _ALIKE)
    at, share, contrasts = [], [], []
    for j in np.flatnonzero(free):
        (u, v), radius = truth.shadow_px[j], truth.radius_px[j]
        rows, columns = _box(ratio.shape, u, v, radius + 3)
        r = np.hypot(np.arange(columns.start, columns.stop) - u, (np.arange(rows.start, rows.stop) - v)[:, None])
        dark = 1 - ratio[rows, columns]
        if not (r < 0.3 * radius).any():
            continue  # outside the image, though inside its round field
        contrasts.append(float(dark[r < 0.3 * radius].mean()))
        inside = r < radius + 3
        at.append(r[inside] / radius)
        share.append(dark[inside] / contrasts[-1])
    if not at:
        return None
    x, y = np.concatenate(at), np.concatenate(share)
    order = np.argsort(x)
    near = np.arange(-1.25, 1.3, 0.25) / truth.radius_px[i] + 1
    knots = np.concatenate([np.linspace(0, near[0], 8)[1:-1], near])
    return _Profile(LSQUnivariateSpline(x[order], y[order], knots, k=3), float(np.median(contrasts)))


def _bound(truth: BeadTruth, ratio: np.ndarray, clear: np.ndarray, profiles: list[_Profile | None], i: int):
    exposure, (u, v) = truth.exposure, truth.shadow_px[i]
    reach = truth.radius_px[i] + _BEYOND_PX
    rows, columns = _box(ratio.shape, u, v, reach + _MARGIN)
    x, y = np.arange(columns.start, columns.stop) - u, (np.arange(rows.start, rows.stop) - v)[:, None]
    apart = np.linalg.norm(truth.shadow_px - truth.shadow_px[i], axis=-1)
    beads = [j for j in np.argsort(apart, kind="stable") if apart[j] < reach + truth.radius_px[j] + 3]
    nothing = np.full((2, 2), np.inf)
    if any(profiles[j] is None for j in beads):
        return nothing
    shares, slopes = [], []
    for j in beads:
        share, slope = _shadow(
            profiles[j], x - (truth.shadow_px[j, 0] - u), y - (truth.shadow_px[j, 1] - v), float(truth.radius_px[j])
        )
        shares.append(share)
        slopes.append(slope)
    light = [1 - s for s in shares]
    whole = np.prod(light, axis=0)
    contrast = max(profiles[j].contrast for j in beads)
    strange = abs(ratio[rows, columns] - (1 - contrast * (1 - whole))) > _STRANGE
    strange = cv2.dilate(cv2.morphologyEx(strange.astype(np.uint8), cv2.MORPH_OPEN, np.ones((2, 2))), np.ones((5, 5)))
    told = clear[rows, columns] & (strange == 0) & (np.hypot(x, y) < reach)
    open_quanta, quanta = exposure.open_quanta[rows, columns], exposure.quanta[rows, columns]
    derivatives = []
    for k, slope in enumerate(slopes):
        others = np.prod([other for m, other in enumerate(light) if m != k], axis=0) if len(light) > 1 else 1.0
        derivatives += [contrast * others * d for d in slope]
    a, b = x / reach + 0 * y, y / reach + 0 * x
    ground = [ratio[rows, columns] * term for term in (np.ones_like(a), a, b, a * a, a * b, b * b)]
    design = np.stack(derivatives + ground) * open_quanta
    glare = 1 - exposure.chain.glare
    electronic = ((ELECTRONIC_SD * exposure.chain.white) ** 2 + 1 / 12) / exposure.gain**2
    information = _information(glare * design, told, glare**2 * quanta, exposure.core_px, electronic)
    scale = np.sqrt(np.diag(information))
    if (scale[:2] == 0).any():
        return nothing
    used = scale > 1e-9 * scale.max()
    information = information[np.ix_(used, used)] / np.outer(scale[used], scale[used])
    values, vectors = np.linalg.eigh(information)
    if values[0] < 1e-12:
        return nothing
    return ((vectors / values) @ vectors.T)[:2, :2] / np.outer(scale[:2], scale[:2])


def _shadow(profile: _Profile, x: np.ndarray, y: np.ndarray, radius: float) -> tuple[np.ndarray, list[np.ndarray]]:
    """Return the share of the contrast, and the derivatives of its negative by u, v, radius, contrast and blur²/2."""
    r = np.hypot(x, y) + 1e-9
    inside = r < radius + 2.5
    at = np.minimum(r / radius, 1 + 2.5 / radius)
    share = np.where(inside, profile.share(at), 0.0)
    slope = np.where(inside, profile.share(at, 1), 0.0) / radius
    bend = np.where(inside, profile.share(at, 2), 0.0) / radius**2
    return share, [slope * x / r, slope * y / r, slope * r / radius, -share, -(bend + slope / r)]


def _information(design: np.ndarray, told: np.ndarray, quanta: np.ndarray, core_px: float, electronic: float):
    """Return D' C^-1 D of a sharp `design` by conjugate gradients, preconditioned with the spectrum of the quanta."""

    def blurred(fields: np.ndarray) -> np.ndarray:
        return np.stack([cv2.GaussianBlur(f, (0, 0), core_px, borderType=cv2.BORDER_CONSTANT) for f in fields])

    root = np.sqrt(np.maximum(quanta, 1e-3 * quanta.max()))
    k = [2 * np.pi * np.fft.fftfreq(n) for n in told.shape]
    spectrum = np.exp(-(core_px**2) * (k[0][:, None] ** 2 + k[1] ** 2)) + electronic / np.median(quanta[told])

    def times(p: np.ndarray) -> np.ndarray:
        return told * (blurred(quanta * blurred(p)) + electronic * p)

    def nearly_inverse(r: np.ndarray) -> np.ndarray:
        return told * np.fft.ifft2(np.fft.fft2(r / root) / spectrum).real / root

    if told.sum() < 2 * len(design):
        return np.zeros((len(design), len(design)))
    data = told * blurred(design)
    z, r = np.zeros_like(data), data.copy()
    s = nearly_inverse(r)
    p, rs = s.copy(), (r * s).sum(axis=(1, 2))
    start = np.maximum(rs, 1e-300)
    for _ in range(_STEPS):
        c = times(p)
        step = rs / np.maximum((p * c).sum(axis=(1, 2)), 1e-300)
        z += step[:, None, None] * p
        r -= step[:, None, None] * c
        s = nearly_inverse(r)
        new = (r * s).sum(axis=(1, 2))
        p = s + (new / np.maximum(rs, 1e-300))[:, None, None] * p
        rs = new
        if (rs < _PRECISION**2 * start).all():
            break
    return np.einsum("ahw,bhw->ab", data, z)


def _box(shape: tuple[int, int], u: float, v: float, reach: float) -> tuple[slice, slice]:
    n = int(reach) + 1
    return (
        slice(max(int(v) - n, 0), min(int(v) + n + 2, shape[0])),
        slice(max(int(u) - n, 0), min(int(u) + n + 2, shape[1])),
    )
