"""First guesses: three detections taken for three datum markers of a plate give a similarity of plate and image."""

from dataclasses import dataclass

import numpy as np
from numba import njit

from sightline.detection.labelling.patterns import Pattern
from sightline.detection.results import Detections

MOST_LARGE = 32  # detections that may be datum markers [ours: 12 datums, 10 false ones, and room]
LARGER = 1.12  # than the median detection: half the step from 3 to 5 mm, less 15 % for the plates' scales [ours]
MOST_SEEDS = 4096
SMALLEST_PX = 10.0  # pitch in the image [ours: beads of 2 px radius and as much between them]
RADIUS_RATIO = 0.25  # log of detected over expected radius: blur, local magnification, tilt together [ours]
RADIUS_SPREAD = 0.2  # log radius between fiducials of one plate; half the step from 3 to 5 mm [ours]
THIRD = 0.14  # how far the third datum may miss its place, of the span: tilt 20°, 9 % pincushion [ours]
REACH = 0.3  # how far other beads may miss theirs, of the pitch: nearer to it than to the next bead's [ours]
CELLS = 48
SOON, SOON_LEAST = 16, 2.0  # a guess that has not more after so many beads is given up [ours]


@dataclass(frozen=True)
class Similarity:
    """Plate to image: u + iv = turn · z + shift with z = x + iy, or its conjugate where `mirror`. px/mm and px."""

    turn: complex
    shift: complex
    mirror: bool

    @property
    def scale(self) -> float:
        """Pixels per mm."""
        return abs(self.turn)

    def to_image(self, xy_mm: np.ndarray) -> np.ndarray:
        """(N, 2) mm to (N, 2) px."""
        z = xy_mm[:, 0] + 1j * xy_mm[:, 1]
        w = self.turn * (z.conj() if self.mirror else z) + self.shift
        return np.stack([w.real, w.imag], axis=1)

    def to_plate(self, uv_px: np.ndarray) -> np.ndarray:
        """(N, 2) px to (N, 2) mm."""
        z = (uv_px[:, 0] + 1j * uv_px[:, 1] - self.shift) / self.turn
        z = z.conj() if self.mirror else z
        return np.stack([z.real, z.imag], axis=1)


@dataclass(frozen=True, eq=False)
class Seed:
    """A guess for one plate: detections `rows` (3,) are its fiducials `places` (3,); `score` counts agreeing beads."""

    pattern: Pattern
    similarity: Similarity
    rows: np.ndarray
    places: np.ndarray
    score: float


@njit(cache=True)
def _nearest_table(uv, usable, width, height):
    """Which detection is nearest to the middle of each of CELLS x CELLS cells of the image."""
    table = np.zeros((CELLS, CELLS), np.int64)
    for i in range(CELLS):
        for j in range(CELLS):
            u, v = (j + 0.5) * width / CELLS, (i + 0.5) * height / CELLS
            best = np.inf
            for k in range(len(uv)):
                d = (uv[k, 0] - u) ** 2 + (uv[k, 1] - v) ** 2
                if usable[k] and d < best:
                    best = d
                    table[i, j] = k
    return table


@njit(cache=True)
def _score(a, b, mirror, log_ratio, z, log_half, pitch, w, log_r, table, width, height):  # noqa: PLR0917 - a kernel
    """Beads of the right size in place, less half of those of a wrong size, less a third of the missing."""
    score = 0.0
    reach2 = (REACH * pitch * abs(a)) ** 2
    log_scale = np.log(abs(a)) + log_ratio
    for p in range(len(z)):
        at = a * (z[p].conjugate() if mirror else z[p]) + b
        i, j = int(at.imag * CELLS / height), int(at.real * CELLS / width)
        if p == SOON and score < SOON_LEAST:
            return score - len(z)
        if i < 0 or j < 0 or i >= CELLS or j >= CELLS:
            continue
        k = table[i, j]
        d = w[k] - at
        if d.real**2 + d.imag**2 < reach2:
            score += 1.0 if abs(log_r[k] - log_half[p] - log_scale) < RADIUS_SPREAD else -0.5
        else:
            score -= 0.33
    return score


@njit(cache=True)
def _better_half(turns, shifts, what, scores):
    """Make room: keep the half with the better scores."""
    kept = np.argsort(-scores)[: len(scores) // 2]
    turns[: len(kept)], shifts[: len(kept)] = turns[kept], shifts[kept]
    what[: len(kept)], scores[: len(kept)] = what[kept], scores[kept]
    return len(kept)


@njit(cache=True)
def _search(w, log_r, large, z, log_half, datums, pitch, table, width, height):  # noqa: PLR0912, PLR0917 - a kernel
    """All similarities that put three datum markers on three large detections. See `find_seeds`."""
    turns = np.zeros(MOST_SEEDS, np.complex128)
    shifts = np.zeros(MOST_SEEDS, np.complex128)
    what = np.zeros((MOST_SEEDS, 7), np.int64)
    scores = np.zeros(MOST_SEEDS)
    count = 0
    log_gap = np.log(np.abs(np.expand_dims(w[large], 1) - w[large]) + np.eye(len(large)))
    log_side = np.log(np.abs(np.expand_dims(z, 1) - z) + np.eye(len(z)))
    log_least = np.log(SMALLEST_PX / pitch)
    for ni in range(len(large)):
        for nj in range(len(large)):
            i, j = large[ni], large[nj]
            if i == j:
                continue
            for na in range(len(datums)):
                for nb in range(na + 1, len(datums)):
                    pa, pb = datums[na], datums[nb]
                    log_scale = log_gap[ni, nj] - log_side[pa, pb]
                    ratio_i = log_r[i] - log_half[pa] - log_scale
                    ratio_j = log_r[j] - log_half[pb] - log_scale
                    if abs(ratio_i - ratio_j) > RADIUS_SPREAD or abs(ratio_i + ratio_j) > 2 * RADIUS_RATIO:
                        continue
                    if log_scale < log_least:
                        continue
                    span = abs(w[j] - w[i])
                    for mirror in range(2):
                        dz = z[pb] - z[pa]
                        a = (w[j] - w[i]) / (dz.conjugate() if mirror else dz)
                        for nc in range(nb + 1, len(datums)):
                            pc = datums[nc]
                            dz = z[pc] - z[pa]
                            want = w[i] + a * (dz.conjugate() if mirror else dz)
                            reach = THIRD * max(span, abs(want - w[i]), abs(want - w[j]))
                            for k in large:
                                off = w[k] - want
                                if k == i or k == j or off.real**2 + off.imag**2 > reach**2:  # noqa: PLR1714, SIM109
                                    continue
                                ratio = log_r[k] - log_half[pc] - log_scale
                                if abs(ratio - (ratio_i + ratio_j) / 2) > RADIUS_SPREAD:
                                    continue
                                za, zb, zc = z[pa], z[pb], z[pc]
                                if mirror:
                                    za, zb, zc = za.conjugate(), zb.conjugate(), zc.conjugate()
                                zm, wm = (za + zb + zc) / 3, (w[i] + w[j] + w[k]) / 3
                                da, db, dc = za - zm, zb - zm, zc - zm
                                top = w[i] * da.conjugate() + w[j] * db.conjugate() + w[k] * dc.conjugate()
                                turn = top / (abs(da) ** 2 + abs(db) ** 2 + abs(dc) ** 2)
                                shift = wm - turn * zm
                                if count == MOST_SEEDS:
                                    count = _better_half(turns, shifts, what, scores)
                                turns[count], shifts[count] = turn, shift
                                what[count] = np.array([i, j, k, pa, pb, pc, mirror])
                                level = (ratio_i + ratio_j + ratio) / 3
                                scores[count] = _score(
                                    turn, shift, mirror == 1, level, z, log_half, pitch, w, log_r, table, width, height
                                )
                                count += 1
    return turns[:count], shifts[:count], what[:count], scores[:count]


def find_seeds(detections: Detections, patterns: list[Pattern], usable: np.ndarray, most: int) -> list[Seed]:
    """The `most` best guesses for each plate among the `usable` (N,) detections, best first."""
    height, width = detections.image_shape
    w, log_r = detections.uv_px @ np.array([1.0, 1j]), np.log(detections.radius_px)
    table = _nearest_table(detections.uv_px, usable, width, height)
    out: list[Seed] = []
    for pattern in patterns:
        large = _may_be_datums(detections, pattern, usable)
        z, log_half = pattern.xy_mm @ np.array([1.0, 1j]), np.log(pattern.diameter_mm / 2)
        turns, shifts, what, scores = _search(
            w, log_r, large, z, log_half, pattern.datums, pattern.pitch_mm, table, width, height
        )
        for i in np.argsort(-scores, kind="stable")[:most]:
            similarity = Similarity(complex(turns[i]), complex(shifts[i]), bool(what[i, 6]))
            out.append(Seed(pattern, similarity, what[i, :3], what[i, 3:6], float(scores[i])))
    return sorted(out, key=lambda seed: -seed.score)


def _may_be_datums(detections: Detections, pattern: Pattern, usable: np.ndarray) -> np.ndarray:
    """Rows of the detections that may be datum markers of a plate: washers, or the largest balls."""
    washer = np.array([kind == "washer" for kind in detections.kind], dtype=bool)
    radius = detections.radius_px
    if pattern.washer[pattern.datums].all():
        may_be = usable & washer
    elif usable.any():
        may_be = usable & ~washer & (radius > LARGER * np.median(radius[usable]))
    else:
        may_be = usable
    return np.flatnonzero(may_be)[np.argsort(-radius[may_be], kind="stable")[:MOST_LARGE]]


def best_similarity(xy_mm: np.ndarray, uv_px: np.ndarray) -> Similarity:
    """The least-squares similarity of points (N, 2) of a plate and the image, of the handedness that fits better."""
    w = uv_px @ np.array([1.0, 1j])
    found: list[tuple[float, Similarity]] = []
    for mirror in (False, True):
        z = xy_mm @ np.array([1.0, -1j if mirror else 1j])
        dz, dw = z - z.mean(), w - w.mean()
        turn = complex(np.vdot(dz, dw) / np.vdot(dz, dz))
        miss = float((np.abs(dw - turn * dz) ** 2).sum())
        found.append((miss, Similarity(turn, complex(w.mean() - turn * z.mean()), mirror)))
    return min(found, key=lambda one: one[0])[1]
