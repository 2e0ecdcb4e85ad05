"""Model of a window (shadows of one to three beads on a cubic background) and its linear algebra."""

from functools import cache
from typing import NamedTuple

import numpy as np
from scipy.special import j0, roots_legendre

from sightline.common.kernels import kernel

# The shadow of a ball is 1 - exp(-a sqrt(1 - rho^2)): a = mu d = 10.1/cm x 3 and 5 mm, 316L steel at 60 keV
# [physics.md]. These are the diameters of the small and the large balls of the built-in frames.
_SMALL_DEPTH, _LARGE_DEPTH = 3.0, 5.0
# The table's axes are the distance from the rim in blur sigmas and the blur in radii; it is smooth in both. Further in
# than the first column it is taken as flat, although the shadow of the largest balls still deepens by 2 %.
T_FIRST, T_STEP, T_COUNT = -30.0, 0.125, 289
Q_STEP, Q_COUNT = 0.0125, 96  # sigma / radius 0.0125 ... 1.2
_NODES = 600  # of the quadratures: eight per period of the fastest wave
_RADII = 1200  # of the transform: 1.3 % apart in their distance from the rim
_AT_ONCE = 100  # rows of Bessel functions held at a time: all of them would take 12 MB


def _sharp(rho: np.ndarray, depth: float) -> np.ndarray:
    chord = np.sqrt(np.clip(1 - rho**2, 0, None))
    return np.where(rho < 1, np.expm1(-depth * chord) / np.expm1(-depth), 0.0)


def profile_table(ball: bool) -> np.ndarray:
    """Return the profiles (K, Q_COUNT, T_COUNT) of radius 1 blurred by a Gaussian of sigma q, read-only.

    Of a small and a large ball (K = 2), or of a disc (K = 1). Column t is at radius 1 + t q; radii below 0 have the
    value at 0. Computed by a Hankel transform.
    """
    return _tables()[:2] if ball else _tables()[2:]


@cache
def _tables() -> np.ndarray:
    """Return the tables (3, Q_COUNT, T_COUNT) of both balls and a disc, which share the Bessel functions."""
    q = Q_STEP * (1 + np.arange(Q_COUNT))
    t = T_FIRST + T_STEP * np.arange(T_COUNT)
    rho, rho_weight = roots_legendre(_NODES)
    angle = (rho + 1) * np.pi / 4  # rho = sin(angle) resolves the square root at the rim
    node, weight = np.sin(angle), rho_weight * np.pi / 4 * np.cos(angle)
    k_max = 6.0 / Q_STEP
    k, k_weight = (rho + 1) * k_max / 2, rho_weight * k_max / 2
    sharp = _sharp(node, _SMALL_DEPTH), _sharp(node, _LARGE_DEPTH), np.ones(_NODES)
    shapes = np.stack([values * node * weight for values in sharp], axis=1)
    spectra = _transformed(k, node, shapes).T * k * k_weight
    furthest = q[-1] * t[-1]
    from_rim = 1e-3 * np.sinh(np.linspace(-np.arcsinh(1e3), np.arcsinh(1e3 * furthest), _RADII))
    blur = np.exp(-0.5 * np.outer(k, q) ** 2)
    blurred = _transformed(1 + from_rim, k, np.concatenate([blur * spectrum[:, None] for spectrum in spectra], axis=1))
    tables = np.empty((len(spectra), Q_COUNT, T_COUNT))
    for table, values in zip(tables, np.split(blurred, len(spectra), axis=1), strict=True):
        table[:] = np.stack([np.interp(t * sigma, from_rim, values[:, i]) for i, sigma in enumerate(q)])
    np.clip(tables, 0.0, 1.0, out=tables)
    tables.flags.writeable = False
    return tables


def _transformed(at: np.ndarray, nodes: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Return J0(at nodes) @ weights (N, C): a Hankel transform of order zero at `at` (N,), by `weights` (M, C)."""
    parts = np.split(at, range(_AT_ONCE, len(at), _AT_ONCE))
    return np.concatenate([j0(np.outer(part, nodes)) @ weights for part in parts])


# Parameters of a bead's shadow: centre about the first guess and radius, px; blur, px; ellipticity along the axes and
# along the diagonals.
BEAD_X, BEAD_Y, BEAD_RADIUS, BEAD_BLUR, BEAD_AXIAL, BEAD_DIAGONAL = range(6)
# After them: the share of a large ball's profile in the shadow's, the rest is a small one's (not fitted); the light
# that a neighbour lets through beyond what the first bead does.
BEAD_LARGE, BEAD_LIGHT = 6, 7
# Numbers of parameters: of a bead (then comes BEAD_LIGHT of each neighbour); of the scatter (light behind the beads
# that they do not stop, or that bright holes add: level and slopes, shared by all beads of a window); of the
# background, of which the last four are cubic terms.
BEAD_TERMS, SCATTER_TERMS, BACKGROUND_TERMS, CUBIC_TERMS = 6, 3, 10, 4
# After the derivatives, `columns` holds the residual, the model's light and the background.
RESIDUAL, LIGHT, BACKGROUND = -3, -2, -1
# Rows of `behind`: shares that the beads leave of the background and of light that they stop completely, and the
# slopes of the first.
LEFT, CLEAR, LEFT_X, LEFT_Y = range(4)
# Share of the background's light that a bead stops: 0.93-0.97 for 3 mm of steel [calc], less for the veiling glare that
# follows the background as closely. Above 0.87, the light in a bead's middle says too little of a background that is
# clipped around it [twin].
STOPPED_BY_BALL, STOPPED_BY_HOLE = np.float32(0.87), np.float32(0.0)


class WindowModel(NamedTuple):
    """The model of a window: `tables` of profiles (`profile_table`); the pixels' x, y and measured value, `at` (3, N).

    Parameters of K `beads`, of the `scatter` and of the `background`; `scale`: one over the window's reach; `stopped`:
    the share of the light that a bead stops.
    """

    tables: np.ndarray
    at: np.ndarray
    beads: np.ndarray
    scatter: np.ndarray
    background: np.ndarray
    scale: np.float32
    stopped: np.float32


class Derivatives(NamedTuple):
    """What a model gives at N pixels: `columns`, the derivatives by all parameters, residual, light and background.

    `columns` ((BEAD_TERMS + 1) K - 1 + SCATTER_TERMS + BACKGROUND_TERMS + 3, N); `behind` (4, N): see LEFT; `effect`
    (K, N): derivative of the light by each bead's share.
    """

    columns: np.ndarray
    behind: np.ndarray
    effect: np.ndarray


@kernel()
def _profile_row(tables, bead, row):
    """Fill `row` (2, T_COUNT) with a bead's profile, and its derivative by blur over radius."""
    radius, blur, large = bead[BEAD_RADIUS], bead[BEAD_BLUR], bead[BEAD_LARGE]
    table = tables[0]
    y = min(max(blur / radius / Q_STEP - 1.0, 0.0), Q_COUNT - 1.001)
    i = int(y)
    b = y - i
    for j in range(T_COUNT):
        row[0, j] = table[i, j] + (table[i + 1, j] - table[i, j]) * b
        row[1, j] = (table[i + 1, j] - table[i, j]) / Q_STEP
    if large > 0.0 and len(tables) > 1:
        table = tables[1]
        for j in range(T_COUNT):
            row[0, j] += large * (table[i, j] + (table[i + 1, j] - table[i, j]) * b - row[0, j])
            row[1, j] += large * ((table[i + 1, j] - table[i, j]) / Q_STEP - row[1, j])


@kernel()
def _shadow(row, at, bead, by_parameters, slopes):
    """Fill `by_parameters` (BEAD_TERMS, N) with the derivatives of a bead's share, `slopes` (3, N) with it and its
    slopes.

    Several short loops, because the compiler vectorises each of them.
    """
    u, v, radius, blur = (
        np.float32(bead[BEAD_X]),
        np.float32(bead[BEAD_Y]),
        np.float32(bead[BEAD_RADIUS]),
        np.float32(bead[BEAD_BLUR]),
    )
    e_axes, e_diagonals = np.float32(bead[BEAD_AXIAL]), np.float32(2.0 * bead[BEAD_DIAGONAL])
    unity, two, first = np.float32(1.0), np.float32(2.0), np.float32(T_FIRST)
    per_step, last = np.float32(1.0 / T_STEP), np.float32(T_COUNT - 1.001)
    per_blur, per_radius, pixels = unity / blur, unity / radius, at.shape[1]
    r, t, by_r, by_q, share = by_parameters[2], by_parameters[3], by_parameters[4], by_parameters[5], slopes[0]
    for n in range(pixels):
        dx, dy = at[0, n] - u, at[1, n] - v
        distance = np.sqrt(dx * dx + dy * dy + np.float32(1e-6))
        inverse = unity / distance
        c, s = dx * inverse, dy * inverse
        r[n], by_parameters[0, n], by_parameters[1, n] = distance, c, s
        t[n] = (distance * (unity - e_axes * (c * c - s * s) - e_diagonals * c * s) - radius) * per_blur
    for n in range(pixels):  # the place in the row, and below the way to its next entry
        share[n] = min(max((t[n] - first) * per_step, np.float32(0.0)), last)
    for n in range(pixels):
        x = share[n]
        at_left = np.int32(x)
        j, w = np.uint32(at_left), x - np.float32(at_left)
        low, step = row[0, j], row[0, j + np.uint32(1)] - row[0, j]
        by_r[n] = step * per_step * per_blur
        share[n] = low + step * w
        by_q[n] = row[1, j] + (row[1, j + np.uint32(1)] - row[1, j]) * w
    for n in range(pixels):
        c, s, f, q = by_parameters[0, n], by_parameters[1, n], by_r[n], by_q[n]
        slopes[1, n], slopes[2, n] = f * c, f * s
        by_parameters[0, n], by_parameters[1, n] = -f * c, -f * s
        g = f * r[n]
        by_parameters[2, n] = -f - q * blur * per_radius * per_radius
        by_parameters[3, n] = q * per_radius - f * t[n]
        by_parameters[4, n], by_parameters[5, n] = -g * (c * c - s * s), -g * two * c * s


@kernel()
def fill_light(model, shared, derivatives):
    """Fill `columns` with the residual, the model's light and the background, and with what `fill_slopes` needs.

    Of `columns`, the first BEAD_TERMS K rows receive the derivatives of each bead's share, the next K - 1 those of the
    light by BEAD_LIGHT. `shared`: the squared blur that background and shadow went through together.

    Without blur, the light is G W + s (1 - V): background G, scatter s, shares W and V that the beads leave of each.
    Each neighbour adds its share times BEAD_LIGHT. Blur over a slope of G moves the rim: to first order by
    blur² grad G grad W.
    """
    tables, at, beads, scatter, background, scale, stopped = model
    columns, behind, effect = derivatives
    count, pixels = len(beads), at.shape[1]
    blur2, unity = shared * scale, np.float32(1.0)
    three, s0, s1, s2 = np.float32(3.0), np.float32(scatter[0]), np.float32(scatter[1]), np.float32(scatter[2])
    row, slopes = np.empty((2, T_COUNT), np.float32), np.empty((count, 3, pixels), np.float32)
    others_left, others_clear = np.empty(pixels, np.float32), np.empty(pixels, np.float32)
    left, clear, left_x, left_y = behind[LEFT], behind[CLEAR], behind[LEFT_X], behind[LEFT_Y]
    rest, light, bright = columns[RESIDUAL], columns[LIGHT], columns[BACKGROUND]
    g0, g1, g2 = np.float32(background[0]), np.float32(background[1]), np.float32(background[2])
    g3, g4, g5 = np.float32(background[3]), np.float32(background[4]), np.float32(background[5])
    g6, g7, g8, g9 = (
        np.float32(background[6]),
        np.float32(background[7]),
        np.float32(background[8]),
        np.float32(background[9]),
    )
    for n in range(pixels):
        a, b = at[0, n] * scale, at[1, n] * scale
        low = g0 + a * (g1 + a * (g3 + a * g6)) + b * (g2 + b * (g5 + b * g9))
        bright[n] = low + a * b * (g4 + a * g7 + b * g8)
    left[:], clear[:], left_x[:], left_y[:] = unity, unity, 0.0, 0.0
    for k in range(count):
        _profile_row(tables, beads[k], row)
        _shadow(row, at, beads[k], columns[BEAD_TERMS * k : BEAD_TERMS * k + BEAD_TERMS], slopes[k])
        for n in range(pixels):
            left[n] *= unity - stopped * slopes[k, 0, n]
            clear[n] *= unity - slopes[k, 0, n]
    for k in range(count):
        others_left[:], others_clear[:] = unity, unity
        for m in range(count):
            if m != k:
                for n in range(pixels):
                    others_left[n] *= unity - stopped * slopes[m, 0, n]
                    others_clear[n] *= unity - slopes[m, 0, n]
        for n in range(pixels):
            left_x[n] -= blur2 * stopped * slopes[k, 1, n] * others_left[n]
            left_y[n] -= blur2 * stopped * slopes[k, 2, n] * others_left[n]
            behind_it = s0 + scale * (s1 * at[0, n] + s2 * at[1, n])
            effect[k, n] = behind_it * others_clear[n] - stopped * bright[n] * others_left[n]
    for n in range(pixels):
        a, b = at[0, n] * scale, at[1, n] * scale
        by_a = g1 + a * (g3 + g3 + three * a * g6) + b * (g4 + a * (g7 + g7) + b * g8)
        by_b = g2 + b * (g5 + g5 + three * b * g9) + a * (g4 + b * (g8 + g8) + a * g7)
        light[n] = (
            (s0 + s1 * a + s2 * b) * (unity - clear[n]) + bright[n] * left[n] + by_a * left_x[n] + by_b * left_y[n]
        )
        rest[n] = at[2, n] - light[n]
    for k in range(1, count):
        _add_light(beads[k], slopes[k, 0], columns[BEAD_TERMS * count + k - 1], effect[k], light, rest)


@kernel()
def _add_light(bead, share, by_light, effect, light, rest):  # noqa: PLR0917 - a kernel
    """Add BEAD_LIGHT of a neighbour with a `share` (N,) to light and residual; fill the derivative `by_light` (N,)."""
    own = np.float32(bead[BEAD_LIGHT])
    for n in range(len(share)):
        by_light[n] = share[n]
        effect[n] += own
        light[n] += own * share[n]
        rest[n] -= own * share[n]


@kernel()
def fill_slopes(at, scale, inverse_sd, derivatives):
    """Fill `columns` with the derivatives of the light by all parameters and the residual, times `inverse_sd` (N,).

    `derivatives` come from `fill_light`.
    """
    columns, behind, effect = derivatives
    lights, first, pixels = BEAD_TERMS * len(effect), (BEAD_TERMS + 1) * len(effect) - 1, at.shape[1]
    unity, two, three = np.float32(1.0), np.float32(2.0), np.float32(3.0)
    for k in range(len(effect)):
        for n in range(pixels):
            effect[k, n] *= inverse_sd[n]
        for m in range(BEAD_TERMS * k, BEAD_TERMS * k + BEAD_TERMS):
            for n in range(pixels):
                columns[m, n] *= effect[k, n]
    for m in range(lights, first):
        for n in range(pixels):
            columns[m, n] *= inverse_sd[n]
    scatter, rest = columns[first : first + SCATTER_TERMS], columns[RESIDUAL]
    for n in range(pixels):
        stopped = inverse_sd[n] * (unity - behind[CLEAR, n])
        scatter[0, n] = stopped
        scatter[1, n], scatter[2, n] = stopped * at[0, n] * scale, stopped * at[1, n] * scale
        rest[n] *= inverse_sd[n]
    background = columns[first + SCATTER_TERMS :]
    for n in range(pixels):
        a, b = at[0, n] * scale, at[1, n] * scale
        w, x, y = inverse_sd[n] * behind[LEFT, n], inverse_sd[n] * behind[LEFT_X, n], inverse_sd[n] * behind[LEFT_Y, n]
        aa, ab, bb = a * a, a * b, b * b
        background[0, n], background[1, n], background[2, n] = w, w * a + x, w * b + y
        background[3, n], background[4, n], background[5, n] = (
            w * aa + two * a * x,
            w * ab + b * x + a * y,
            w * bb + two * b * y,
        )
        background[6, n], background[7, n] = w * aa * a + three * aa * x, w * aa * b + two * ab * x + aa * y
        background[8, n], background[9, n] = w * ab * b + bb * x + two * ab * y, w * bb * b + three * bb * y


@kernel()
def normal_equations(columns, A, b):
    """Fill A = J'J (n, n) and b = J'r (n,); return the sum of r². J: the first n rows of `columns`, r: the next one."""
    n = len(b)
    products = np.dot(columns[: n + 1], columns[: n + 1].T)
    for i in range(n):
        b[i] = products[n, i]
        for j in range(n):
            A[i, j] = products[i, j]
    return float(products[n, n])


@kernel()
def solve(A, b, U, x):
    """Solve A x = b by the upper Cholesky factor of A, which fills `U`; return False where A is not positive definite.

    Of A and U the upper triangle counts.
    """
    n = len(b)
    for i in range(n):
        for j in range(i, n):
            U[i, j] = A[i, j]
    for i in range(n):
        row = U[i]
        if row[i] <= 1e-7 * A[i, i] or row[i] <= 0:
            return False
        inverse = 1.0 / np.sqrt(row[i])
        for j in range(i, n):
            row[j] *= inverse
        for k in range(i + 1, n):
            share, other = row[k], U[k]
            for j in range(k, n):
                other[j] -= share * row[j]
    substitute(U, b, x)
    return True


@kernel()
def substitute(U, b, x):
    """Solve U' U x = b for an upper triangle U."""
    n = len(b)
    for i in range(n):
        x[i] = b[i]
    for i in range(n):
        row = U[i]
        x[i] /= row[i]
        for j in range(i + 1, n):
            x[j] -= row[j] * x[i]
    for i in range(n - 1, -1, -1):
        rest, row = x[i], U[i]
        for j in range(i + 1, n):
            rest -= row[j] * x[j]
        x[i] = rest / row[i]
